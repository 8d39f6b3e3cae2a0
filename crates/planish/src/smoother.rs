//! The front door: open an engine once for a frame shape, then smooth any number of frames.

use crate::cloud::{PointCloud, validate_shape};
use crate::cpu::{Cpu, SimdLevel};
use crate::error::{EngineError, Error, FrameError, ParamError};
use crate::frame::Frame;
use crate::params::{Radius, SmoothParams};
use crate::reference::{Reference, smooth_general};
use crate::smoothed::{Outputs, Smoothed};

/// Which implementation computes the result. All agree within docs/method.md, section 9.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Engine {
    /// The fastest engine of this build on this machine; [`Smoother::engine`] says which.
    #[default]
    Auto,
    /// f32 SIMD on the CPU.
    Cpu,
    /// A GPU through wgpu.
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SmootherOptions {
    /// Which engine. One that is asked for by name never falls back to another.
    pub engine: Engine,
    /// Which results to compute beside the points.
    pub outputs: Outputs,
    /// How many threads the CPU engines use; `None` is one for each core.
    pub threads: Option<usize>,
    /// Which instruction set the CPU engine uses; `None` is the widest of this machine.
    pub simd: Option<SimdLevel>,
}

/// An open engine with its buffers, for frames of one shape.
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
pub struct Smoother {
    shape: (usize, usize),
    engine: EngineState,
}

enum EngineState {
    Cpu(Box<Cpu>),
    Reference(Reference),
}

impl Smoother {
    /// Validates the parameters and opens an engine for frames of `shape` (width, height), with points as its only output.
    pub fn open(params: SmoothParams, engine: Engine, shape: (usize, usize)) -> Result<Self, Error> {
        Self::open_with(params, SmootherOptions { engine, ..SmootherOptions::default() }, shape)
    }

    /// The same with everything chosen by the caller.
    pub fn open_with(params: SmoothParams, options: SmootherOptions, shape: (usize, usize)) -> Result<Self, Error> {
        params.validate()?;
        validate_shape(shape.0, shape.1)?;
        if options.threads == Some(0) {
            return Err(ParamError { field: "threads", value: "0".into(), allowed: "1 or more" }.into());
        }
        let unavailable = |reason: &str| {
            Err(EngineError::Unavailable { engine: options.engine.name(), reason: reason.to_owned() }.into())
        };
        let engine = match options.engine {
            Engine::Auto | Engine::Cpu => {
                EngineState::Cpu(Box::new(Cpu::open(params, options.outputs, options.threads, options.simd, shape)?))
            }
            Engine::Reference => EngineState::Reference(Reference::open(params, options.outputs, options.threads)?),
            Engine::Gpu => return unavailable("it is not built yet; use auto, cpu or reference"),
        };
        Ok(Self { shape, engine })
    }

    /// The engine that is open: what `Auto` chose.
    pub fn engine(&self) -> Engine {
        match self.engine {
            EngineState::Cpu(_) => Engine::Cpu,
            EngineState::Reference(_) => Engine::Reference,
        }
    }

    /// Smooths one frame into `out`, whose buffers are reused. Refuses a frame of another shape than the one opened for.
    pub fn smooth<'a>(&mut self, frame: impl Into<Frame<'a>>, out: &mut Smoothed) -> Result<(), Error> {
        let frame = frame.into();
        let (width, height) = self.shape;
        let (frame_width, frame_height) = frame.shape();
        if (frame_width, frame_height) != self.shape {
            return Err(FrameError::ShapeMismatch { frame_width, frame_height, width, height }.into());
        }
        frame.validate()?;
        match &mut self.engine {
            EngineState::Cpu(cpu) => cpu.smooth(frame, out),
            EngineState::Reference(reference) => reference.smooth(frame, out),
        }
    }
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
