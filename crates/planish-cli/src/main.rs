//! The command `planish`: it reads arguments, calls the library and prints; it decides nothing.
//!
//! Exit codes: 0 done, 1 some files of a folder failed, 2 bad arguments or input.

mod args;
mod commands;

use std::process::ExitCode;

use clap::Parser;

use args::{Args, Command};

fn main() -> ExitCode {
    quiet_the_window_system();
    let result = match Args::parse().command {
        Command::Demo(args) => commands::demo::run(&args),
        Command::Smooth(args) => commands::smooth::run(&args),
        Command::Info(args) => commands::info::run(&args),
        Command::Render(args) => commands::render::run(&args),
        Command::Stream(args) => commands::stream::run(&args),
        Command::Record(args) => commands::record::run(&args),
        Command::Devices(args) => commands::devices::run(&args),
        Command::Evaluate(args) => commands::evaluate::run(&args),
        Command::Bench(args) => commands::bench::run(&args),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(2)
        }
    }
}

/// Where there is no session of a desktop, Mesa's Vulkan drivers look for one nevertheless and complain on standard error of a
/// missing XDG_RUNTIME_DIR, once for every question. Any folder quiets them.
fn quiet_the_window_system() {
    if cfg!(target_os = "linux") && std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: the process has no other thread yet that could read the environment.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
}
