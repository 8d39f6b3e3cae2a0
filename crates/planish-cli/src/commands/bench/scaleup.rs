//! Experiment 3: the scene several times over, as one tall cloud and as a batch; and the CPU engine on more threads.

use anyhow::Result;
use planish::{Engine, Frame, OrganizedCloud, SmoothParams, Smoothed, Smoother, SmootherOptions, Xyz};
use serde::Serialize;

use super::experiment::{Bench, Section, Timing, cell, plot};

#[derive(Serialize)]
struct Row {
    engine: String,
    /// One tall cloud, or a batch of frames.
    how: &'static str,
    copies: usize,
    time: Timing,
    nanoseconds_a_pixel: f64,
    /// Copies times the time of one, over the time of all: 1 if all the copies take as many times as long.
    scaleup: f64,
    /// What the process has in memory meanwhile, where the system tells it.
    memory_mib: Option<f64>,
}

#[derive(Serialize)]
struct ThreadsRow {
    threads: usize,
    time: Timing,
    speedup: f64,
}

#[derive(Serialize)]
struct Results {
    copies: Vec<Row>,
    threads: Vec<ThreadsRow>,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section { name: "scaleup", ..Section::default() };
    section.text = "## Scale-up\n".to_owned();
    let Some(input) = context.inputs.first() else { return Ok(section) };
    let copies: &[usize] = if context.args.quick { &[1, 2, 4, 6, 8] } else { &[1, 2, 4, 6, 8, 16, 32] };
    let subjects: Vec<_> =
        context.subjects(false).into_iter().filter(|subject| subject.options.engine != Engine::Reference).collect();
    let all_threads = std::thread::available_parallelism().map_or(1, usize::from);
    let bar = context.bar("scaleup", subjects.len() * 2 * copies.len() + all_threads)?;
    let mut rows: Vec<Row> = Vec::new();
    for subject in &subjects {
        context.check(subject, SmoothParams::paper(), input)?;
        for how in ["tall", "batch"] {
            let mut one_ms = f64::NAN;
            for &copies in copies {
                if context.stopped() {
                    break;
                }
                let time = if how == "tall" {
                    tall(context, &subject.options, &input.cloud, copies)?
                } else {
                    batch(context, &subject.options, &input.cloud, copies)?
                };
                if copies == 1 {
                    one_ms = time.ms.median;
                }
                let pixels = input.cloud.points.len() * copies;
                rows.push(Row {
                    engine: subject.name.clone(),
                    how,
                    copies,
                    time,
                    nanoseconds_a_pixel: 1e6 * time.ms.median / pixels as f64,
                    scaleup: copies as f64 * one_ms / time.ms.median,
                    memory_mib: resident_mib(),
                });
                bar.inc(1);
            }
        }
    }
    let mut threads: Vec<ThreadsRow> = Vec::new();
    for subject in subjects.iter().filter(|subject| subject.options.engine == Engine::Cpu) {
        for count in (1..=all_threads).filter(|_| !context.stopped()) {
            let options = SmootherOptions { threads: Some(count), ..subject.options.clone() };
            let time = tall(context, &options, &input.cloud, 1)?;
            let one_ms = threads.first().map_or(time.ms.median, |one: &ThreadsRow| one.time.ms.median);
            threads.push(ThreadsRow { threads: count, time, speedup: one_ms / time.ms.median });
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    section.note(format!(
        "{} several times over, in one tall cloud and in a batch of frames; window 3, degree 3, 3 cm.",
        input.name
    ));
    let columns = ["engine", "as", "copies", "ms", "ns a pixel", "scale-up", "process, MiB"];
    section.table(
        &columns,
        rows.iter().map(|row| {
            let memory = row.memory_mib.map_or("-".into(), |mib| format!("{mib:.0}"));
            let (a_pixel, scaleup) = (format!("{:.2}", row.nanoseconds_a_pixel), format!("{:.3}", row.scaleup));
            vec![row.engine.clone(), row.how.into(), row.copies.to_string(), cell(&row.time), a_pixel, scaleup, memory]
        }),
    );
    if !threads.is_empty() {
        let of_row = |row: &ThreadsRow| vec![row.threads.to_string(), cell(&row.time), format!("{:.2}", row.speedup)];
        section.table(&["threads of the CPU engine", "ms", "speedup"], threads.iter().map(of_row));
    }
    section.note_noise(rows.iter().map(|row| row.time.noisy).chain(threads.iter().map(|row| row.time.noisy)));
    let mut lines: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
    for row in &rows {
        let name = format!("{}, {}", row.engine, row.how);
        let point = (row.copies as f64, row.scaleup);
        match lines.iter_mut().find(|(line, _)| *line == name) {
            Some((_, points)) => points.push(point),
            None => lines.push((name, vec![point])),
        }
    }
    if !lines.is_empty() {
        section.files.push(("scaleup.svg".into(), plot("Scale-up", "copies", "1 is linear", &lines)?));
    }
    section.json = serde_json::to_value(Results { copies: rows, threads })?;
    Ok(section)
}

/// The cloud `copies` times, one under the other.
fn tall(context: &Bench<'_>, options: &SmootherOptions, cloud: &OrganizedCloud, copies: usize) -> Result<Timing> {
    let Xyz { x, y, z } = cloud.positions();
    let positions = Xyz { x: x.repeat(copies), y: y.repeat(copies), z: z.repeat(copies) };
    let tall = OrganizedCloud::from_positions(cloud.width(), copies * cloud.height(), positions)
        .map_err(planish::Error::from)?;
    let mut smoother = Smoother::open_with(SmoothParams::paper(), options, (tall.width(), tall.height()))?;
    let mut smoothed = Smoothed::default();
    context.time(|| Ok(smoother.smooth(&tall, &mut smoothed)?))
}

fn batch(context: &Bench<'_>, options: &SmootherOptions, cloud: &OrganizedCloud, copies: usize) -> Result<Timing> {
    let frames = vec![Frame::Cloud(cloud); copies];
    let mut smoother = Smoother::open_with(SmoothParams::paper(), options, (cloud.width(), cloud.height()))?;
    let mut smoothed = vec![Smoothed::default(); copies];
    context.time(|| Ok(smoother.smooth_batch(&frames, &mut smoothed)?))
}

/// What the process has in memory, by the system's word; `None` where it has none.
fn resident_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}
