//! The profile: time per frame in each stage.

use anyhow::{Result, bail};
use planish::{FrameParams, FrameTimings};
use serde::Serialize;

use super::engines::{Clock, Subject};
use super::experiment::{Bench, Frames, Timed, ms};
use super::frames::Input;
use super::plot::{Scale, bars};
use super::section::Section;
use super::timing::{Spread, milliseconds};

#[derive(Serialize)]
struct Row {
    engine: String,
    stages: Vec<Stage>,
    noisy: bool,
}

#[derive(Serialize)]
struct Stage {
    name: &'static str,
    ms: f64,
}

/// Median time per frame in each stage, in milliseconds.
struct Stages {
    upload: f64,
    kernel: f64,
    readback: f64,
    /// Sum of upload, kernel and readback.
    engine: f64,
    /// Time for the whole frame, by the host's clock.
    whole: f64,
    noisy: bool,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("profile", "Profile");
    let Some(input) = context.inputs.first() else { return Ok(section) };
    let subjects = context.fast_subjects()?;
    let bar = context.bar("profile", subjects.len())?;
    let mut rows = Vec::new();
    for subject in subjects.iter().filter(|_| !context.stopped()) {
        bar.inc(1);
        if subject.is_gpu() && !subject.clocks()?.contains(&Clock::Device) {
            section.note(format!("{} has no timestamps.", subject.name));
            continue;
        }
        let row = if subject.is_gpu() { of_gpu(context, subject, input) } else { of_cpu(context, subject, input) };
        rows.extend(context.attempt(&subject.name, row)?);
    }
    bar.finish_and_clear();
    section.note(format!(
        "The table shows the time of each stage ({}; window 3, degree 3, 3 cm). The stage \"neighbours and plane\" is \
         timed with degree 1; \"polynomial and solve\" is the additional time with degree 3. A CPU's stages run one \
         after the other and write results directly to the output. For this measurement, a GPU's copies are separate \
         stages (its kernel otherwise reads and writes host memory). \"Copy the result out\" is the additional time \
         compared with reading in place. The report does not state the shares of its stages.",
        input.describe()
    ));
    if subjects.is_empty() {
        section.note("Not run with the reference engine alone.");
    }
    section.table(
        &["engine", "stage", "ms", "share"],
        rows.iter().flat_map(|row| {
            let total: f64 = row.stages.iter().map(|stage| stage.ms).sum();
            row.stages.iter().map(move |stage| {
                let share = format!("{:.1} %", 100.0 * stage.ms / total);
                let mark = if row.noisy { " ~" } else { "" };
                vec![row.engine.clone(), stage.name.into(), milliseconds(stage.ms) + mark, share]
            })
        }),
    );
    section.note_noise(rows.iter().map(|row| row.noisy));
    for (i, row) in rows.iter().enumerate() {
        let title = format!("Time per stage, {}", row.engine);
        let stages: Vec<_> = row.stages.iter().map(|stage| (stage.name.to_owned(), stage.ms)).collect();
        section.svg(&format!("profile-{i}.svg"), &title, bars(&title, "ms", Scale::FromZero, &stages, &[])?);
    }
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}

fn of_cpu(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Row> {
    let planes = stages(context, subject, input, 1, Frames::One)?;
    let all = stages(context, subject, input, 3, Frames::One)?;
    Ok(Row {
        engine: subject.name.clone(),
        noisy: planes.noisy || all.noisy,
        stages: vec![
            Stage { name: "copy in, deproject", ms: all.upload },
            Stage { name: "neighbours and plane", ms: planes.kernel },
            Stage { name: "polynomial and solve", ms: all.kernel - planes.kernel },
            Stage { name: "allocation of the result, start of the threads", ms: all.whole - all.engine },
        ],
    })
}

fn of_gpu(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Row> {
    let planes = stages(context, subject, input, 1, Frames::One)?;
    let all = stages(context, subject, input, 3, Frames::One)?;
    let copied_out = stages(context, subject, input, 3, Frames::OneCopiedOut)?;
    Ok(Row {
        engine: subject.name.clone(),
        noisy: planes.noisy || all.noisy || copied_out.noisy,
        stages: vec![
            Stage { name: "copy to the device", ms: all.upload },
            Stage { name: "deproject, neighbours and plane", ms: planes.kernel },
            Stage { name: "polynomial and solve", ms: all.kernel - planes.kernel },
            Stage { name: "copy to the host", ms: all.readback },
            Stage { name: "host: write, submit, wait", ms: all.whole - all.engine },
            Stage { name: "host: copy the result out", ms: copied_out.whole - all.whole },
        ],
    })
}

/// Times the stages of smoothing a frame with polynomials of the given degree.
fn stages(context: &Bench<'_>, subject: &Subject, input: &Input, degree: u32, frames: Frames) -> Result<Stages> {
    let params = FrameParams::paper().with_degree(degree);
    let stamped = subject.with_time_stamps();
    let Timed { time, stages, .. } = context.time_frames(&stamped, Clock::Host, params, input, frames)?;
    if stages.is_empty() {
        bail!("{}: the device returned no timestamps", subject.name);
    }
    let median = |of: &dyn Fn(&FrameTimings) -> f64| Spread::of(stages.iter().map(of).collect()).median;
    Ok(Stages {
        upload: median(&|times| ms(times.upload)),
        kernel: median(&|times| ms(times.kernel)),
        readback: median(&|times| ms(times.readback)),
        engine: median(&|times| ms(times.upload + times.kernel + times.readback)),
        whole: time.ms.median,
        noisy: time.noisy,
    })
}
