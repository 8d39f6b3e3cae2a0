//! The experiments behind `planish bench`, which measure the engines on this machine after comparing each result with
//! the reference. The command converts its arguments and calls this crate.

mod connectivity;
mod document;
mod engines;
mod experiment;
mod frames;
mod general;
mod gpu;
mod options;
pub mod output;
mod plot;
mod profile;
mod quality;
mod record;
mod rig;
mod scaleup;
mod section;
mod simd;
mod speedup;
mod timing;

use std::sync::atomic::AtomicBool;

use anyhow::{Result, bail};

use document::Document;
use experiment::Bench;
pub use frames::{Input, simulated_inputs};
pub use general::{GeneralOptions, run as run_general};
pub use gpu::{GpuOptions as GpuBenchOptions, run as run_gpu};
pub use options::Options;
use record::Origin;
pub use rig::{RigBenchOptions, run as run_rig};
use section::Section;

/// An experiment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Experiment {
    /// Time per frame, and the speedup over the serial method.
    Speedup,
    /// Time per frame by the number of candidates in a window.
    Connectivity,
    /// Time for several copies of the scene, as a tall cloud and as a batch, and by number of threads.
    Scaleup,
    /// Time per frame in each stage.
    Profile,
    /// A raw and a smoothed frame, and the flatness of the frame's largest plane before and after smoothing.
    Quality,
    /// Time per frame by instruction set and preset.
    Simd,
}

impl Experiment {
    /// All experiments of the 2011 report, in its order.
    pub const ALL: [Self; 5] = [Self::Speedup, Self::Connectivity, Self::Scaleup, Self::Profile, Self::Quality];

    fn run(self, bench: &Bench<'_>) -> Result<Section> {
        match self {
            Self::Speedup => speedup::run(bench),
            Self::Connectivity => connectivity::run(bench),
            Self::Scaleup => scaleup::run(bench),
            Self::Profile => profile::run(bench),
            Self::Quality => quality::run(bench),
            Self::Simd => simd::run(bench),
        }
    }
}

/// The outcome of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// Everything was measured.
    Whole,
    /// `stop` was set; finished measurements are kept.
    Interrupted,
}

/// Runs experiments on frames and prints their tables.
///
/// # Errors
/// If a result is wrong, a requested engine is unavailable, or a file cannot be written.
pub fn run(experiments: &[Experiment], options: &Options, inputs: Vec<Input>, stop: &AtomicBool) -> Result<Ended> {
    let out = options.out.as_deref();
    if options.update.is_some() && experiments.len() < Experiment::ALL.len() {
        bail!("--update needs all experiments: use `planish bench all`");
    }
    let document = options.update.as_ref().zip(out).map(|(file, out)| Document::open(file, out)).transpose()?;
    let bench = Bench::new(options, inputs, stop);
    let origin = Origin::here(options);
    crate::outln!("{}", origin.markdown());
    let mut sections = Vec::new();
    for experiment in experiments {
        let mut section = experiment.run(&bench)?;
        section.note_skipped(bench.take_skipped());
        if bench.stopped() {
            section.note("Interrupted by Ctrl-C: incomplete.");
        }
        section.print();
        if let Some(out) = out {
            section.write(out, &origin)?;
        }
        sections.push(section);
        if bench.stopped() {
            crate::errln!("interrupted by Ctrl-C; finished measurements are above");
            return Ok(Ended::Interrupted);
        }
    }
    if let Some(document) = document {
        document.update(&origin, &sections)?;
    }
    Ok(Ended::Whole)
}
