//! `planish bench`: the engines measured on this machine, each result held against the reference before it is timed.

mod connectivity;
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

use std::process::ExitCode;

use anyhow::{Context, Result};
use planish::io::write_whole;
use serde::Serialize;

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
    let document = args.update.as_ref().zip(out).map(|(file, out)| Document::open(file, out)).transpose()?;
    let stop = stop_on_ctrl_c()?;
    let bench = Bench::new(args, &stop)?;
    let origin = Origin::here();
    println!("{}", origin.markdown());
    let mut sections = Vec::new();
    for experiment in experiments {
        let section = experiment(&bench)?;
        section.print();
        if let Some(out) = out {
            section.write(out)?;
            let file = out.join("origin.json");
            write_whole(&file, serde_json::to_string_pretty(&origin)?.as_bytes())
                .with_context(|| file.display().to_string())?;
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

/// The spread of repeated measurements.
#[derive(Debug, Clone, Copy, Serialize)]
struct Spread {
    p5: f64,
    median: f64,
    p95: f64,
    p99: f64,
}

impl Spread {
    /// Of at least one value.
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() as f64 * share) as usize).min(values.len() - 1)];
        Self { p5: at(0.05), median: at(0.5), p95: at(0.95), p99: at(0.99) }
    }
}
