//! The picture of the 2011 report: a raw and a smoothed frame, and the flatness of its largest plane before and after
//! smoothing.

use anyhow::Result;
use planish::evaluate::largest_plane;
use planish::render::{difference_normals, half_size, relief, side_by_side};
use planish::{Engine, FrameParams, Xyz};
use serde::Serialize;

use super::engines::subjects;
use super::experiment::Bench;
use super::section::{Drawing, Figure, Section};

#[derive(Serialize)]
struct Row {
    frame: String,
    setting: &'static str,
    /// Number of points on the largest plane of the raw frame.
    points: usize,
    raw_variance_mm2: f64,
    smoothed_variance_mm2: f64,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("quality", "Quality");
    // The default is the CPU engine, which is available everywhere.
    let asked = &context.options.engines;
    let by_cpu = asked.is_empty() || asked.contains(&Engine::Cpu) || asked.contains(&Engine::Auto);
    let subjects = if by_cpu { subjects(&[Engine::Cpu], false)? } else { context.subjects(false)? };
    let subject = subjects.into_iter().next();
    let Some(subject) = subject else { return Ok(section) };
    let mut rows = Vec::new();
    for (i, input) in context.inputs.iter().enumerate().filter(|_| !context.stopped()) {
        let (width, height) = input.shape();
        let Some(plane) = largest_plane(&input.cloud).filter(|_| height > 1) else {
            section.note(format!("{}: no plane was found.", input.describe()));
            continue;
        };
        let bumps = |points: &Xyz| relief(width, height, &difference_normals(width, height, points));
        let mut pictures = vec![bumps(input.cloud.positions())];
        for (setting, params) in
            [("paper", FrameParams::paper()), ("default", FrameParams::default().at_resolution_of(input.frame()?))]
        {
            let mut points = Xyz::default();
            let smoothed = context.smooth(&subject, params, input, &mut points);
            if context.attempt(&subject.name, smoothed)?.is_none() {
                continue;
            }
            rows.push(Row {
                frame: input.name().to_owned(),
                setting,
                points: plane.pixels.len(),
                raw_variance_mm2: 1e6 * plane.variance_m2(input.cloud.positions()),
                smoothed_variance_mm2: 1e6 * plane.variance_m2(&points),
            });
            pictures.push(bumps(&points));
        }
        section.figures.push(Figure {
            file: format!("quality-{i}.png"),
            title: format!("Relief of {}: raw, paper, default", input.name()),
            content: Drawing::Png(half_size(&side_by_side(&pictures))),
        });
    }
    section.note(format!(
        "The table shows the variance of the points around the largest plane before and after smoothing (engine: {}). \
         The pictures (half size) show the frame raw, with the paper setting and with the default.",
        subject.name
    ));
    section.table(
        &["frame", "setting", "points", "raw, mm²", "smoothed, mm²", "share"],
        rows.iter().map(|row| {
            let (raw, smoothed) = (row.raw_variance_mm2, row.smoothed_variance_mm2);
            let share = format!("{:.0} %", 100.0 * smoothed / raw);
            let (raw, smoothed) = (format!("{raw:.2}"), format!("{smoothed:.2}"));
            vec![row.frame.clone(), row.setting.into(), row.points.to_string(), raw, smoothed, share]
        }),
    );
    section.note("In the 2011 report, the plane kept about half of its variance.");
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}
