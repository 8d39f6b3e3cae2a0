//! `planish bench`: the engines measured on this machine, each result held against the reference before it is timed.

mod gpu;

use std::process::ExitCode;

use anyhow::Result;
use serde::Serialize;

use crate::args::{BenchArgs, BenchCommand};

pub fn run(args: &BenchArgs) -> Result<ExitCode> {
    match &args.what {
        BenchCommand::Gpu(args) => gpu::run(args),
    }
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
