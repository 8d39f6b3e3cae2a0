//! Experiment 1: time per frame from host memory to host memory, and the speedup over the general serial method.

use std::time::Instant;

use anyhow::Result;
use planish::{CloudParams, Engine, FrameParams, Outputs, Smoothed, Smoother, SmootherOptions};
use serde::Serialize;

use super::engines::Way;
use super::experiment::{Bench, Patience, ms};
use super::frames::Input;
use super::plot::{Scale, bars};
use super::section::Section;
use super::timing::Timing;

/// Frames per second of the 2011 report's GPU.
const REPORT_FPS: f64 = 7.0;
/// Time per frame of the general method on the 2011 report's CPU, in seconds.
const REPORT_CPU_S: f64 = 4.76;
/// The two speedups stated in the 2011 report.
const REPORT_SPEEDUPS: [f64; 2] = [32.9, 57.6];
/// Minimum number of measurements for a 99th percentile.
const FRAMES_FOR_P99: usize = 100;
/// Number of frames per measurement if several are in flight, since such frames finish in bursts.
const BLOCK: usize = 16;

#[derive(Serialize)]
struct Row {
    frame: String,
    engine: String,
    /// Time per frame. With frames in flight, it is the interval between results, averaged over a block of frames.
    time: Timing,
    frames: usize,
    frames_per_second: f64,
    times_the_serial_method: f64,
}

/// Measurements of a GPU: suffix of the engine's name, way, and number of frames per measurement.
const GPU_WAYS: [(&str, Way, usize); 4] = [
    (", one at a time, copied out", Way::CopiedOut, 1),
    (", one at a time, read in place", Way::InPlace, 1),
    (", in flight, copied out", Way::CopiedOutInFlight, BLOCK),
    (", in flight, read in place", Way::InPlaceInFlight, BLOCK),
];

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("speedup", "Speedup");
    section.note(
        "Times are for the 2011 report's setting (window 3, degree 3, 3 cm), from the frame to the points, both in \
         host memory. The serial method uses all neighbours within 3 cm from a k-d tree, on one thread, in f64. Its \
         result differs, so it is not compared with the reference.",
    );
    let subjects = context.subjects(true)?;
    let inputs = if context.options.quick { &context.inputs[..1] } else { &context.inputs[..] };
    let bar = context.bar("speedup", inputs.len() * (subjects.len() + 1))?;
    let mut rows: Vec<Vec<Row>> = Vec::new();
    for input in inputs {
        let Some(serial) = context.attempt("the serial method", serial(context, input))? else { break };
        bar.inc(1);
        let row = |engine: String, time: Timing, frames: usize| {
            let ms = time.ms.median;
            let frame = input.describe();
            let times_the_serial_method = serial.ms.median / ms;
            Row { frame, engine, time, frames, frames_per_second: 1e3 / ms, times_the_serial_method }
        };
        let mut of_input = vec![row("general serial method".into(), serial, serial.runs)];
        for subject in &subjects {
            let ways = if subject.is_gpu() { &GPU_WAYS[..] } else { &[("", Way::CopiedOut, 1)] };
            for &(name, way, block) in ways.iter().filter(|_| !context.stopped()) {
                let engine = format!("{}{name}", subject.name);
                let timed = context.time_way(subject, FrameParams::paper(), input, way, block);
                if let Some(time) = context.attempt(&engine, timed)? {
                    of_input.push(row(engine, time, block * time.runs));
                }
            }
            bar.inc(1);
        }
        rows.push(of_input);
    }
    bar.finish_and_clear();
    let [low, high] = REPORT_SPEEDUPS;
    let across = format!("speedup in frames per second (lines: the report's {low} and {high})");
    for (i, (of_input, input)) in rows.iter().zip(inputs).enumerate() {
        section.note(format!("{}:", input.describe()));
        section.table(
            &[
                "engine",
                "ms per frame, median",
                "ms, p99",
                "frames timed",
                "frames per second",
                "speedup over the serial method",
            ],
            of_input.iter().map(cells),
        );
        let title = format!("Speedup over the serial method, {}", input.describe());
        let bars_of: Vec<_> = of_input.iter().map(|row| (row.engine.clone(), row.times_the_serial_method)).collect();
        let svg = bars(&title, &across, Scale::Logarithmic, &bars_of, &REPORT_SPEEDUPS)?;
        section.svg(&format!("speedup-{i}.svg"), &title, svg);
    }
    section.note(format!(
        "The report states {REPORT_FPS:.0} frames per second, {low} and {high} times as fast as its CPU, which took \
         up to {REPORT_CPU_S} s per frame. In flight, the time of a frame is the interval between results, averaged \
         over blocks of {BLOCK}; the latency of each frame is at least that of a single frame. p99 is reported for \
         {FRAMES_FOR_P99} or more measurements."
    ));
    section.note_noise(rows.iter().flatten().map(|row| row.time.noisy));
    section.json = serde_json::to_value(rows.iter().flatten().collect::<Vec<_>>())?;
    Ok(section)
}

fn cells(row: &Row) -> Vec<String> {
    let Row { engine, time, frames, frames_per_second, times_the_serial_method, .. } = row;
    let p99 = if time.runs >= FRAMES_FOR_P99 { format!("{:.3}", time.ms.p99) } else { "-".to_owned() };
    let fps = significant(*frames_per_second);
    vec![engine.clone(), time.cell(), p99, frames.to_string(), fps, significant(*times_the_serial_method)]
}

/// Formats a rate or a ratio for a table.
fn significant(value: f64) -> String {
    let digits = match value {
        _ if value < 10.0 => 2,
        _ if value < 100.0 => 1,
        _ => 0,
    };
    format!("{value:.digits$}")
}

fn serial(context: &Bench<'_>, input: &Input) -> Result<Timing> {
    let options = SmootherOptions::new(Engine::Reference, Outputs::POINTS).with_threads(Some(1));
    let mut smoother = Smoother::open_clouds(CloudParams::paper(), &options)?;
    let mut smoothed = Smoothed::default();
    context.measure(Patience::Long, || {
        let start = Instant::now();
        smoother.smooth(&input.cloud.points, &mut smoothed)?;
        Ok(ms(start.elapsed()))
    })
}
