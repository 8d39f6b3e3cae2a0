//! Experiment 1: how long a frame takes, from the host's memory to the host's memory, and how many times faster that is than the
//! general serial method.

use std::time::Instant;

use anyhow::Result;
use planish::{Engine, Outputs, SmoothParams, Smoothed, smooth_points};
use serde::Serialize;

use super::experiment::{Bench, Patience, Subject, Timing, ms, touch};
use super::frames::Input;
use super::plot::{Scale, bars};
use super::section::Section;

/// The 2011 report: frames a second by its GPU, a frame by the general method on its CPU, its two speedups.
const REPORT_FPS: f64 = 7.0;
const REPORT_CPU_S: f64 = 4.76;
const REPORT_SPEEDUPS: [f64; 2] = [32.9, 57.6];
/// Of fewer frames than this the 99th percentile is not told.
const FRAMES_FOR_P99: usize = 100;

#[derive(Serialize)]
struct Row {
    frame: String,
    engine: String,
    /// Of a frame; with frames in flight from one result to the next.
    time: Timing,
    frames_per_second: f64,
    times_the_serial_method: f64,
}

/// How a GPU's frames go.
#[derive(Clone, Copy)]
struct Way {
    name: &'static str,
    in_flight: bool,
    /// Whether the result is copied to a buffer of the host's own.
    copied: bool,
}

const WAYS: [Way; 4] = [
    Way { name: "one at a time, copied out", in_flight: false, copied: true },
    Way { name: "one at a time, read in place", in_flight: false, copied: false },
    Way { name: "in flight, copied out", in_flight: true, copied: true },
    Way { name: "in flight, read in place", in_flight: true, copied: false },
];

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("speedup", "Speedup");
    section.note(
        "The 2011 report's setting (window 3, degree 3, 3 cm), from the frame in the host's memory to the points in the host's \
         memory. The serial method takes all neighbours within 3 cm by a k-d tree, on one thread, in f64.",
    );
    let subjects = context.subjects(true);
    let inputs = if context.args.quick { &context.inputs[..1] } else { &context.inputs[..] };
    let bar = context.bar("speedup", inputs.len() * (subjects.len() + 1))?;
    let mut rows: Vec<Row> = Vec::new();
    for input in inputs {
        if context.stopped() {
            break;
        }
        let serial = serial(context, input)?;
        bar.inc(1);
        let row = |engine: String, time: Timing, in_flight: bool| {
            // With frames in flight some wait while others come at once: the mean is what a stream gets.
            let ms = if in_flight { time.mean } else { time.ms.median };
            let frame = input.describe();
            let times_the_serial_method = serial.ms.median / ms;
            Row { frame, engine, time, frames_per_second: 1e3 / ms, times_the_serial_method }
        };
        rows.push(row("general serial method".into(), serial, false));
        for subject in &subjects {
            if context.stopped() {
                break;
            }
            context.check(subject, SmoothParams::paper(), input)?;
            if subject.options.engine == Engine::Gpu {
                for way in WAYS {
                    let engine = format!("{}, {}", subject.name, way.name);
                    rows.push(row(engine, by_gpu(context, subject, input, way)?, way.in_flight));
                }
            } else {
                rows.push(row(subject.name.clone(), by_cpu(context, subject, input)?, false));
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    for input in inputs {
        section.note(format!("{}:", input.describe()));
        section.table(
            &["engine", "ms, median", "ms, p99", "of frames", "frames a second", "times the serial method"],
            rows.iter().filter(|row| row.frame == input.describe()).map(cells),
        );
    }
    let [low, high] = REPORT_SPEEDUPS;
    let across = format!("times as many frames a second (lines: the report's {low} and {high})");
    for (i, of_frame) in rows.chunk_by(|a, b| a.frame == b.frame).enumerate() {
        let title = format!("Times the serial method, {}", of_frame[0].frame);
        let bars_of: Vec<_> = of_frame.iter().map(|row| (row.engine.clone(), row.times_the_serial_method)).collect();
        let svg = bars(&title, &across, Scale::Logarithmic, &bars_of, &REPORT_SPEEDUPS)?;
        section.svg(&format!("speedup-{i}.svg"), &title, svg);
    }
    section.note(format!(
        "The report had {REPORT_FPS:.0} frames a second, {low} and {high} times its CPU, which took up to {REPORT_CPU_S} s a \
         frame. Frames a second are of the median, in flight of the mean; p99 is told of {FRAMES_FOR_P99} frames or more."
    ));
    section.note_noise(rows.iter().map(|row| row.time.noisy));
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}

fn cells(row: &Row) -> Vec<String> {
    let Row { engine, time, frames_per_second, times_the_serial_method, .. } = row;
    let p99 = if time.runs >= FRAMES_FOR_P99 { format!("{:.3}", time.ms.p99) } else { "-".to_owned() };
    let fps =
        if *frames_per_second < 100.0 { format!("{frames_per_second:.2}") } else { format!("{frames_per_second:.0}") };
    vec![engine.clone(), time.cell(), p99, time.runs.to_string(), fps, format!("{times_the_serial_method:.1}")]
}

fn serial(context: &Bench<'_>, input: &Input) -> Result<Timing> {
    let mut smoothed = Smoothed::default();
    context.time(Patience::Long, || {
        Ok(smooth_points(&input.cloud.points, SmoothParams::paper(), Outputs::POINTS, Some(1), &mut smoothed)?)
    })
}

fn by_cpu(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Timing> {
    let mut smoother = subject.open(SmoothParams::paper(), input.shape())?;
    let mut smoothed = Smoothed::default();
    context.time(Patience::Long, || Ok(smoother.smooth(input.frame(), &mut smoothed)?))
}

fn by_gpu(context: &Bench<'_>, subject: &Subject, input: &Input, way: Way) -> Result<Timing> {
    let mut smoother = subject.open(SmoothParams::paper(), input.shape())?;
    let mut spare = vec![Smoothed::default()];
    if !way.in_flight {
        return context.time(Patience::Long, || {
            if way.copied {
                smoother.smooth(input.frame(), &mut spare[0])?;
            } else {
                smoother.submit_in_place(input.frame())?;
                smoother.receive()?.iter().for_each(touch);
            }
            Ok(())
        });
    }
    let mut last = Instant::now();
    let timing = context.measure(Patience::Long, || {
        if smoother.in_flight() == smoother.max_in_flight()
            && let Some(view) = smoother.receive()?
        {
            touch(&view);
            if way.copied {
                spare.push(view.into_smoothed());
            }
        }
        if way.copied {
            smoother.submit(input.frame(), spare.pop().unwrap_or_default())?;
        } else {
            smoother.submit_in_place(input.frame())?;
        }
        let now = Instant::now();
        let since = ms(now - last);
        last = now;
        Ok(since)
    })?;
    while smoother.receive()?.is_some() {}
    Ok(timing)
}
