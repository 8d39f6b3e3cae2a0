//! What the experiments share: frames, the engines of this machine, timing, and how results are written.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::agreement::{Agreement, radius_m};
use planish::io::{RgbImage, write_rgb_png};
use planish::simulate::{KinectNoise, KinectSimulator, Scene};
use planish::{
    AdapterKind, Camera, Engine, Error, GpuOptions, OrganizedCloud, Outputs, SimdLevel, SmoothParams, Smoothed,
    Smoother, SmootherOptions, gpu_adapters,
};
use plotters::prelude::{ChartBuilder, Circle, IntoDrawingArea, IntoLogRange, LineSeries, RGBColor, SVGBackend, WHITE};
use plotters::series::PointSeries;
use serde::Serialize;
use serde_json::Value;

use super::Spread;
use crate::args::{EngineArg, ExperimentArgs};

/// A measurement whose halves differ by more than this, or whose spread is wider than the next, is called noisy.
const HALVES_DIFFER: f64 = 0.05;
const WIDE_SPREAD: f64 = 1.5;

/// A frame under a name.
pub struct Input {
    pub name: String,
    pub cloud: OrganizedCloud,
}

/// An engine of this machine.
pub struct Subject {
    pub name: String,
    pub options: SmootherOptions,
}

/// What the experiments run with.
pub struct Bench<'a> {
    pub args: &'a ExperimentArgs,
    pub inputs: Vec<Input>,
    /// Set by Ctrl-C: what is measured until then is kept.
    pub stop: &'a AtomicBool,
}

/// One experiment's results.
#[derive(Default)]
pub struct Section {
    pub name: &'static str,
    pub text: String,
    pub json: Value,
    /// File names and contents of plots.
    pub files: Vec<(String, Vec<u8>)>,
    pub pictures: Vec<(String, RgbImage)>,
}

/// A measured time.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Timing {
    #[serde(flatten)]
    pub ms: Spread,
    pub runs: usize,
    /// The machine did something else in between, or changed its clock.
    pub noisy: bool,
}

impl<'a> Bench<'a> {
    pub fn new(args: &'a ExperimentArgs, stop: &'a AtomicBool) -> Result<Self> {
        let mut inputs = Vec::new();
        for file in &args.input {
            let cloud = OrganizedCloud::read(file).map_err(Error::from)?;
            inputs.push(Input { name: file.file_name().unwrap_or_default().to_string_lossy().into_owned(), cloud });
        }
        if inputs.is_empty() {
            let camera = Camera::kinect_v1();
            for (name, (scene, pose)) in [("simulated room", Scene::room(1)), ("simulated table", Scene::tabletop(1))] {
                let truth = scene.render(&camera, &pose);
                let frame = KinectSimulator::new(KinectNoise::default(), camera, 1).frame(&truth, 0);
                let cloud = frame.and_then(|frame| frame.deproject()).map_err(Error::from)?;
                inputs.push(Input { name: name.to_owned(), cloud });
            }
        }
        Ok(Self { args, inputs, stop })
    }

    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// A bar over so many steps; nothing where standard error is no terminal.
    pub fn bar(&self, name: &'static str, steps: usize) -> Result<ProgressBar> {
        let style = ProgressStyle::with_template("{msg} {bar:30} {pos} of {len}, {eta} left")?;
        Ok(ProgressBar::new(steps as u64).with_style(style).with_message(name))
    }

    /// The engines to measure. CPU engines at every SIMD level and with one and all threads if `all_levels`.
    pub fn subjects(&self, all_levels: bool) -> Vec<Subject> {
        let engines = &self.args.engine;
        let all = engines.is_empty() || engines.contains(&EngineArg::Auto);
        let asked = |engine| all || engines.contains(&engine);
        let base = |engine| SmootherOptions { engine, outputs: Outputs::POINTS, ..SmootherOptions::default() };
        let mut subjects = Vec::new();
        if asked(EngineArg::Reference) {
            subjects.push(Subject { name: "reference (f64)".into(), options: base(Engine::Reference) });
        }
        let all_threads = std::thread::available_parallelism().map_or(1, usize::from);
        if asked(EngineArg::Cpu) {
            let levels: Vec<_> = if all_levels { SimdLevel::available().collect() } else { vec![SimdLevel::best()] };
            let mut threads = if all_levels { vec![1, all_threads] } else { vec![all_threads] };
            threads.dedup();
            for (level, &threads) in levels.iter().flat_map(|level| threads.iter().map(move |threads| (level, threads)))
            {
                let plural = if threads == 1 { "thread" } else { "threads" };
                let name = format!("cpu {}, {threads} {plural}", level.name());
                let options = SmootherOptions { threads: Some(threads), simd: Some(*level), ..base(Engine::Cpu) };
                subjects.push(Subject { name, options });
            }
        }
        if asked(EngineArg::Gpu) {
            for (index, adapter) in gpu_adapters().iter().enumerate() {
                // A software adapter is measured if asked for: it is slower than the CPU that it runs on.
                if adapter.kind == AdapterKind::Software && !self.args.engine.contains(&EngineArg::Gpu) {
                    continue;
                }
                let gpu = GpuOptions { adapter: Some(index.to_string()), ..GpuOptions::default() };
                let options = SmootherOptions { gpu, ..base(Engine::Gpu) };
                subjects.push(Subject { name: format!("gpu {}", adapter.name), options });
            }
        }
        subjects
    }

    /// Holds a subject's result against the reference; a wrong one is an error.
    pub fn check(&self, subject: &Subject, params: SmoothParams, input: &Input) -> Result<()> {
        if subject.options.engine == Engine::Reference {
            return Ok(());
        }
        let shape = (input.cloud.width(), input.cloud.height());
        let result = |options: &SmootherOptions| -> Result<Smoothed> {
            let options = SmootherOptions { outputs: Outputs::ALL, ..options.clone() };
            let mut result = Smoothed::default();
            Smoother::open_with(params, &options, shape)?.smooth(&input.cloud, &mut result)?;
            Ok(result)
        };
        let reference = SmootherOptions { engine: Engine::Reference, ..SmootherOptions::default() };
        let mut agreement = Agreement::default();
        agreement.add(&result(&subject.options)?, &result(&reference)?, radius_m(&input.cloud, params));
        let misses = agreement.misses();
        if !misses.is_empty() {
            bail!("a wrong result is not timed: {}, {}: {}", subject.name, input.name, misses.join("; "));
        }
        Ok(())
    }

    /// Times `work`, which is slow or fast: a hundred runs and more, or as many as there is time for.
    pub fn time(&self, mut work: impl FnMut() -> Result<()>) -> Result<Timing> {
        // A GPU that was idle takes a third of a second to come to its full clock.
        let (runs, limit_ms, warm_up_ms) = if self.args.quick { (20, 400, 100) } else { (200, 10_000, 300) };
        let (limit, warm_up) = (Duration::from_millis(limit_ms), Duration::from_millis(warm_up_ms));
        let start = Instant::now();
        work()?;
        let once = start.elapsed();
        if once > limit {
            // What takes so long is as warm as it gets.
            let ms = Spread::of(vec![1e3 * once.as_secs_f64()]);
            return Ok(Timing { ms, runs: 1, noisy: false });
        }
        while start.elapsed() < warm_up && !self.stopped() {
            work()?;
        }
        let (mut values, start) = (Vec::new(), Instant::now());
        while values.len() < runs && (values.is_empty() || start.elapsed() < limit) {
            let one = Instant::now();
            work()?;
            values.push(1e3 * one.elapsed().as_secs_f64());
            if self.stopped() {
                break;
            }
        }
        let middle = |values: &[f64]| Spread::of(values.to_vec()).median;
        let halves_differ = values.len() >= 8 && {
            let (first, second) = values.split_at(values.len() / 2);
            (middle(first) / middle(second) - 1.0).abs() > HALVES_DIFFER
        };
        let runs = values.len();
        let ms = Spread::of(values);
        Ok(Timing { ms, runs, noisy: halves_differ || (runs >= 8 && ms.p95 > WIDE_SPREAD * ms.p5) })
    }
}

impl Section {
    /// Adds a table: its header, and a row for each of `rows`.
    pub fn table(&mut self, header: &[&str], rows: impl IntoIterator<Item = Vec<String>>) {
        let line = |cells: &mut dyn Iterator<Item = String>| format!("| {} |\n", cells.collect::<Vec<_>>().join(" | "));
        self.text += "\n";
        self.text += &line(&mut header.iter().map(|cell| (*cell).to_owned()));
        self.text += &line(&mut header.iter().map(|_| "---".to_owned()));
        for row in rows {
            self.text += &line(&mut row.into_iter());
        }
    }

    /// Adds a sentence.
    pub fn note(&mut self, text: impl AsRef<str>) {
        self.text += "\n";
        self.text += text.as_ref();
        self.text += "\n";
    }

    /// Says so where measurements were noisy.
    pub fn note_noise(&mut self, timings: impl IntoIterator<Item = bool>) {
        let (all, noisy) = timings.into_iter().fold((0, 0), |(all, noisy), is| (all + 1, noisy + usize::from(is)));
        if noisy > 0 {
            self.note(format!(
                "The machine was not quiet: {noisy} of {all} times varied by more than they should (marked ~)."
            ));
        }
    }

    /// Prints it, and writes it into the folder if there is one.
    pub fn finish(&self, out: Option<&Path>) -> Result<()> {
        println!("{}", self.text.trim_start());
        let Some(folder) = out else { return Ok(()) };
        fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
        let write = |name: &str, bytes: &[u8]| {
            let file = folder.join(name);
            fs::write(&file, bytes).with_context(|| file.display().to_string())
        };
        write(&format!("{}.md", self.name), self.text.trim_start().as_bytes())?;
        write(&format!("{}.json", self.name), serde_json::to_string_pretty(&self.json)?.as_bytes())?;
        self.files.iter().try_for_each(|(name, bytes)| write(name, bytes))?;
        for (name, picture) in &self.pictures {
            write_rgb_png(&folder.join(name), picture).map_err(Error::from)?;
        }
        Ok(())
    }
}

/// A time in a table; `~` where it was noisy.
pub fn cell(timing: &Timing) -> String {
    let ms = timing.ms.median;
    let digits = if ms < 1.0 {
        3
    } else if ms < 100.0 {
        2
    } else {
        0
    };
    format!("{ms:.digits$}{}", if timing.noisy { " ~" } else { "" })
}

/// Lines over x, with a point for each value; y by its logarithm if it spans too much else.
pub fn plot(title: &str, x: &str, y: &str, lines: &[(String, Vec<(f64, f64)>)]) -> Result<Vec<u8>> {
    const COLOURS: [RGBColor; 8] = [
        RGBColor(20, 90, 180),
        RGBColor(200, 80, 30),
        RGBColor(40, 140, 60),
        RGBColor(130, 60, 160),
        RGBColor(90, 90, 90),
        RGBColor(190, 150, 20),
        RGBColor(20, 150, 160),
        RGBColor(180, 40, 90),
    ];
    let values = || lines.iter().flat_map(|(_, points)| points.iter().copied());
    let span = |of: fn((f64, f64)) -> f64| {
        values().map(of).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
    };
    let ((left, right), (low, high)) = (span(|p| p.0), span(|p| p.1));
    if !(left.is_finite() && low > 0.0) {
        bail!("{title}: nothing to plot");
    }
    let margin = 0.05 * (right - left).max(1e-9);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (800, 500)).into_drawing_area();
        area.fill(&WHITE)?;
        let mut builder = ChartBuilder::on(&area);
        builder.margin(12).caption(title, ("sans-serif", 20)).x_label_area_size(40).y_label_area_size(65);
        let across = left - margin..right + margin;
        // The same marks on either scale: the two kinds of axes are different types.
        macro_rules! draw {
            ($chart:expr) => {{
                let mut chart = $chart;
                chart.configure_mesh().x_desc(x).y_desc(y).draw()?;
                for ((name, points), colour) in lines.iter().zip(COLOURS.iter().cycle()) {
                    chart.draw_series(LineSeries::new(points.iter().copied(), colour))?;
                    let dots: PointSeries<_, _, Circle<_, _>, _> = PointSeries::new(points.iter().copied(), 3, *colour);
                    chart
                        .draw_series(dots)?
                        .label(name.clone())
                        .legend(move |at| Circle::new((at.0 + 10, at.1), 4, *colour));
                }
                chart
                    .configure_series_labels()
                    .position(plotters::prelude::SeriesLabelPosition::UpperLeft)
                    .border_style(RGBColor(200, 200, 200))
                    .background_style(WHITE)
                    .draw()?;
            }};
        }
        if high > 20.0 * low {
            draw!(builder.build_cartesian_2d(across, (0.7 * low..2.5 * high).log_scale())?);
        } else {
            draw!(builder.build_cartesian_2d(across, 0.0..1.3 * high)?);
        }
        area.present()?;
    }
    Ok(svg.into_bytes())
}

/// The straight line through points by least squares: intercept, slope, and how much of the variance it explains (R²).
pub fn line_through(points: &[(f64, f64)]) -> (f64, f64, f64) {
    let n = points.len() as f64;
    let (mean_x, mean_y) = (points.iter().map(|p| p.0).sum::<f64>() / n, points.iter().map(|p| p.1).sum::<f64>() / n);
    let sum = |f: &dyn Fn(f64, f64) -> f64| points.iter().map(|p| f(p.0 - mean_x, p.1 - mean_y)).sum::<f64>();
    let (xx, xy, yy) = (sum(&|x, _| x * x), sum(&|x, y| x * y), sum(&|_, y| y * y));
    let slope = xy / xx;
    (mean_y - slope * mean_x, slope, xy * xy / (xx * yy))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_found_and_its_fit_told() {
        let line: Vec<_> = [9.0, 25.0, 49.0, 81.0].map(|x| (x, 2.0 + 0.5 * x)).into();
        let (intercept, slope, fit) = line_through(&line);
        assert!((intercept - 2.0).abs() < 1e-9 && (slope - 0.5).abs() < 1e-12 && (fit - 1.0).abs() < 1e-12);
        let bent: Vec<_> = line.iter().map(|&(x, _)| (x, x * x)).collect();
        assert!(line_through(&bent).2 < 0.99);
    }
}
