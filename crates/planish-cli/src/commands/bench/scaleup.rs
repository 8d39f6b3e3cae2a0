//! Experiment 3: the scene several times over, as one tall cloud and as a batch; and the CPU engine on more threads.

use anyhow::Result;
use planish::{Engine, Error, Frame, OrganizedCloud, SmoothParams, SmootherOptions, Xyz};
use serde::Serialize;

use super::experiment::{Bench, Clock, Load, Subject, Timing};
use super::frames::Input;
use super::plot::lines;
use super::section::Section;

#[derive(Serialize)]
struct Row {
    engine: String,
    how: How,
    copies: usize,
    time: Timing,
    nanoseconds_a_pixel: f64,
    /// Copies times the time of one, over the time of all: 1 if all the copies take as many times as long.
    scaleup: f64,
    /// What the engine keeps, on the device or in the host's memory.
    buffers_mib: f64,
    /// What the process has in the host's memory meanwhile, where the system tells it.
    process_mib: Option<f64>,
}

#[derive(Clone, Copy, Serialize)]
#[serde(rename_all = "lowercase")]
enum How {
    Tall,
    Batch,
}

impl How {
    fn name(self) -> &'static str {
        match self {
            Self::Tall => "tall",
            Self::Batch => "batch",
        }
    }
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
    let mut section = Section::new("scaleup", "Scale-up");
    let Some(input) = context.inputs.first() else { return Ok(section) };
    let copies: &[usize] = if context.args.quick { &[1, 2, 4, 6, 8] } else { &[1, 2, 4, 6, 8, 16, 32] };
    let subjects: Vec<_> = context.fast_subjects().into_iter().map(|subject| (subject.clocks(), subject)).collect();
    let all_threads = std::thread::available_parallelism().map_or(1, usize::from);
    let clocks: usize = subjects.iter().map(|(clocks, _)| clocks.len()).sum();
    let bar = context.bar("scaleup", clocks * 2 * copies.len() + all_threads)?;
    let mut rows: Vec<Row> = Vec::new();
    let mut threads: Vec<ThreadsRow> = Vec::new();
    for (clocks, subject) in &subjects {
        context.check(subject, SmoothParams::paper(), input)?;
        for (how, &clock) in [How::Tall, How::Batch].into_iter().flat_map(|how| clocks.iter().map(move |c| (how, c))) {
            let mut one_ms = f64::NAN;
            for &copies in copies.iter().filter(|_| !context.stopped()) {
                let row = of_copies(context, subject, clock, input, how, copies, &mut one_ms)?;
                rows.push(row);
                bar.inc(1);
            }
        }
        if subject.options.engine != Engine::Cpu {
            continue;
        }
        for count in (1..=all_threads).filter(|_| !context.stopped()) {
            let options = SmootherOptions { threads: Some(count), ..subject.options.clone() };
            let subject = Subject { options, ..subject.clone() };
            let alone = Load::Alone(input.frame());
            let (time, _) = context.time_load(&subject, Clock::Host, SmoothParams::paper(), alone)?;
            let one_ms = threads.first().map_or(time.ms.median, |one: &ThreadsRow| one.time.ms.median);
            threads.push(ThreadsRow { threads: count, time, speedup: one_ms / time.ms.median });
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    section.note(format!(
        "{}, several times over: as points in one tall cloud, on a GPU read in place, and in a batch of frames, copied out; window 3, \
         degree 3, 3 cm. Scale-up is the copies times the time of one over the time of all.",
        input.describe()
    ));
    section.table(
        &["engine", "as", "copies", "ms", "ns a pixel", "scale-up", "engine's buffers, MiB", "process, MiB"],
        rows.iter().map(cells),
    );
    if !threads.is_empty() {
        let of_row = |row: &ThreadsRow| vec![row.threads.to_string(), row.time.cell(), format!("{:.2}", row.speedup)];
        section.table(&["threads of the CPU engine", "ms", "speedup"], threads.iter().map(of_row));
    }
    section.note_noise(rows.iter().map(|row| row.time.noisy).chain(threads.iter().map(|row| row.time.noisy)));
    let same_line = |a: &Row, b: &Row| line_name(a) == line_name(b);
    let line = |rows: &[Row]| {
        let points = rows.iter().map(|row| (row.copies as f64, row.scaleup)).collect();
        rows.first().map(|row| (line_name(row), points))
    };
    let of_lines: Vec<_> = rows.chunk_by(same_line).filter_map(line).collect();
    if !of_lines.is_empty() {
        section.svg("scaleup.svg", "Scale-up over copies", lines("Scale-up", "copies", "1 is linear", &of_lines)?);
    }
    section.json = serde_json::to_value(Results { copies: rows, threads })?;
    Ok(section)
}

/// Times `copies` of a frame; `one_ms` is the time of one, which comes first.
fn of_copies(
    context: &Bench<'_>,
    subject: &Subject,
    clock: Clock,
    input: &Input,
    how: How,
    copies: usize,
    one_ms: &mut f64,
) -> Result<Row> {
    let (tall, batch);
    let load = match how {
        How::Tall => {
            tall = one_under_the_other(&input.cloud, copies)?;
            Load::Alone(Frame::from(&tall))
        }
        How::Batch => {
            batch = vec![input.frame(); copies];
            Load::Batch(&batch)
        }
    };
    let (time, bytes) = context.time_load(subject, clock, SmoothParams::paper(), load)?;
    let ms = time.ms.median;
    if copies == 1 {
        *one_ms = ms;
    }
    Ok(Row {
        engine: subject.name_by(clock),
        how,
        copies,
        time,
        nanoseconds_a_pixel: 1e6 * ms / (input.cloud.points.len() * copies) as f64,
        scaleup: copies as f64 * *one_ms / ms,
        buffers_mib: bytes as f64 / f64::from(1 << 20),
        process_mib: resident_mib(),
    })
}

fn line_name(row: &Row) -> String {
    format!("{}, {}", row.engine, row.how.name())
}

fn cells(row: &Row) -> Vec<String> {
    let process = row.process_mib.map_or("-".into(), |mib| format!("{mib:.0}"));
    vec![
        row.engine.clone(),
        row.how.name().to_owned(),
        row.copies.to_string(),
        row.time.cell(),
        format!("{:.3}", row.nanoseconds_a_pixel),
        format!("{:.3}", row.scaleup),
        format!("{:.0}", row.buffers_mib),
        process,
    ]
}

/// A cloud `copies` times in one.
fn one_under_the_other(cloud: &OrganizedCloud, copies: usize) -> Result<OrganizedCloud> {
    let Xyz { x, y, z } = cloud.positions();
    let positions = Xyz { x: x.repeat(copies), y: y.repeat(copies), z: z.repeat(copies) };
    let tall = OrganizedCloud::from_positions(cloud.width(), copies * cloud.height(), positions);
    Ok(tall.map_err(Error::from)?)
}

/// What the process has in memory, by the system's word; `None` where it has none.
fn resident_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}
