//! `planish completions` and `planish man`.

use crate::exit::ExitCode;
use std::path::Path;

use anyhow::{Context, Result};
use clap::CommandFactory;
use planish::io::internal::create_output_folder;
use planish::io::write_whole;
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
    create_output_folder(&args.folder).with_context(of_folder)?;
    let mut command = Args::command();
    command.build();
    write_page(&command, &args.folder)?;
    command.get_subcommands().filter(|command| !command.is_hide_set()).try_for_each(|command| {
        write_page(command, &args.folder)?;
        command.get_subcommands().try_for_each(|command| write_page(command, &args.folder))
    })?;
    Ok(ExitCode::SUCCESS)
}

/// Writes the manual page of a command, such as `planish-smooth.1`.
fn write_page(command: &clap::Command, folder: &Path) -> Result<()> {
    let mut page = Vec::new();
    let man = clap_mangen::Man::new(command.clone());
    let file = folder.join(man.get_filename());
    man.render(&mut page)?;
    write_whole(&file, &page).with_context(|| file.display().to_string())
}
