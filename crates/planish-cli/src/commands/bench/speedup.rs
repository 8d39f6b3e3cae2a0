//! Experiment 1: how long a frame takes, from the host's memory to the host's memory, and how many times faster that is than the
//! general serial method.

use anyhow::Result;
use planish::{Engine, Outputs, SmoothParams, Smoothed, Smoother, smooth_points};
use serde::Serialize;

use super::experiment::{Bench, Input, Section, Subject, Timing, cell};

/// The 2011 report: one frame by its GPU, and by the general method on its CPU; its two speedups.
const REPORT_FPS: f64 = 7.0;
const REPORT_CPU_S: f64 = 4.76;
const REPORT_SPEEDUPS: [f64; 2] = [32.9, 57.6];

#[derive(Serialize)]
struct Row {
    frame: String,
    engine: String,
    /// A frame at a time; for frames in flight the time between two results.
    time: Timing,
    times_the_serial_method: f64,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section { name: "speedup", ..Section::default() };
    section.text = "## Speedup\n".to_owned();
    section.note(
        "The 2011 report's setting (window 3, degree 3, 3 cm), from the frame in the host's memory to the points in the host's \
         memory. The serial method takes all neighbours within 3 cm by a k-d tree, on one thread, in f64.",
    );
    let subjects = context.subjects(true);
    // The serial method takes longest on what is near.
    let frames = if context.args.quick { 1 } else { context.inputs.len() };
    let bar = context.bar("speedup", frames * (subjects.len() + 1))?;
    let mut rows: Vec<Row> = Vec::new();
    for input in context.inputs.iter().take(frames) {
        if context.stopped() {
            break;
        }
        let serial = serial(context, input)?;
        bar.inc(1);
        let row = |engine: String, time: Timing| Row {
            frame: input.name.clone(),
            engine,
            time,
            times_the_serial_method: serial.ms.median / time.ms.median,
        };
        rows.push(row("general serial method".into(), serial));
        for subject in &subjects {
            if context.stopped() {
                break;
            }
            context.check(subject, SmoothParams::paper(), input)?;
            rows.push(row(subject.name.clone(), one_at_a_time(context, subject, input)?));
            if subject.options.engine == Engine::Gpu {
                rows.push(row(format!("{}, frames in flight", subject.name), in_flight(context, subject, input)?));
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    for input in context.inputs.iter().take(frames) {
        let of_frame = rows.iter().filter(|row| row.frame == input.name);
        section.note(format!("{}, {}x{}:", input.name, input.cloud.width(), input.cloud.height()));
        let columns = ["engine", "ms, median", "ms, p99", "frames a second", "times the serial method"];
        section.table(
            &columns,
            of_frame.map(|row| {
                let ms = row.time.ms;
                let engine = row.engine.clone();
                let speedup = format!("{:.1}", row.times_the_serial_method);
                vec![engine, cell(&row.time), format!("{:.3}", ms.p99), format!("{:.1}", 1e3 / ms.median), speedup]
            }),
        );
    }
    let [low, high] = REPORT_SPEEDUPS;
    section.note(format!(
        "The report had {REPORT_FPS:.0} frames a second, {low} and {high} times its CPU, which took up to {REPORT_CPU_S} s a frame."
    ));
    section.note_noise(rows.iter().map(|row| row.time.noisy));
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}

fn serial(context: &Bench<'_>, input: &Input) -> Result<Timing> {
    let mut smoothed = Smoothed::default();
    context.time(|| {
        Ok(smooth_points(&input.cloud.points, SmoothParams::paper(), Outputs::POINTS, Some(1), &mut smoothed)?)
    })
}

fn one_at_a_time(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Timing> {
    let shape = (input.cloud.width(), input.cloud.height());
    let mut smoother = Smoother::open_with(SmoothParams::paper(), &subject.options, shape)?;
    let mut smoothed = Smoothed::default();
    context.time(|| Ok(smoother.smooth(&input.cloud, &mut smoothed)?))
}

/// The time between results with as many frames in flight as there are slots, read where they are.
fn in_flight(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Timing> {
    /// Frames of one measurement.
    const FRAMES: usize = 20;
    let shape = (input.cloud.width(), input.cloud.height());
    let mut smoother = Smoother::open_with(SmoothParams::paper(), &subject.options, shape)?;
    let mut timing = context.time(|| {
        for _ in 0..FRAMES {
            if smoother.in_flight() == smoother.max_in_flight()
                && let Some(view) = smoother.receive()?
            {
                std::hint::black_box(view.points().map(|[x, ..]| x[x.len() / 2]));
            }
            smoother.submit_in_place(&input.cloud)?;
        }
        Ok(())
    })?;
    while smoother.receive()?.is_some() {}
    let ms = &mut timing.ms;
    for time in [&mut ms.p5, &mut ms.median, &mut ms.p95, &mut ms.p99] {
        *time /= FRAMES as f64;
    }
    Ok(timing)
}
