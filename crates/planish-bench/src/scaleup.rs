//! Experiment 3: time for several copies of the scene, as one tall cloud and as a batch, and of the CPU engine by
//! number of threads.

use anyhow::Result;
use planish::{Engine, FrameParams};
use serde::Serialize;

use super::engines::{Clock, Subject};
use super::experiment::{Bench, Frames};
use super::frames::Input;
use super::plot::lines;
use super::section::Section;
use super::timing::{Timing, milliseconds};

#[derive(Serialize)]
struct Row {
    engine: String,
    how: &'static str,
    copies: usize,
    time: Timing,
    nanoseconds_a_pixel: f64,
    /// Scale-up = copies x t(1) / t(copies).
    scaleup: f64,
    /// Size of the engine's buffers in MiB, on the device or on the host.
    buffers_mib: f64,
    /// Resident host memory of the process in MiB, if the system reports it.
    process_mib: Option<f64>,
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

/// Number of threads up to which every count is timed; above it, only powers of two and the maximum are.
const EACH_UP_TO: usize = 16;
/// Relative difference between the first and the last time on one thread above which the report notes the drift.
const THREADS_DRIFT: f64 = 0.05;

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("scaleup", "Scale-up");
    let Some(input) = context.inputs.first() else { return Ok(section) };
    let copies: &[usize] = if context.options.quick { &[1, 2, 4, 6, 8] } else { &[1, 2, 4, 6, 8, 16, 32] };
    let mut clocked = Vec::new();
    for subject in context.fast_subjects()? {
        for clock in subject.clocks()? {
            clocked.push((subject.clone(), clock));
        }
    }
    let bar = context.bar("scaleup", clocked.len() * 2 * copies.len())?;
    let mut rows: Vec<Row> = Vec::new();
    let ways = [("tall", Frames::Tall as fn(usize) -> Frames), ("batch", Frames::Batch)];
    for ((subject, clock), (how, frames)) in clocked.iter().flat_map(|of| ways.map(|way| (of, way))) {
        let mut one_ms = None;
        for &copies in copies.iter().filter(|_| !context.stopped()) {
            let engine = subject.name_by(*clock);
            let timed = context.time_frames(subject, *clock, FrameParams::paper(), input, frames(copies));
            bar.inc(1);
            let Some(timed) = context.attempt(&format!("{engine}, {how}, {copies} copies"), timed)? else { continue };
            let ms = timed.time.ms.median;
            rows.push(Row {
                engine,
                how,
                copies,
                time: timed.time,
                nanoseconds_a_pixel: 1e6 * ms / (input.cloud.points.len() * copies) as f64,
                scaleup: copies as f64 * *one_ms.get_or_insert(ms / copies as f64) / ms,
                buffers_mib: timed.buffer_bytes as f64 / f64::from(1 << 20),
                process_mib: timed.process_mib,
            });
        }
    }
    bar.finish_and_clear();
    section.note(format!(
        "Several copies of a frame ({}; window 3, degree 3, 3 cm) are smoothed: as points in one tall cloud (on a GPU \
         read in place), and as a batch of frames (copied out). Scale-up = copies x t(1) / t(copies). A GPU's kernel \
         alone is timed by the device's clock, after the frames have been copied to the device.",
        input.describe()
    ));
    if clocked.is_empty() {
        section.note("Not run with the reference engine alone.");
    }
    section.table(
        &["engine", "layout", "copies", "ms", "ns per pixel", "scale-up", "engine's buffers, MiB", "process, MiB"],
        rows.iter().map(cells),
    );
    let mut threads = Vec::new();
    for (subject, _) in clocked.iter().filter(|(subject, _)| subject.options.engine == Engine::Cpu) {
        threads = over_threads(context, subject, input, &mut section)?;
    }
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

/// Times a frame on different numbers of threads. One thread is timed again at the end, to detect a change in the
/// machine's speed.
fn over_threads(
    context: &Bench<'_>,
    subject: &Subject,
    input: &Input,
    section: &mut Section,
) -> Result<Vec<ThreadsRow>> {
    let all = std::thread::available_parallelism().map_or(1, usize::from);
    let each_up_to = if context.options.quick { 1 } else { EACH_UP_TO };
    let counts = (1..=all).filter(|&n| n <= each_up_to || n.is_power_of_two() || n == all);
    let bar = context.bar("threads", counts.clone().count() + 1)?;
    let time = |count: usize| {
        let options = subject.options.clone().with_threads(Some(count));
        let subject = Subject { options, ..subject.clone() };
        let timed = context.time_frames(&subject, Clock::Host, FrameParams::paper(), input, Frames::One);
        bar.inc(1);
        Ok::<_, anyhow::Error>(context.attempt(&format!("{count} threads"), timed)?.map(|timed| timed.time))
    };
    let mut rows: Vec<ThreadsRow> = Vec::new();
    for count in counts.filter(|_| !context.stopped()) {
        let Some(time) = time(count)? else { continue };
        let one_ms = rows.first().map_or(time.ms.median, |one| one.time.ms.median);
        rows.push(ThreadsRow { threads: count, time, speedup: one_ms / time.ms.median });
    }
    let again = if rows.len() > 1 && !context.stopped() { time(1)? } else { None };
    bar.finish_and_clear();
    if let (Some(again), Some(first)) = (again, rows.first()) {
        let (first, again) = (first.time.ms.median, again.ms.median);
        if (again / first - 1.0).abs() > THREADS_DRIFT {
            section.note(format!(
                "One thread took {} ms at the start and {} ms at the end: the machine's speed changed while the table \
                 of threads was measured.",
                milliseconds(first),
                milliseconds(again)
            ));
        }
    }
    Ok(rows)
}

fn line_name(row: &Row) -> String {
    format!("{}, {}", row.engine, row.how)
}

fn cells(row: &Row) -> Vec<String> {
    let process = row.process_mib.map_or("-".into(), |mib| format!("{mib:.0}"));
    vec![
        row.engine.clone(),
        row.how.to_owned(),
        row.copies.to_string(),
        row.time.cell(),
        format!("{:.3}", row.nanoseconds_a_pixel),
        format!("{:.3}", row.scaleup),
        format!("{:.0}", row.buffers_mib),
        process,
    ]
}
