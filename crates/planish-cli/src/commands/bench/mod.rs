//! `planish bench`: the engines measured on this machine, each result held against the reference before it is timed.

mod connectivity;
mod engines;
mod experiment;
mod frames;
mod gpu;
mod plot;
mod profile;
mod quality;
mod record;
mod scaleup;
mod section;
mod speedup;
mod timing;

use std::process::ExitCode;

use anyhow::{Result, bail};

use super::stream::stop_on_ctrl_c;
use crate::args::{BenchArgs, BenchCommand};
use experiment::Bench;
use record::{Document, Origin};
use section::Section;

pub fn run(args: &BenchArgs) -> Result<ExitCode> {
    type Experiment = fn(&Bench<'_>) -> Result<Section>;
    let all: [Experiment; 5] = [speedup::run, connectivity::run, scaleup::run, profile::run, quality::run];
    let (args, experiments) = match &args.what {
        BenchCommand::Gpu(args) => return gpu::run(args),
        BenchCommand::Speedup(args) => (args, &all[0..1]),
        BenchCommand::Connectivity(args) => (args, &all[1..2]),
        BenchCommand::Scaleup(args) => (args, &all[2..3]),
        BenchCommand::Profile(args) => (args, &all[3..4]),
        BenchCommand::Quality(args) => (args, &all[4..5]),
        BenchCommand::All(args) => (args, &all[..]),
    };
    let out = args.out.as_deref();
    if args.update.is_some() && experiments.len() < all.len() {
        bail!("--update writes a block with all experiments: use it with `planish bench all`");
    }
    let document = args.update.as_ref().zip(out).map(|(file, out)| Document::open(file, out)).transpose()?;
    let stop = stop_on_ctrl_c()?;
    let bench = Bench::new(args, &stop)?;
    let origin = Origin::here();
    println!("{}", origin.markdown());
    let mut sections = Vec::new();
    for experiment in experiments {
        let mut section = experiment(&bench)?;
        section.note_skipped(bench.take_skipped());
        if bench.stopped() {
            section.note("Ended by Ctrl-C: not all was measured.");
        }
        section.print();
        if let Some(out) = out {
            section.write(out, &origin)?;
        }
        sections.push(section);
        if bench.stopped() {
            eprintln!("ended by Ctrl-C; what was measured until then is above");
            return Ok(ExitCode::from(130));
        }
    }
    if let Some(document) = document {
        document.update(&origin, &sections)?;
    }
    Ok(ExitCode::SUCCESS)
}
