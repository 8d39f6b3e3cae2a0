//! The profile: where the time of one frame goes.

use anyhow::Result;
use planish::{Engine, OrganizedCloud, SmoothParams, Smoothed, Smoother, SmootherOptions, Transfer, Xyz};
use serde::Serialize;

use super::experiment::{Bench, Section, Subject};

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

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section { name: "profile", ..Section::default() };
    section.text = "## Profile\n".to_owned();
    let Some(input) = context.inputs.first() else { return Ok(section) };
    let subjects: Vec<_> =
        context.subjects(false).into_iter().filter(|subject| subject.options.engine != Engine::Reference).collect();
    let bar = context.bar("profile", subjects.len())?;
    let mut rows = Vec::new();
    for subject in subjects.iter().filter(|_| !context.stopped()) {
        context.check(subject, SmoothParams::paper(), input)?;
        rows.push(Row { engine: subject.name.clone(), stages: stages(context, subject, &input.cloud)? });
        bar.inc(1);
    }
    bar.finish_and_clear();
    section.note(format!(
        "{}, window 3, degree 3, 3 cm. A CPU's stages are differences of whole frames: one of holes alone, which is copied in and \
         out, one smoothed by planes, and the frame itself. A GPU's are its time stamps, its kernel's are divided as \
         the time of planes alone says, and what the host waits beside them is the rest.",
        input.name
    ));
    section.table(
        &["engine", "stage", "ms", "share"],
        rows.iter().flat_map(|row| {
            let total: f64 = row.stages.iter().map(|stage| stage.ms).sum();
            row.stages.iter().map(move |stage| {
                let share = format!("{:.0} %", 100.0 * stage.ms / total);
                vec![row.engine.clone(), stage.name.into(), format!("{:.3}", stage.ms), share]
            })
        }),
    );
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}

fn stages(context: &Bench<'_>, subject: &Subject, cloud: &OrganizedCloud) -> Result<Vec<Stage>> {
    let planes = SmoothParams { degree: 1, ..SmoothParams::paper() };
    let whole = |params: SmoothParams, options: &SmootherOptions, cloud: &OrganizedCloud| -> Result<(f64, [f64; 3])> {
        let mut smoother = Smoother::open_with(params, options, (cloud.width(), cloud.height()))?;
        let mut smoothed = Smoothed::default();
        let mut stamps: Vec<[f64; 3]> = Vec::new();
        let timing = context.time(|| {
            smoother.smooth(cloud, &mut smoothed)?;
            let ms = |time: std::time::Duration| 1e3 * time.as_secs_f64();
            stamps.extend(smoother.timings().map(|t| [ms(t.upload), ms(t.kernel), ms(t.readback)]));
            Ok(())
        })?;
        let median = |k: usize| {
            let mut values: Vec<f64> = stamps.iter().map(|stamp| stamp[k]).collect();
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(0.0)
        };
        Ok((timing.ms.median, [median(0), median(1), median(2)]))
    };
    if subject.options.engine == Engine::Gpu {
        let mut options = subject.options.clone();
        options.gpu.timestamps = true;
        // The copies are stages of their own only where they are made.
        options.gpu.transfer = Transfer::Staged;
        let (total, [upload, kernel, readback]) = whole(SmoothParams::paper(), &options, cloud)?;
        let (_, [_, planes, _]) = whole(planes, &options, cloud)?;
        let stage = |name, ms: f64| Stage { name, ms: ms.max(0.0) };
        return Ok(vec![
            stage("copy to the device", upload),
            stage("neighbours and plane", planes),
            stage("polynomial and solve", kernel - planes),
            stage("copy back", readback),
            stage("host: write, submit, wait, copy out", total - upload - kernel - readback),
        ]);
    }
    let holes = Xyz::filled(cloud.points.len(), f32::NAN);
    let holes = OrganizedCloud::from_positions(cloud.width(), cloud.height(), holes).map_err(planish::Error::from)?;
    let (copies, _) = whole(SmoothParams::paper(), &subject.options, &holes)?;
    let (to_planes, _) = whole(planes, &subject.options, cloud)?;
    let (total, _) = whole(SmoothParams::paper(), &subject.options, cloud)?;
    Ok(vec![
        Stage { name: "copy in and out", ms: copies },
        Stage { name: "neighbours and plane", ms: (to_planes - copies).max(0.0) },
        Stage { name: "polynomial and solve", ms: (total - to_planes).max(0.0) },
    ])
}
