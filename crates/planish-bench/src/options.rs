//! Options of the experiments.

use std::path::PathBuf;

use planish::Engine;

/// Options of the experiments: engines, duration and output.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// The engines to measure. If empty or containing `Auto`: all engines of this machine except software GPUs.
    pub engines: Vec<Engine>,
    /// True for fewer and shorter measurements: the 2011 report's experiments then take about a minute on two cores.
    pub quick: bool,
    /// Folder for each experiment's JSON, Markdown and plots.
    pub out: Option<PathBuf>,
    /// Markdown file whose block of results is replaced.
    pub update: Option<PathBuf>,
    /// The program's version, for the record.
    pub version: &'static str,
    /// The compiler that built the program, for the record.
    pub rustc: &'static str,
}
