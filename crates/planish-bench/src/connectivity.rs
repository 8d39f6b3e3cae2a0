//! Experiment 2: time per frame by the number of candidates in a window.

use anyhow::Result;
use planish::{Engine, FrameParams, FrameRadius};
use serde::Serialize;

use super::engines::Clock;
use super::experiment::{Bench, Frames};
use super::plot::{line_through, lines};
use super::section::Section;
use super::timing::Timing;

/// R² of the straight line in the 2011 report.
const REPORT_R2: f64 = 0.96;
/// Radius in the 2011 report, in metres per pixel of the window's half-width.
const RADIUS_M_A_STEP: f32 = 0.01;

#[derive(Serialize)]
struct Curve {
    #[serde(skip)]
    subject: usize,
    #[serde(skip)]
    clock: Clock,
    engine: String,
    degree: u32,
    candidates: Vec<usize>,
    times: Vec<Timing>,
    /// Intercept of the linear fit through the medians, in milliseconds.
    intercept_ms: f64,
    /// Slope of the linear fit, in milliseconds per candidate.
    slope_ms: f64,
    /// R² of the linear fit.
    r2: f64,
}

impl Curve {
    fn points(&self) -> Vec<(f64, f64)> {
        self.candidates.iter().zip(&self.times).map(|(&n, time)| (n as f64, time.ms.median)).collect()
    }
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("connectivity", "Connectivity");
    let Some(input) = context.inputs.last() else { return Ok(section) };
    let windows: Vec<u32> = if context.options.quick { vec![1, 3, 5, 7] } else { (1..=7).collect() };
    let mut subjects = context.subjects(false)?;
    subjects.retain(|subject| !context.options.quick || subject.options.engine != Engine::Reference);
    let mut curves = Vec::new();
    for (number, subject) in subjects.iter().enumerate() {
        for clock in subject.clocks()? {
            curves.extend([2, 3].map(|degree| Curve {
                subject: number,
                clock,
                engine: subject.name_by(clock),
                degree,
                candidates: Vec::new(),
                times: Vec::new(),
                intercept_ms: f64::NAN,
                slope_ms: f64::NAN,
                r2: f64::NAN,
            }));
        }
    }
    let bar = context.bar("connectivity", curves.len() * windows.len())?;
    // All engines are measured at one setting before the next, so the reference computes each setting only once.
    for (degree, &window) in [2, 3].into_iter().flat_map(|degree| windows.iter().map(move |window| (degree, window))) {
        let radius = FrameRadius::Fixed { radius_m: RADIUS_M_A_STEP * window as f32 };
        let params = FrameParams::paper().with_window(window).with_degree(degree).with_radius(radius);
        for curve in curves.iter_mut().filter(|curve| curve.degree == degree && !context.stopped()) {
            let timed = context.time_frames(&subjects[curve.subject], curve.clock, params, input, Frames::One);
            let what = format!("{}, degree {degree}, window {window}", curve.engine);
            if let Some(timed) = context.attempt(&what, timed)? {
                curve.times.push(timed.time);
                curve.candidates.push(params.window.nominal().samples());
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    if subjects.is_empty() {
        section.note("Not run with the reference engine alone in a quick run.");
    }
    curves.retain(|curve| curve.times.len() > 2);
    for curve in &mut curves {
        (curve.intercept_ms, curve.slope_ms, curve.r2) = line_through(&curve.points());
    }
    section.note(format!(
        "The table shows the time per frame in milliseconds for each number of candidates in the window ({}; the \
         radius is 1 cm times the half-width in pixels).",
        input.describe()
    ));
    let mut header = vec!["engine, degree".to_owned()];
    let candidates: Vec<usize> = windows.iter().map(|k| ((2 * k + 1) * (2 * k + 1)) as usize).collect();
    header.extend(candidates.iter().map(usize::to_string));
    header.extend(["per candidate, µs", "R²"].map(str::to_owned));
    section.table(
        &header.iter().map(String::as_str).collect::<Vec<_>>(),
        curves.iter().map(|curve| {
            let of = |n: &usize| curve.candidates.iter().position(|of| of == n).map(|at| curve.times[at].cell());
            let mut cells = vec![format!("{}, {}", curve.engine, curve.degree)];
            cells.extend(candidates.iter().map(|n| of(n).unwrap_or_default()));
            cells.extend([format!("{:.2}", 1e3 * curve.slope_ms), format!("{:.4}", curve.r2)]);
            cells
        }),
    );
    section.note(format!(
        "The last two columns are the slope and R² of a linear fit. The report's R² was {REPORT_R2}. GPU results are \
         read in place, and the transfer takes the same time for every window. The kernel alone is timed by the \
         device's clock, after the frame has been copied to the device."
    ));
    section.note_noise(curves.iter().flat_map(|curve| curve.times.iter().map(|time| time.noisy)));
    for (i, of_engine) in curves.chunk_by(|a, b| a.subject == b.subject).enumerate() {
        let named: Vec<_> =
            of_engine.iter().map(|c| (format!("{}, degree {}", c.engine, c.degree), c.points())).collect();
        let title = format!("Time per frame over candidates, {}", subjects[of_engine[0].subject].name);
        section.svg(&format!("connectivity-{i}.svg"), &title, lines(&title, "candidates", "ms", &named)?);
    }
    section.json = serde_json::to_value(&curves)?;
    Ok(section)
}
