//! All engines: capabilities, opening, and the choice of `Auto`. A new engine needs changes in this file, and its own
//! folder.

use crate::cpu::{Cpu, GeneralCpu};
use crate::devices::{GpuAdapter, GpuOptions, real_gpu};
#[cfg(not(all(feature = "gpu", feature = "reference")))]
use crate::error::EngineError;
use crate::error::{Error, ParamError};
use crate::outputs::Outputs;
use crate::params::EngineParams;
#[cfg(feature = "reference")]
use crate::reference::Reference;
use crate::simd_level::SimdLevel;
use crate::smoothing_engine::{Immediate, SmoothingEngine};

/// The implementation that computes the result. The results of all implementations agree within the limits of
/// docs/method.md, section 9.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum Engine {
    /// A real GPU if one is available, otherwise the CPU. A single frame is smoothed on the CPU unless it is large; see
    /// [`Session::with_single_frame`]. [`Smoother::engine`] returns the choice.
    ///
    /// [`Session::with_single_frame`]: crate::Session::with_single_frame
    /// [`Smoother::engine`]: crate::Smoother::engine
    #[default]
    Auto,
    /// The f32 engine for the CPU, with SIMD instructions.
    Cpu,
    /// The f32 engine for GPUs through wgpu, in builds with the feature `gpu`.
    Gpu,
    /// The f64 engine, which is written for readability and is the oracle for the other engines.
    Reference,
}

impl std::str::FromStr for Engine {
    type Err = ParamError;

    /// Parses a name from [`Engine::NAMED`].
    fn from_str(name: &str) -> Result<Self, ParamError> {
        let named = Self::NAMED.iter().find(|(known, _)| *known == name).map(|&(_, engine)| engine);
        let allowed = "auto, cpu, gpu or reference";
        named.ok_or_else(|| ParamError { field: "engine", value: format!("{name:?}"), allowed })
    }
}

/// The capabilities of an engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Capabilities {
    /// Support for frames on a grid: depth images and organized clouds.
    pub grids: bool,
    /// Support for unorganized clouds.
    pub general: bool,
    /// Support for keeping edges.
    pub edges: bool,
    /// Support for depth as an output.
    pub depth_out: bool,
    /// True if submitted frames are computed in the background, so that several frames in flight are useful.
    pub pipelined: bool,
}

impl Engine {
    /// All engines. `Auto` is not included, since it is a choice among them.
    pub const ALL: [Self; 3] = [Self::Cpu, Self::Gpu, Self::Reference];

    /// All choices with their names in settings.
    pub const NAMED: [(&'static str, Self); 4] =
        [("auto", Self::Auto), ("cpu", Self::Cpu), ("gpu", Self::Gpu), ("reference", Self::Reference)];

    /// Returns the name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Gpu => "gpu",
            Self::Reference => "reference",
        }
    }

    /// Returns the capabilities of this engine. For `Auto`, they are those of all engines combined, except that
    /// `pipelined` is false.
    pub fn capabilities(self) -> Capabilities {
        let on_grids = Capabilities { grids: true, general: false, edges: true, depth_out: true, pipelined: false };
        match self {
            Self::Cpu => Capabilities { general: true, ..on_grids },
            Self::Gpu => Capabilities { general: true, pipelined: true, ..on_grids },
            Self::Auto | Self::Reference => Capabilities { general: true, ..on_grids },
        }
    }
}

/// The reason for the choice of [`Engine::Auto`].
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum ChoiceReason {
    /// A real GPU was found. Contains its adapter.
    RealGpu(GpuAdapter),
    /// This build lacks the GPU engine.
    NoGpuInBuild,
    /// No adapter was found.
    NoAdapter,
    /// Only software adapters were found.
    NoRealGpu(Vec<GpuAdapter>),
    /// A GPU was found but could not be opened. Contains its adapter and the error.
    GpuFailed(GpuAdapter, String),
    /// The CPU smooths the single frame or cloud in less time than opening a GPU takes.
    SingleFrame {
        /// Number of pixels of the frame, or points of the cloud.
        points: usize,
    },
}

impl std::fmt::Display for ChoiceReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::RealGpu(adapter) => return write!(f, "{} is a GPU", adapter.name),
            Self::NoGpuInBuild => f.write_str("this build has no GPU engine"),
            Self::NoAdapter => f.write_str("no GPU adapter was found"),
            Self::NoRealGpu(adapters) => match &adapters[..] {
                [only] => write!(f, "the only adapter, {}, is not a GPU", only.name),
                _ => f.write_str("none of the adapters is a GPU"),
            },
            Self::GpuFailed(adapter, error) => write!(f, "{} could not be opened: {error}", adapter.name),
            Self::SingleFrame { points } => {
                write!(f, "a single frame of {points} points is smoothed faster than a GPU opens")
            }
        }?;
        write!(f, "; the CPU has {}", SimdLevel::best().name())
    }
}

/// Options for opening a smoother, other than the method's parameters.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct SmootherOptions {
    /// The engine. An engine chosen by name is never replaced, except by the CPU engine in a stream that loses its
    /// GPU twice.
    pub engine: Engine,
    /// The results to compute.
    pub outputs: Outputs,
    /// Number of threads of the CPU engines; `None` for one per core.
    pub threads: Option<usize>,
    /// Instruction set of the CPU engine; `None` for the widest that this machine supports.
    pub simd: Option<SimdLevel>,
    /// Options of the GPU engine.
    pub gpu: GpuOptions,
    /// Number of points of the only frame or cloud to be smoothed; `None` if more may follow.
    pub(crate) only_points: Option<usize>,
}

impl SmootherOptions {
    /// Sets the engine and its outputs.
    pub fn new(engine: Engine, outputs: Outputs) -> Self {
        Self { engine, outputs, ..Self::default() }
    }

    /// Sets the engine.
    pub fn with_engine(self, engine: Engine) -> Self {
        Self { engine, ..self }
    }

    /// Sets the outputs.
    pub fn with_outputs(self, outputs: Outputs) -> Self {
        Self { outputs, ..self }
    }

    /// Sets the number of threads of the CPU engines; `None` for one per core.
    pub fn with_threads(self, threads: Option<usize>) -> Self {
        Self { threads, ..self }
    }

    /// Sets the instruction set of the CPU engine; `None` for the widest that this machine supports.
    pub fn with_simd(self, simd: Option<SimdLevel>) -> Self {
        Self { simd, ..self }
    }

    /// Sets the options of the GPU engine.
    pub fn with_gpu(self, gpu: GpuOptions) -> Self {
        Self { gpu, ..self }
    }
}

/// Sets `XDG_RUNTIME_DIR` on Linux if it is missing, as on a robot. Without this variable, Mesa's Vulkan drivers
/// print an error for each query. The variable names the folder in which the drivers look for a desktop's socket. In
/// a shared folder, another user could plant such a socket, so the variable is set to a path that cannot exist.
///
/// # Safety
/// No other thread may be running, because the function changes the environment.
pub unsafe fn silence_vulkan_drivers() {
    if cfg!(target_os = "linux") && std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: the caller guarantees that no other thread reads the environment.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", "/dev/null/none") };
    }
}

/// Returns the GPU adapters of this machine in the order of their indices. Empty without drivers, or in a build without
/// the feature `gpu`.
pub fn gpu_adapters() -> Vec<GpuAdapter> {
    #[cfg(feature = "gpu")]
    return crate::gpu::adapters();
    #[cfg(not(feature = "gpu"))]
    Vec::new()
}

/// Returns the engine that [`Engine::Auto`] chooses among these adapters, and the reason: the GPU engine if a real
/// GPU is listed, otherwise the CPU engine.
pub fn auto_choice(adapters: &[GpuAdapter]) -> (Engine, ChoiceReason) {
    match real_gpu(adapters) {
        Some(adapter) => (Engine::Gpu, ChoiceReason::RealGpu(adapter.clone())),
        None if cfg!(not(feature = "gpu")) => (Engine::Cpu, ChoiceReason::NoGpuInBuild),
        None if adapters.is_empty() => (Engine::Cpu, ChoiceReason::NoAdapter),
        None => (Engine::Cpu, ChoiceReason::NoRealGpu(adapters.to_vec())),
    }
}

/// Returns true if two cores smooth a frame or cloud of this size faster than a GPU opens, which takes about 0.3 s.
fn is_few(points: usize, is_grid: bool) -> bool {
    points <= if is_grid { 6_000_000 } else { 500_000 }
}

/// An open engine, its kind, and the reason for the choice of `Auto`; `None` if the engine was chosen by name.
pub(crate) type Opened = (Box<dyn SmoothingEngine>, Engine, Option<ChoiceReason>);

/// Opens the engine that the options select, for frames on a grid or for unorganized clouds.
pub(crate) fn open(
    params: EngineParams,
    options: &SmootherOptions,
    grid: Option<(usize, usize)>,
) -> Result<Opened, Error> {
    if options.engine != Engine::Auto {
        return Ok((open_named(options.engine, params, options, grid)?, options.engine, None));
    }
    let (mut engine, mut reason) = match options.only_points {
        // The adapters are not listed either, which saves 0.1 s.
        Some(points) if is_few(points, grid.is_some()) => (Engine::Cpu, ChoiceReason::SingleFrame { points }),
        _ => auto_choice(&gpu_adapters()),
    };
    // Other builds find no adapter; the condition keeps the code out of the browser's module.
    if cfg!(feature = "gpu")
        && let ChoiceReason::RealGpu(adapter) = &reason
    {
        let gpu = GpuOptions { adapter: Some(adapter.index.to_string()), ..options.gpu.clone() };
        match open_named(engine, params, &options.clone().with_gpu(gpu), grid) {
            Ok(opened) => return Ok((opened, engine, Some(reason))),
            Err(error) => (engine, reason) = (Engine::Cpu, ChoiceReason::GpuFailed(adapter.clone(), error.to_string())),
        }
    }
    Ok((open_named(engine, params, options, grid)?, engine, Some(reason)))
}

fn open_named(
    engine: Engine,
    params: EngineParams,
    options: &SmootherOptions,
    grid: Option<(usize, usize)>,
) -> Result<Box<dyn SmoothingEngine>, Error> {
    let SmootherOptions { outputs, threads, simd, ref gpu, .. } = *options;
    match (engine, grid) {
        (Engine::Cpu | Engine::Auto, Some(shape)) => {
            let cpu = Cpu::open(params, threads, simd, shape)?;
            Ok(Box::new(Immediate::new(cpu, outputs, gpu.slots, gpu.timestamps)))
        }
        (Engine::Cpu | Engine::Auto, None) => {
            let cpu = GeneralCpu::open(params, outputs, threads, simd)?;
            Ok(Box::new(Immediate::new(cpu, outputs, gpu.slots, false)))
        }
        (Engine::Gpu, grid) => open_gpu(params, outputs, gpu, grid),
        #[cfg(not(feature = "reference"))]
        (Engine::Reference, _) => {
            let reason = "this build does not include it; enable the feature reference".to_owned();
            Err(EngineError::Unavailable { engine: "reference", reason }.into())
        }
        #[cfg(feature = "reference")]
        (Engine::Reference, _) => {
            let reference = Reference::open(params, threads)?;
            Ok(Box::new(Immediate::new(reference, outputs, gpu.slots, false)))
        }
    }
}

#[cfg(feature = "gpu")]
fn open_gpu(
    params: EngineParams,
    outputs: Outputs,
    options: &GpuOptions,
    grid: Option<(usize, usize)>,
) -> Result<Box<dyn SmoothingEngine>, Error> {
    let Some(shape) = grid else {
        let general = crate::gpu::GeneralGpu::open(params, outputs, options)?;
        return Ok(Box::new(Immediate::new(general, outputs, options.slots, options.timestamps)));
    };
    Ok(Box::new(crate::gpu::Gpu::open(params, outputs, options, shape)?))
}

#[cfg(not(feature = "gpu"))]
fn open_gpu(
    _: EngineParams,
    _: Outputs,
    _: &GpuOptions,
    _: Option<(usize, usize)>,
) -> Result<Box<dyn SmoothingEngine>, Error> {
    let reason = "this build does not include it; enable the feature gpu, or use auto, cpu or reference".to_owned();
    Err(EngineError::Unavailable { engine: "gpu", reason }.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::devices::AdapterKind;
    use crate::devices::tests::adapter;

    #[test]
    fn auto_takes_a_real_gpu_and_never_software() {
        let software = adapter(0, "llvmpipe", AdapterKind::Software);
        let discrete = adapter(2, "NVIDIA H200", AdapterKind::Discrete);
        let all = [software.clone(), discrete.clone()];
        assert_eq!(auto_choice(&all), (Engine::Gpu, ChoiceReason::RealGpu(discrete)));
        let (engine, reason) = auto_choice(&all[..1]);
        assert_eq!(engine, Engine::Cpu);
        assert!(!cfg!(feature = "gpu") || reason.to_string().contains("llvmpipe"), "{reason}");
        assert_eq!(auto_choice(&[]).0, Engine::Cpu);
    }

    #[test]
    fn auto_takes_the_cpu_for_a_single_frame_unless_it_is_large() {
        let params = EngineParams::from(crate::params::FrameParams::paper());
        let reason = |only_points| {
            let options = SmootherOptions { only_points, ..SmootherOptions::default() };
            open(params, &options, Some((64, 48))).unwrap().2.unwrap()
        };
        assert_eq!(reason(Some(3072)), ChoiceReason::SingleFrame { points: 3072 });
        assert!(reason(Some(3072)).to_string().starts_with("a single frame of 3072 points"));
        for not_few in [None, Some(10_000_000)] {
            assert!(!matches!(reason(not_few), ChoiceReason::SingleFrame { .. }), "{not_few:?}");
        }
        assert!(is_few(500_000, false) && !is_few(500_001, false));
    }

    #[test]
    fn auto_can_do_what_some_engine_can() {
        let auto = Engine::Auto.capabilities();
        for engine in Engine::ALL {
            let Capabilities { grids, general, edges, depth_out, .. } = engine.capabilities();
            let within =
                [(grids, auto.grids), (general, auto.general), (edges, auto.edges), (depth_out, auto.depth_out)];
            assert!(within.into_iter().all(|(able, auto)| !able || auto), "{engine:?}");
        }
    }
}
