//! The command under attack: mutated files through every subcommand, and processes that end at random times.
//!
//! Every run must end soon and use little memory. If it fails, it prints a plain sentence; its outputs are whole or
//! absent. `cargo test -p planish-tests --test hostile -- --ignored` runs the long versions, with the seed in
//! `PLANISH_HOSTILE_SEED` (default: 2). A fault names its case; `PLANISH_HOSTILE_ONLY=CASE` runs only that case.

#![cfg(target_os = "linux")]

mod attack;
mod kills;
mod mutate;
mod numbers;
mod program;
mod samples;

fn seed() -> u64 {
    std::env::var("PLANISH_HOSTILE_SEED").map_or(2, |text| text.parse().unwrap())
}

#[test]
fn some_mutated_files_are_survived() {
    attack::run(500, 1);
}

#[test]
#[ignore = "takes minutes: run it when a reader or a command changes"]
fn twenty_thousand_mutated_files_are_survived() {
    attack::run(20_000, seed());
}

#[test]
fn some_processes_that_end_early_leave_whole_files() {
    kills::run(40, 1);
}

#[test]
#[ignore = "takes minutes: run it when something writes files in a new way"]
fn many_processes_that_end_early_leave_whole_files() {
    kills::run(400, seed());
}
