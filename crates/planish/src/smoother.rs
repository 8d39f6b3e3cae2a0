//! The front door: open an engine once for a frame shape, then smooth any number of frames.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::cloud::{PointCloud, validate_shape};
use crate::cpu::{Cpu, SimdLevel};
use crate::devices::{FrameTimings, GpuOptions, auto_choice, gpu_adapters};
use crate::error::{EngineError, Error, FrameError, ParamError};
use crate::frame::Frame;
use crate::params::{Radius, SmoothParams};
use crate::reference::{Reference, smooth_general};
use crate::smoothed::{Outputs, Smoothed};
use crate::view::SmoothedView;

/// Which implementation computes the result. All agree within docs/method.md, section 9.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Engine {
    /// A real GPU if there is one, else the CPU; [`Smoother::engine`] says which.
    #[default]
    Auto,
    /// f32 SIMD on the CPU.
    Cpu,
    /// f32 on a GPU through wgpu, in builds with the feature `gpu`.
    Gpu,
    /// f64, written to be read: the oracle of the others.
    Reference,
}

impl Engine {
    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Gpu => "gpu",
            Self::Reference => "reference",
        }
    }
}

/// How to open a smoother, beside the parameters of the method.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SmootherOptions {
    /// Which engine. One that is asked for by name never falls back to another; only a [`stream`](crate::stream) goes on with
    /// the CPU when its GPU is lost twice.
    pub engine: Engine,
    /// Which results to compute.
    pub outputs: Outputs,
    /// How many threads the CPU engines use; `None` is one for each core.
    pub threads: Option<usize>,
    /// Which instruction set the CPU engine uses; `None` is the widest of this machine.
    pub simd: Option<SimdLevel>,
    /// How to open the GPU engine.
    pub gpu: GpuOptions,
}

/// An open engine with its buffers, for frames of one shape.
///
/// One frame at a time:
///
/// ```
/// use planish::{Engine, OrganizedCloud, SmoothParams, Smoothed, Smoother, Xyz};
///
/// # fn main() -> Result<(), planish::Error> {
/// let plane: Xyz = (0..64 * 48).map(|i| [0.002 * (i % 64) as f32, 0.002 * (i / 64) as f32, 1.0]).collect();
/// let cloud = OrganizedCloud::from_positions(64, 48, plane)?;
/// let mut smoother = Smoother::open(SmoothParams::paper(), Engine::Auto, (64, 48))?;
/// let mut smoothed = Smoothed::default();
/// smoother.smooth(&cloud, &mut smoothed)?;
/// assert!((smoothed.points.z[1000] - 1.0).abs() < 1e-6);
/// # Ok(())
/// # }
/// ```
///
/// Frames in flight, so that a GPU computes one while the next goes up and the last comes back; results are received in the
/// order of submission:
///
/// ```
/// # use planish::{Engine, OrganizedCloud, SmoothParams, Smoothed, Smoother, Xyz};
/// # fn main() -> Result<(), planish::Error> {
/// # let plane: Xyz = (0..64 * 48).map(|i| [0.002 * (i % 64) as f32, 0.002 * (i / 64) as f32, 1.0]).collect();
/// # let frames = vec![OrganizedCloud::from_positions(64, 48, plane)?; 5];
/// # let mut smoother = Smoother::open(SmoothParams::paper(), Engine::Auto, (64, 48))?;
/// let mut spare = Vec::new();
/// let mut use_result = |smoothed: &Smoothed| assert_eq!(smoothed.points.len(), 64 * 48);
/// for frame in &frames {
///     if smoother.in_flight() == smoother.max_in_flight() {
///         if let Some(result) = smoother.receive()? {
///             let smoothed = result.into_smoothed();
///             use_result(&smoothed);
///             spare.push(smoothed);
///         }
///     }
///     smoother.submit(frame, spare.pop().unwrap_or_default())?;
/// }
/// while let Some(result) = smoother.receive()? {
///     use_result(&result.into_smoothed());
/// }
/// # Ok(())
/// # }
/// ```
pub struct Smoother {
    shape: (usize, usize),
    outputs: Outputs,
    engine: EngineState,
    chosen_because: Option<String>,
}

enum EngineState {
    Host(Box<Host>),
    #[cfg(feature = "gpu")]
    Gpu(Box<crate::gpu::Gpu>),
}

/// An engine of the CPU, which computes where it is called.
struct Host {
    engine: HostEngine,
    /// Points and normals, where the outputs are made from them afterwards.
    scratch: Option<Smoothed>,
    submitted: VecDeque<(Smoothed, Option<FrameTimings>)>,
    slots: usize,
    /// Whether times are wanted, and those of the last call.
    timestamps: bool,
    timings: Option<FrameTimings>,
}

enum HostEngine {
    Cpu(Box<Cpu>),
    Reference(Reference),
}

impl Smoother {
    /// Validates the parameters and opens an engine for frames of `shape` (width, height), with points as its only output.
    pub fn open(params: SmoothParams, engine: Engine, shape: (usize, usize)) -> Result<Self, Error> {
        Self::open_with(params, &SmootherOptions { engine, ..SmootherOptions::default() }, shape)
    }

    /// The same with everything chosen by the caller.
    ///
    /// Limits are checked and kernels compiled here. `Auto` chooses here and never later; a GPU that cannot be opened for these
    /// frames leaves it with the CPU.
    pub fn open_with(params: SmoothParams, options: &SmootherOptions, shape: (usize, usize)) -> Result<Self, Error> {
        params.validate()?;
        validate_shape(shape.0, shape.1)?;
        validate_outputs(options.outputs)?;
        let positive = |field, value| match value {
            0 => Err(ParamError { field, value: "0".into(), allowed: "1 or more" }),
            _ => Ok(()),
        };
        positive("threads", options.threads.unwrap_or(1))?;
        positive("slots", options.gpu.slots)?;
        let mut chosen_because = None;
        let engine = match options.engine {
            Engine::Auto => {
                let (engine, reason) = open_auto(params, options, shape)?;
                chosen_because = Some(reason);
                engine
            }
            Engine::Gpu => open_gpu(params, options, shape)?,
            host => open_host(host, params, options, shape)?,
        };
        Ok(Self { shape, outputs: options.outputs, engine, chosen_because })
    }

    /// The engine that is open: what `Auto` chose.
    pub fn engine(&self) -> Engine {
        match &self.engine {
            EngineState::Host(host) => match host.engine {
                HostEngine::Cpu(_) => Engine::Cpu,
                HostEngine::Reference(_) => Engine::Reference,
            },
            #[cfg(feature = "gpu")]
            EngineState::Gpu(_) => Engine::Gpu,
        }
    }

    /// The name of the GPU, if this is the GPU engine.
    pub fn gpu_name(&self) -> Option<&str> {
        match &self.engine {
            EngineState::Host(_) => None,
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => Some(gpu.device_name()),
        }
    }

    /// Why `Auto` chose as it did; `None` if the engine was asked for by name.
    pub fn chosen_because(&self) -> Option<&str> {
        self.chosen_because.as_deref()
    }

    /// Smooths one frame into `out`, whose buffers are reused. Refuses a frame of another shape than the one opened for.
    pub fn smooth<'a>(&mut self, frame: impl Into<Frame<'a>>, out: &mut Smoothed) -> Result<(), Error> {
        let frame = self.admit(frame.into())?;
        match &mut self.engine {
            EngineState::Host(host) => {
                host.timings = host.smooth(frame, self.outputs, out)?;
                Ok(())
            }
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.smooth(frame, out),
        }
    }

    /// Smooths several frames, of one camera or of several with the same shape: on a GPU up to 64 in one submission.
    ///
    /// `out` has a result for each frame, whose buffers are reused.
    pub fn smooth_batch(&mut self, frames: &[Frame<'_>], out: &mut [Smoothed]) -> Result<(), Error> {
        if frames.len() != out.len() {
            let (len, expected) = (out.len(), frames.len());
            return Err(FrameError::LengthMismatch { what: "the results of a batch".into(), len, expected }.into());
        }
        for &frame in frames {
            self.admit(frame)?;
        }
        match &mut self.engine {
            EngineState::Host(host) => {
                let mut timings = None::<FrameTimings>;
                for (&frame, out) in frames.iter().zip(out) {
                    if let Some(more) = host.smooth(frame, self.outputs, out)? {
                        *timings.get_or_insert_default() += more;
                    }
                }
                host.timings = timings;
                Ok(())
            }
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.smooth_batch(frames, out),
        }
    }

    /// Where the time of the last [`smooth`](Self::smooth) or [`smooth_batch`](Self::smooth_batch) went on a GPU or in the CPU
    /// engine, if [`GpuOptions::timestamps`] were asked for.
    pub fn timings(&self) -> Option<FrameTimings> {
        match &self.engine {
            EngineState::Host(host) => host.timings,
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.timings(),
        }
    }

    /// Bytes that the engine keeps for its samples from frame to frame, beside frames and results: the padded planes of the CPU
    /// engine; the buffers of all slots of the GPU engine, on the device and in memory that both see. The reference keeps none.
    pub fn buffer_bytes(&self) -> u64 {
        match &self.engine {
            EngineState::Host(host) => match &host.engine {
                HostEngine::Cpu(cpu) => cpu.buffer_bytes(),
                HostEngine::Reference(_) => 0,
            },
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.buffer_bytes(),
        }
    }

    /// Sends a frame on its way, and its result to `buffer`; [`receive`](Self::receive) gives it back filled.
    ///
    /// On a GPU the frame has been copied when this returns, and the result is copied out by another thread. The engines of the
    /// CPU compute the frame here.
    pub fn submit<'a>(&mut self, frame: impl Into<Frame<'a>>, buffer: Smoothed) -> Result<(), Error> {
        self.submit_to(frame.into(), Some(buffer))
    }

    /// The same with the result left where the device puts it, to be read there: nothing is copied.
    pub fn submit_in_place<'a>(&mut self, frame: impl Into<Frame<'a>>) -> Result<(), Error> {
        self.submit_to(frame.into(), None)
    }

    fn submit_to(&mut self, frame: Frame<'_>, buffer: Option<Smoothed>) -> Result<(), Error> {
        let frame = self.admit(frame)?;
        match &mut self.engine {
            EngineState::Host(host) => {
                let in_flight = host.submitted.len();
                if in_flight >= host.slots {
                    return Err(EngineError::Full { in_flight }.into());
                }
                let mut smoothed = buffer.unwrap_or_default();
                let timings = host.smooth(frame, self.outputs, &mut smoothed)?;
                host.submitted.push_back((smoothed, timings));
                Ok(())
            }
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.submit(frame, buffer),
        }
    }

    /// Waits for the oldest frame in flight; `None` if there is none.
    pub fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match &mut self.engine {
            EngineState::Host(host) => {
                Ok(host.submitted.pop_front().map(|(smoothed, timings)| SmoothedView::owned(smoothed, timings)))
            }
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.receive(),
        }
    }

    /// How many frames were submitted and not received.
    pub fn in_flight(&self) -> usize {
        match &self.engine {
            EngineState::Host(host) => host.submitted.len(),
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.in_flight(),
        }
    }

    /// How many frames can be; one more is an [`EngineError::Full`].
    pub fn max_in_flight(&self) -> usize {
        match &self.engine {
            EngineState::Host(host) => host.slots,
            #[cfg(feature = "gpu")]
            EngineState::Gpu(gpu) => gpu.max_in_flight(),
        }
    }

    /// Refuses a frame that is not what it says, or of another shape.
    fn admit<'a>(&self, frame: Frame<'a>) -> Result<Frame<'a>, FrameError> {
        let (width, height) = self.shape;
        let (frame_width, frame_height) = frame.shape();
        if (frame_width, frame_height) != self.shape {
            return Err(FrameError::ShapeMismatch { frame_width, frame_height, width, height });
        }
        frame.validate()?;
        if self.outputs.depth && frame.camera().is_none() {
            return Err(FrameError::MissingCamera { what: "depth as an output" });
        }
        Ok(frame)
    }
}

impl Host {
    /// Gives the times of the frame, where they are wanted.
    fn smooth(
        &mut self,
        frame: Frame<'_>,
        outputs: Outputs,
        out: &mut Smoothed,
    ) -> Result<Option<FrameTimings>, Error> {
        let computed = self.scratch.as_mut().unwrap_or(out);
        match &mut self.engine {
            HostEngine::Cpu(cpu) => cpu.smooth(frame, computed)?,
            HostEngine::Reference(reference) => reference.smooth(frame, computed)?,
        }
        let mut readback = Duration::ZERO;
        if let Some(computed) = &mut self.scratch {
            let start = Instant::now();
            out.take_over(computed, outputs, frame.camera())?;
            readback = start.elapsed();
        }
        Ok(match &self.engine {
            HostEngine::Cpu(cpu) if self.timestamps => Some(FrameTimings { readback, ..cpu.timings() }),
            _ => None,
        })
    }
}

fn open_host(
    engine: Engine,
    params: SmoothParams,
    options: &SmootherOptions,
    shape: (usize, usize),
) -> Result<EngineState, Error> {
    let SmootherOptions { outputs, threads, simd, .. } = *options;
    // These engines compute points, and depth is made from points and normals.
    let computed = Outputs { points: true, depth: false, normals: outputs.normals || outputs.depth, ..outputs };
    let engine = match engine {
        Engine::Reference => HostEngine::Reference(Reference::open(params, computed, threads)?),
        _ => HostEngine::Cpu(Box::new(Cpu::open(params, computed, threads, simd, shape)?)),
    };
    let scratch = (computed != outputs).then(Smoothed::default);
    let GpuOptions { slots, timestamps, .. } = options.gpu;
    let submitted = VecDeque::new();
    Ok(EngineState::Host(Box::new(Host { engine, scratch, submitted, slots, timestamps, timings: None })))
}

#[cfg(feature = "gpu")]
fn open_gpu(params: SmoothParams, options: &SmootherOptions, shape: (usize, usize)) -> Result<EngineState, Error> {
    Ok(EngineState::Gpu(Box::new(crate::gpu::Gpu::open(params, options.outputs, &options.gpu, shape)?)))
}

#[cfg(not(feature = "gpu"))]
fn open_gpu(_: SmoothParams, _: &SmootherOptions, _: (usize, usize)) -> Result<EngineState, Error> {
    let reason = "this build is without it; build with the feature gpu, or use auto, cpu or reference".to_owned();
    Err(EngineError::Unavailable { engine: "gpu", reason }.into())
}

/// A real GPU if there is one and it opens; else the CPU.
fn open_auto(
    params: SmoothParams,
    options: &SmootherOptions,
    shape: (usize, usize),
) -> Result<(EngineState, String), Error> {
    let (engine, mut reason) = auto_choice(&gpu_adapters());
    if engine == Engine::Gpu {
        let gpu = GpuOptions { adapter: None, ..options.gpu.clone() };
        match open_gpu(params, &SmootherOptions { gpu, ..options.clone() }, shape) {
            Ok(gpu) => return Ok((gpu, reason)),
            Err(error) => reason = format!("{reason}, but {error}"),
        }
    }
    Ok((open_host(Engine::Cpu, params, options, shape)?, reason))
}

fn validate_outputs(outputs: Outputs) -> Result<(), ParamError> {
    if outputs == (Outputs { points: false, ..Outputs::POINTS }) {
        return Err(ParamError { field: "outputs", value: "none".into(), allowed: "one or more" });
    }
    Ok(())
}

/// Smooths a general cloud: all points within the radius are neighbours (docs/method.md, section 8).
///
/// Order, number and fields of the points are kept, and threads change nothing. The radius must be [`Radius::Fixed`]:
/// without a pixel grid there is no sensor to derive it from. Normals point towards the cloud's viewpoint.
pub fn smooth_points(
    cloud: &PointCloud,
    params: SmoothParams,
    outputs: Outputs,
    threads: Option<usize>,
    out: &mut Smoothed,
) -> Result<(), Error> {
    params.validate()?;
    cloud.validate()?;
    validate_outputs(outputs)?;
    if outputs.depth {
        return Err(FrameError::MissingCamera { what: "depth as an output" }.into());
    }
    let Radius::Fixed { radius_m } = params.radius else {
        return Err(ParamError {
            field: "radius",
            value: "sensor".into(),
            allowed: "a fixed radius in metres, for a cloud that is not organized",
        }
        .into());
    };
    smooth_general(cloud, params, radius_m, outputs, threads, out)
}
