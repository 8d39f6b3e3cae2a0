//! The engines of this machine, and the frames on which they are timed.

use std::hint::black_box;

use anyhow::{Result, bail};
use planish::{
    AdapterKind, Engine, EngineError, Error, Frame, FrameParams, FrameTimings, GpuOptions, Outputs, SimdLevel,
    Smoothed, SmoothedView, Smoother, SmootherOptions, Transfer, gpu_adapters,
};

/// An engine of this machine.
#[derive(Clone)]
pub struct Subject {
    pub name: String,
    pub options: SmootherOptions,
}

/// The clock of a measurement.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The host's clock, from the frame in host memory to the result in host memory.
    Host,
    /// The device's clock, around the kernel alone.
    Device,
}

impl Subject {
    pub fn is_gpu(&self) -> bool {
        self.options.engine == Engine::Gpu
    }

    /// Returns the engine with timed stages. On a GPU, the copies are then separate stages.
    pub fn with_time_stamps(&self) -> Self {
        let mut subject = self.clone();
        subject.options.gpu.timestamps = true;
        if self.is_gpu() {
            subject.options.gpu.transfer = Transfer::Staged;
        }
        subject
    }

    /// Returns the clocks that can time the engine.
    pub fn clocks(&self) -> Result<Vec<Clock>> {
        if !self.is_gpu() {
            return Ok(vec![Clock::Host]);
        }
        let stamped = self.with_time_stamps();
        match Smoother::open_with(FrameParams::paper(), &stamped.options, (64, 48)) {
            Ok(_) => Ok(vec![Clock::Host, Clock::Device]),
            Err(Error::Engine(EngineError::Unavailable { .. })) => Ok(vec![Clock::Host]),
            Err(error) => Err(error.into()),
        }
    }

    /// Returns the engine's name for a table that contains both clocks.
    pub fn name_by(&self, clock: Clock) -> String {
        match clock {
            Clock::Host => self.name.clone(),
            Clock::Device => format!("{}, kernel alone", self.name),
        }
    }
}

/// Returns the requested engines, or by default all engines of this machine. With `all_levels`, the CPU engine is
/// included at every SIMD level, with one thread and with all threads. An unavailable engine that was requested by
/// name is an error.
pub fn subjects(asked: &[Engine], all_levels: bool) -> Result<Vec<Subject>> {
    let all = asked.is_empty() || asked.contains(&Engine::Auto);
    let wants = |engine| all || asked.contains(&engine);
    let base = |engine| SmootherOptions::default().with_engine(engine).with_outputs(Outputs::POINTS);
    let all_threads = std::thread::available_parallelism().map_or(1, usize::from);
    let threads_text = |threads| format!("{threads} thread{}", if threads == 1 { "" } else { "s" });
    let mut subjects = Vec::new();
    if wants(Engine::Reference) {
        let name = format!("reference (f64), {}", threads_text(all_threads));
        subjects.push(Subject { name, options: base(Engine::Reference) });
    }
    if wants(Engine::Cpu) {
        let levels: Vec<_> = if all_levels { SimdLevel::available().collect() } else { vec![SimdLevel::best()] };
        let mut threads = if all_levels { vec![1, all_threads] } else { vec![all_threads] };
        threads.dedup();
        for (level, &threads) in levels.iter().flat_map(|level| threads.iter().map(move |threads| (level, threads))) {
            let name = format!("cpu {}, {}", level.name(), threads_text(threads));
            let options = base(Engine::Cpu).with_threads(Some(threads)).with_simd(Some(*level));
            subjects.push(Subject { name, options });
        }
    }
    if wants(Engine::Gpu) {
        let named = asked.contains(&Engine::Gpu);
        let adapters = gpu_adapters();
        if named && adapters.is_empty() {
            bail!("--engine gpu: no GPU was found; run `planish devices` for the reason");
        }
        // A software adapter is measured only on request: it is slower than the CPU that it runs on.
        for adapter in adapters.iter().filter(|adapter| named || adapter.kind != AdapterKind::Software) {
            let adapter_index = Some(adapter.index.to_string());
            let gpu = GpuOptions::default().with_adapter(adapter_index).with_bounds_checks(false);
            let twice = adapters.iter().filter(|other| other.name == adapter.name).count() > 1;
            let which = if twice { format!(" {} {}", adapter.index, adapter.backend) } else { String::new() };
            let options = base(Engine::Gpu).with_gpu(gpu);
            subjects.push(Subject { name: format!("gpu{which} {}", adapter.name), options });
        }
    }
    Ok(subjects)
}

/// The way in which frames pass through an engine and results are read.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// One frame at a time; each result is copied to host memory.
    CopiedOut,
    /// One frame at a time; each result is read in place.
    InPlace,
    /// The engine's maximum number of frames in flight; each result is copied to host memory.
    CopiedOutInFlight,
    /// The engine's maximum number of frames in flight; each result is read in place.
    InPlaceInFlight,
    /// Several frames per call; results are copied to host memory.
    Batch,
}

/// An engine and the frames on which it is timed.
pub struct Load<'a> {
    smoother: Smoother,
    way: Way,
    frames: Vec<Frame<'a>>,
    results: Vec<Smoothed>,
}

impl<'a> Load<'a> {
    /// Opens the engine for frames of one shape: one frame, or several for a batch.
    pub fn open(subject: &Subject, params: FrameParams, way: Way, frames: Vec<Frame<'a>>) -> Result<Self> {
        let shape = frames.first().map_or((0, 0), Frame::shape);
        let smoother = Smoother::open_with(params, &subject.options, shape)?;
        let results = vec![Smoothed::default(); frames.len()];
        Ok(Self { smoother, way, frames, results })
    }

    /// Processes the frames once. The ways with frames in flight submit one frame, after receiving one if the maximum
    /// is in flight. Returns the engine's times; `None` if it does not report them.
    pub fn once(&mut self) -> Result<Option<FrameTimings>> {
        match self.way {
            Way::Batch => self.smoother.smooth_batch(&self.frames, &mut self.results)?,
            Way::CopiedOut => self.smoother.smooth(self.frames[0], &mut self.results[0])?,
            Way::InPlace => {
                self.submit()?;
                return self.receive();
            }
            Way::InPlaceInFlight | Way::CopiedOutInFlight => {
                if self.smoother.in_flight() == self.smoother.max_in_flight() {
                    self.receive()?;
                }
                self.submit()?;
                return Ok(None);
            }
        }
        Ok(self.smoother.timings())
    }

    fn receive(&mut self) -> Result<Option<FrameTimings>> {
        let Some(view) = self.smoother.receive()? else { return Ok(None) };
        let timings = view.timings();
        touch(&view);
        self.take_back(view);
        Ok(timings)
    }

    /// Processes the frames again and passes the points of each result to `look`. The number of frames in flight is
    /// the same as during timing, so every reused buffer is checked.
    pub fn show(&mut self, mut look: impl FnMut([&[f32]; 3]) -> Result<()>) -> Result<()> {
        while self.smoother.receive()?.is_some() {}
        if matches!(self.way, Way::CopiedOut | Way::Batch) {
            self.once()?;
            return self.results.iter().try_for_each(|result| look(result.points.as_slices()));
        }
        let under_way = if self.way == Way::InPlace { 1 } else { self.smoother.max_in_flight() };
        for _ in 0..2 {
            for _ in 0..under_way {
                self.submit()?;
            }
            for _ in 0..under_way {
                let Some(view) = self.smoother.receive()? else { bail!("a submitted frame was not returned") };
                look(view.points().unwrap_or_default())?;
                self.take_back(view);
            }
        }
        Ok(())
    }

    fn submit(&mut self) -> Result<()> {
        let frame = self.frames[0];
        match self.way {
            Way::CopiedOutInFlight => self.smoother.submit(frame, self.results.pop().unwrap_or_default())?,
            _ => self.smoother.submit_in_place(frame)?,
        }
        Ok(())
    }

    fn take_back(&mut self, view: SmoothedView) {
        if self.way == Way::CopiedOutInFlight {
            self.results.push(view.into_smoothed());
        }
    }

    /// Returns the size of the engine's buffers in bytes.
    pub fn buffer_bytes(&self) -> u64 {
        self.smoother.buffer_bytes()
    }
}

/// Reads a value of the result, so that the time includes making the result available.
fn touch(view: &SmoothedView) {
    black_box(view.points().map(|[x, ..]| x[x.len() / 2]));
}
