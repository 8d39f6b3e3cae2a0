//! What to measure.

use std::path::PathBuf;

use planish::Engine;

/// The experiments to run, and the folder for results.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// The engines; if empty or containing `Auto`, all of this machine except software GPUs.
    pub engines: Vec<Engine>,
    /// Fewer and shorter measurements: the 2011 report's experiments take about a minute on two cores.
    pub quick: bool,
    /// Folder for each experiment's JSON, Markdown and plots.
    pub out: Option<PathBuf>,
    /// A Markdown file whose block of results is written again.
    pub update: Option<PathBuf>,
    /// The program's version and compiler, for the record.
    pub version: &'static str,
    /// The compiler it was built with.
    pub rustc: &'static str,
}
