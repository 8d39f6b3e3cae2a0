//! What the experiments share: the engines of this machine, what is held against the reference, and timing.

use std::cell::RefCell;
use std::hint::black_box;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::agreement::{Agreement, radius_m};
use planish::{
    AdapterKind, Engine, Frame, GpuOptions, Outputs, SimdLevel, SmoothParams, Smoothed, SmoothedView, Smoother,
    SmootherOptions, Transfer, gpu_adapters,
};
use serde::Serialize;

use super::Spread;
use super::frames::{self, Input};
use crate::args::{EngineArg, ExperimentArgs};

/// A measurement whose halves differ by more than this, or whose spread is wider than the next, is called noisy.
const HALVES_DIFFER: f64 = 0.05;
const WIDE_SPREAD: f64 = 1.5;

/// An engine of this machine.
#[derive(Clone)]
pub struct Subject {
    pub name: String,
    pub options: SmootherOptions,
}

/// By which clock a frame is timed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The host's, from the frame in its memory to the result in its memory.
    Host,
    /// The device's, around the kernel alone.
    Device,
}

/// What an engine is timed at.
#[derive(Clone, Copy)]
pub enum Load<'a> {
    /// One frame; on a GPU its result is read where the device puts it.
    Alone(Frame<'a>),
    /// Several frames at once; their results are copied out.
    Batch(&'a [Frame<'a>]),
}

/// How long a measurement goes on.
#[derive(Clone, Copy)]
pub enum Patience {
    /// For a figure that stands by itself: 100 frames and 3 s, but no more than 20 s.
    Long,
    /// For one of many: 20 frames and 1 s, but no more than 3 s.
    Short,
}

/// What the experiments run with.
pub struct Bench<'a> {
    pub args: &'a ExperimentArgs,
    pub inputs: Vec<Input>,
    /// Set by Ctrl-C: what is measured until then is kept.
    pub stop: &'a AtomicBool,
    /// The reference's last result, with the frame and the setting that it is of.
    reference: RefCell<Option<(String, SmoothParams, Smoothed)>>,
}

/// A measured time.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Timing {
    #[serde(flatten)]
    pub ms: Spread,
    pub mean: f64,
    pub runs: usize,
    /// The machine did something else in between, or changed its clock.
    pub noisy: bool,
}

impl Timing {
    fn of(values: Vec<f64>) -> Self {
        let middle = |values: &[f64]| Spread::of(values.to_vec()).median;
        let halves_differ = values.len() >= 8 && {
            let (first, second) = values.split_at(values.len() / 2);
            (middle(first) / middle(second) - 1.0).abs() > HALVES_DIFFER
        };
        let runs = values.len();
        let mean = values.iter().sum::<f64>() / runs as f64;
        let ms = Spread::of(values);
        Self { ms, mean, runs, noisy: halves_differ || (runs >= 8 && ms.p95 > WIDE_SPREAD * ms.p5) }
    }

    /// The median in a table; `~` where it was noisy.
    pub fn cell(&self) -> String {
        let ms = self.ms.median;
        let digits = if ms < 1.0 {
            3
        } else if ms < 100.0 {
            2
        } else {
            0
        };
        format!("{ms:.digits$}{}", if self.noisy { " ~" } else { "" })
    }
}

impl Subject {
    pub fn is_gpu(&self) -> bool {
        self.options.engine == Engine::Gpu
    }

    pub fn open(&self, params: SmoothParams, shape: (usize, usize)) -> Result<Smoother> {
        Ok(Smoother::open_with(params, &self.options, shape)?)
    }

    /// The engine with the device's clock on; its copies are then stages of their own.
    pub fn with_time_stamps(&self) -> Self {
        let mut subject = self.clone();
        subject.options.gpu.timestamps = true;
        subject.options.gpu.transfer = Transfer::Staged;
        subject
    }

    /// By which clocks it can be timed.
    pub fn clocks(&self) -> Vec<Clock> {
        // An adapter that has no clock says so here.
        let has_device_clock = self.is_gpu() && self.with_time_stamps().open(SmoothParams::paper(), (64, 48)).is_ok();
        if has_device_clock { vec![Clock::Host, Clock::Device] } else { vec![Clock::Host] }
    }

    /// Its name in a table of both clocks.
    pub fn name_by(&self, clock: Clock) -> String {
        match clock {
            Clock::Host => self.name.clone(),
            Clock::Device => format!("{}, kernel alone", self.name),
        }
    }
}

impl<'a> Bench<'a> {
    pub fn new(args: &'a ExperimentArgs, stop: &'a AtomicBool) -> Result<Self> {
        Ok(Self { args, inputs: frames::inputs(args)?, stop, reference: RefCell::default() })
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
                if adapter.kind == AdapterKind::Software && !engines.contains(&EngineArg::Gpu) {
                    continue;
                }
                let gpu =
                    GpuOptions { adapter: Some(index.to_string()), bounds_checks: false, ..GpuOptions::default() };
                let options = SmootherOptions { gpu, ..base(Engine::Gpu) };
                subjects.push(Subject { name: format!("gpu {}", adapter.name), options });
            }
        }
        subjects
    }

    /// The same without the reference, which takes seconds where the others take milliseconds.
    pub fn fast_subjects(&self) -> Vec<Subject> {
        let mut subjects = self.subjects(false);
        subjects.retain(|subject| subject.options.engine != Engine::Reference);
        subjects
    }

    /// Holds a subject's result against the reference; a wrong one is an error.
    pub fn check(&self, subject: &Subject, params: SmoothParams, input: &Input) -> Result<()> {
        if subject.options.engine == Engine::Reference {
            return Ok(());
        }
        let result = |options: &SmootherOptions| -> Result<Smoothed> {
            let options = SmootherOptions { outputs: Outputs::ALL, ..options.clone() };
            let mut result = Smoothed::default();
            Smoother::open_with(params, &options, input.shape())?.smooth(input.frame(), &mut result)?;
            Ok(result)
        };
        let mut known = self.reference.borrow_mut();
        let reference = match known.take() {
            Some((of, with, reference)) if of == input.name() && with == params => reference,
            _ => result(&SmootherOptions { engine: Engine::Reference, ..SmootherOptions::default() })?,
        };
        let mut agreement = Agreement::default();
        agreement.add(&result(&subject.options)?, &reference, radius_m(&input.cloud, params));
        *known = Some((input.name().to_owned(), params, reference));
        let misses = agreement.misses();
        if !misses.is_empty() {
            bail!("a wrong result is not timed: {}, {}: {}", subject.name, input.name(), misses.join("; "));
        }
        Ok(())
    }

    /// Times `work` by the host's clock.
    pub fn time(&self, patience: Patience, mut work: impl FnMut() -> Result<()>) -> Result<Timing> {
        self.measure(patience, || {
            let start = Instant::now();
            work()?;
            Ok(ms(start.elapsed()))
        })
    }

    /// Many values of what `one` measures, in milliseconds, once it is warm.
    pub fn measure(&self, patience: Patience, mut one: impl FnMut() -> Result<f64>) -> Result<Timing> {
        // A GPU that was idle takes a third of a second to come to its full clock.
        let (runs, least_ms, most_ms, warm_up_ms) = match patience {
            _ if self.args.quick => (20, 0, 400, 100),
            Patience::Long => (100, 3_000, 20_000, 300),
            Patience::Short => (20, 1_000, 3_000, 300),
        };
        let [least, most, warm_up] = [least_ms, most_ms, warm_up_ms].map(Duration::from_millis);
        let start = Instant::now();
        let first = one()?;
        if start.elapsed() > most {
            // What takes so long is as warm as it gets.
            return Ok(Timing::of(vec![first]));
        }
        while start.elapsed() < warm_up && !self.stopped() {
            one()?;
        }
        let (mut values, start) = (Vec::new(), Instant::now());
        loop {
            values.push(one()?);
            let elapsed = start.elapsed();
            if elapsed >= most || (values.len() >= runs && elapsed >= least) || self.stopped() {
                return Ok(Timing::of(values));
            }
        }
    }

    /// Times an engine at something by a clock. Gives the bytes of the engine's buffers too.
    pub fn time_load(
        &self,
        subject: &Subject,
        clock: Clock,
        params: SmoothParams,
        load: Load<'_>,
    ) -> Result<(Timing, u64)> {
        let frames = match load {
            Load::Alone(frame) => &[frame][..],
            Load::Batch(frames) => frames,
        };
        let shape = frames.first().map_or((0, 0), Frame::shape);
        let mut smoothed = vec![Smoothed::default(); frames.len()];
        let timing;
        let mut smoother;
        if clock == Clock::Device {
            smoother = subject.with_time_stamps().open(params, shape)?;
            timing = self.measure(Patience::Short, || {
                smoother.smooth_batch(frames, &mut smoothed)?;
                Ok(smoother.timings().map_or(f64::NAN, |timings| ms(timings.kernel)))
            })?;
        } else {
            smoother = subject.open(params, shape)?;
            timing = self.time(Patience::Short, || match load {
                Load::Alone(frame) if subject.is_gpu() => {
                    smoother.submit_in_place(frame)?;
                    smoother.receive()?.iter().for_each(touch);
                    Ok(())
                }
                Load::Alone(frame) => Ok(smoother.smooth(frame, &mut smoothed[0])?),
                Load::Batch(frames) => Ok(smoother.smooth_batch(frames, &mut smoothed)?),
            })?;
        }
        Ok((timing, smoother.buffer_bytes()))
    }
}

/// Looks at a result, so that it is there.
pub fn touch(view: &SmoothedView) {
    black_box(view.points().map(|[x, ..]| x[x.len() / 2]));
}

pub fn ms(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}
