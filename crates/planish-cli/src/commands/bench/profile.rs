//! The profile: where the time of one frame goes.

use anyhow::Result;
use planish::{FrameTimings, SmoothParams, Smoothed};
use serde::Serialize;

use super::Spread;
use super::experiment::{Bench, Patience, Subject, ms, touch};
use super::frames::Input;
use super::plot::{Scale, bars};
use super::section::Section;

#[derive(Serialize)]
struct Row {
    engine: String,
    stages: Vec<Stage>,
}

#[derive(Serialize)]
struct Stage {
    name: &'static str,
    ms: f64,
}

/// Medians over many frames, in milliseconds.
struct Times {
    /// By the host's clock.
    whole: f64,
    upload: f64,
    kernel: f64,
    readback: f64,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("profile", "Profile");
    let Some(input) = context.inputs.first() else { return Ok(section) };
    let subjects = context.fast_subjects();
    let bar = context.bar("profile", subjects.len())?;
    let mut rows = Vec::new();
    for subject in subjects.iter().filter(|_| !context.stopped()) {
        context.check(subject, SmoothParams::paper(), input)?;
        let stages = if !subject.is_gpu() {
            of_cpu(context, subject, input)?
        } else if subject.clocks().len() > 1 {
            of_gpu(context, subject, input)?
        } else {
            section.note(format!("{} takes no time stamps.", subject.name));
            continue;
        };
        rows.push(Row { engine: subject.name.clone(), stages });
        bar.inc(1);
    }
    bar.finish_and_clear();
    section.note(format!(
        "{}; window 3, degree 3, 3 cm. Neighbours and plane are what a frame of planes alone takes (degree 1), polynomial and solve \
         the difference. A CPU's stages follow each other; its results are written where they are wanted. A GPU's copies are \
         made stages of their own for this (its kernel otherwise reads and writes the host's memory itself); copying out is what a \
         frame takes longer by it than one that is read where the device puts it.",
        input.describe()
    ));
    section.table(
        &["engine", "stage", "ms", "share"],
        rows.iter().flat_map(|row| {
            let total: f64 = row.stages.iter().map(|stage| stage.ms).sum();
            row.stages.iter().map(move |stage| {
                let share = format!("{:.1} %", 100.0 * stage.ms / total);
                vec![row.engine.clone(), stage.name.into(), format!("{:.3}", stage.ms), share]
            })
        }),
    );
    for (i, row) in rows.iter().enumerate() {
        let title = format!("Where a frame's time goes, {}", row.engine);
        let stages: Vec<_> = row.stages.iter().map(|stage| (stage.name.to_owned(), stage.ms)).collect();
        section.svg(&format!("profile-{i}.svg"), &title, bars(&title, "ms", Scale::FromZero, &stages, &[])?);
    }
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}

fn of_cpu(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Vec<Stage>> {
    let [planes, all] = times_of(|params| times(context, subject, input, params, false))?;
    Ok(vec![
        Stage { name: "copy in, deproject", ms: all.upload },
        Stage { name: "neighbours and plane", ms: planes.kernel },
        Stage { name: "polynomial and solve", ms: (all.kernel - planes.kernel).max(0.0) },
        Stage { name: "threads: start and end", ms: (all.whole - all.upload - all.kernel).max(0.0) },
    ])
}

fn of_gpu(context: &Bench<'_>, subject: &Subject, input: &Input) -> Result<Vec<Stage>> {
    let [planes, all] = times_of(|params| times(context, subject, input, params, true))?;
    let copied_out = times(context, subject, input, SmoothParams::paper(), false)?.whole;
    let stage = |name, ms: f64| Stage { name, ms: ms.max(0.0) };
    Ok(vec![
        stage("copy to the device", all.upload),
        stage("deproject, neighbours and plane", planes.kernel),
        stage("polynomial and solve", all.kernel - planes.kernel),
        stage("copy to the host", all.readback),
        stage("host: write, submit, wait", all.whole - all.upload - all.kernel - all.readback),
        stage("host: copy the result out", copied_out - all.whole),
    ])
}

/// Of planes alone, and of all.
fn times_of(times: impl Fn(SmoothParams) -> Result<Times>) -> Result<[Times; 2]> {
    Ok([times(SmoothParams { degree: 1, ..SmoothParams::paper() })?, times(SmoothParams::paper())?])
}

/// The times of a frame, read where the device puts it or copied out.
fn times(context: &Bench<'_>, subject: &Subject, input: &Input, params: SmoothParams, in_place: bool) -> Result<Times> {
    let mut smoother = subject.with_time_stamps().open(params, input.shape())?;
    let mut smoothed = Smoothed::default();
    let mut stages: Vec<FrameTimings> = Vec::new();
    let timing = context.time(Patience::Short, || {
        if in_place {
            smoother.submit_in_place(input.frame())?;
            let view = smoother.receive()?;
            view.iter().for_each(touch);
            stages.extend(view.and_then(|view| view.timings()));
        } else {
            smoother.smooth(input.frame(), &mut smoothed)?;
            stages.extend(smoother.timings());
        }
        Ok(())
    })?;
    let median = |of: fn(&FrameTimings) -> std::time::Duration| match &stages[..] {
        [] => f64::NAN,
        stages => Spread::of(stages.iter().map(|times| ms(of(times))).collect()).median,
    };
    let (upload, kernel, readback) = (median(|t| t.upload), median(|t| t.kernel), median(|t| t.readback));
    Ok(Times { whole: timing.ms.median, upload, kernel, readback })
}
