//! Experiment 2: how the time grows with the number of candidates.

use anyhow::Result;
use planish::{Engine, Radius, SmoothParams, Smoothed, Smoother};
use serde::Serialize;

use super::experiment::{Bench, Section, Timing, cell, line_through, plot};

/// The 2011 report's fit of a straight line.
const REPORT_R2: f64 = 0.96;
/// The report's radius: so much for each step of the window.
const RADIUS_M_A_STEP: f32 = 0.01;

#[derive(Serialize)]
struct Curve {
    engine: String,
    degree: u32,
    candidates: Vec<usize>,
    times: Vec<Timing>,
    /// Of the straight line through the medians: milliseconds, milliseconds a candidate, R².
    intercept_ms: f64,
    slope_ms: f64,
    r2: f64,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section { name: "connectivity", ..Section::default() };
    section.text = "## Connectivity\n".to_owned();
    let Some(input) = context.inputs.last() else { return Ok(section) };
    let windows: Vec<u32> = if context.args.quick { vec![1, 3, 5, 7] } else { (1..=7).collect() };
    // The reference takes seconds where the others take milliseconds.
    let subjects: Vec<_> = context
        .subjects(false)
        .into_iter()
        .filter(|s| !context.args.quick || s.options.engine != Engine::Reference)
        .collect();
    let bar = context.bar("connectivity", subjects.len() * 2 * windows.len())?;
    let mut curves = Vec::new();
    for subject in &subjects {
        for degree in [2, 3] {
            let mut curve = Curve {
                engine: subject.name.clone(),
                degree,
                candidates: Vec::new(),
                times: Vec::new(),
                intercept_ms: f64::NAN,
                slope_ms: f64::NAN,
                r2: f64::NAN,
            };
            for &window in &windows {
                if context.stopped() {
                    break;
                }
                let radius = Radius::Fixed { radius_m: RADIUS_M_A_STEP * window as f32 };
                let params = SmoothParams { window, degree, radius, ..SmoothParams::paper() };
                context.check(subject, params, input)?;
                let shape = (input.cloud.width(), input.cloud.height());
                let mut smoother = Smoother::open_with(params, &subject.options, shape)?;
                let mut smoothed = Smoothed::default();
                curve.times.push(context.time(|| Ok(smoother.smooth(&input.cloud, &mut smoothed)?))?);
                curve.candidates.push(params.candidates());
                bar.inc(1);
            }
            if curve.times.len() > 2 {
                (curve.intercept_ms, curve.slope_ms, curve.r2) = line_through(&points(&curve));
                curves.push(curve);
            }
        }
    }
    bar.finish_and_clear();
    section.note(format!("Time of a frame over the candidates of its window, on {}; radius 1 cm a step.", input.name));
    let mut header = vec!["engine, degree".to_owned()];
    header.extend(windows.iter().map(|k| format!("{}", (2 * k + 1) * (2 * k + 1))));
    header.extend(["a candidate, µs", "R²"].map(str::to_owned));
    section.table(
        &header.iter().map(String::as_str).collect::<Vec<_>>(),
        curves.iter().map(|curve| {
            let mut cells = vec![format!("{}, {}", curve.engine, curve.degree)];
            cells.extend(curve.times.iter().map(cell));
            cells.resize(header.len() - 2, String::new());
            cells.extend([format!("{:.1}", 1e3 * curve.slope_ms), format!("{:.4}", curve.r2)]);
            cells
        }),
    );
    section.note(format!(
        "Milliseconds; the last two columns are of the straight line through them. The report's R² was {REPORT_R2}."
    ));
    section.note_noise(curves.iter().flat_map(|curve| curve.times.iter().map(|time| time.noisy)));
    if !curves.is_empty() {
        let lines: Vec<_> = curves.iter().map(|c| (format!("{}, degree {}", c.engine, c.degree), points(c))).collect();
        let svg = plot("Time of a frame over candidates", "candidates", "ms", &lines)?;
        section.files.push(("connectivity.svg".into(), svg));
    }
    section.json = serde_json::to_value(&curves)?;
    Ok(section)
}

fn points(curve: &Curve) -> Vec<(f64, f64)> {
    curve.candidates.iter().zip(&curve.times).map(|(&n, time)| (n as f64, time.ms.median)).collect()
}
