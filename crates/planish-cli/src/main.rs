//! The command `planish`: it reads arguments, calls the library and prints; it decides nothing.
//!
//! Exit codes: 0 done, 1 some files of a folder failed, 2 bad arguments or input.

mod args;
mod commands;

use std::process::ExitCode;

use clap::Parser;

use args::{Args, Command};

fn main() -> ExitCode {
    let result = match Args::parse().command {
        Command::Demo(args) => commands::demo::run(&args),
        Command::Smooth(args) => commands::smooth::run(&args),
        Command::Info(args) => commands::info::run(&args),
        Command::Render(args) => commands::render::run(&args),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(2)
        }
    }
}
