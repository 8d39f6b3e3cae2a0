//! `planish completions` and `planish man`.

use std::fs;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::CommandFactory;
use planish_bench::out;

use crate::args::{Args, CompletionsArgs, ManArgs};

pub fn completions(args: &CompletionsArgs) -> Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Args::command(), "planish", &mut script);
    out!("{}", String::from_utf8_lossy(&script));
    Ok(ExitCode::SUCCESS)
}

pub fn man(args: &ManArgs) -> Result<ExitCode> {
    let of_folder = || args.folder.display().to_string();
    fs::create_dir_all(&args.folder).with_context(of_folder)?;
    clap_mangen::generate_to(Args::command(), &args.folder).with_context(of_folder)?;
    Ok(ExitCode::SUCCESS)
}
