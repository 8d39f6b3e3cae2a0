//! Helpers that run an engine on a cloud, and the grid of parameters for the comparison of engines.

use std::sync::{Mutex, OnceLock};

use planish::{
    AdapterKind, ChoiceReason, Edges, Engine, FrameParams, FrameRadius, GpuAdapter, GpuOptions, IntoFrame, Outputs,
    Params, Project, SimdLevel, Smoothed, Smoother, SmootherOptions, auto_choice, gpu_adapters,
};

/// An engine with options that must not change its result by more than the tolerances.
#[derive(Debug, Clone, Copy)]
pub struct TestEngine {
    /// The engine.
    pub engine: Engine,
    /// Number of threads of the CPU engines.
    pub threads: Option<usize>,
    /// Instruction set of the CPU engine.
    pub simd: Option<SimdLevel>,
    /// True if the shaders of the GPU engine check bounds.
    pub bounds_checks: bool,
    /// Maximum number of points of an unorganized cloud that the GPU engine holds at once.
    pub points_at_once: Option<usize>,
}

impl TestEngine {
    /// The reference engine, the oracle of the tests.
    pub const REFERENCE: Self =
        Self { engine: Engine::Reference, threads: None, simd: None, bounds_checks: true, points_at_once: None };

    /// Returns the CPU engine at one instruction set.
    pub fn cpu(simd: SimdLevel) -> Self {
        Self { engine: Engine::Cpu, simd: Some(simd), ..Self::REFERENCE }
    }

    /// Returns the GPU engine on the adapter of the tests.
    pub fn gpu(bounds_checks: bool) -> Self {
        Self { engine: Engine::Gpu, bounds_checks, ..Self::REFERENCE }
    }

    /// Returns a GPU engine that holds at most `points_at_once` points of a cloud.
    pub fn in_parts(points_at_once: usize) -> Self {
        Self { points_at_once: Some(points_at_once), ..Self::gpu(true) }
    }

    /// Returns the options to open a smoother for this engine.
    ///
    /// # Panics
    /// If the GPU engine is requested and cannot be opened.
    pub fn options(self, outputs: Outputs) -> SmootherOptions {
        let options = self.plain_options(outputs);
        if self.engine == Engine::Gpu {
            // One smoother stays open, so that pipelines compiled for one test are available to the next.
            static KEPT: OnceLock<Mutex<Smoother>> = OnceLock::new();
            KEPT.get_or_init(|| {
                Mutex::new(Smoother::open_with(FrameParams::paper(), &options, (1, 1)).expect("the GPU engine"))
            });
        }
        options
    }

    fn plain_options(self, outputs: Outputs) -> SmootherOptions {
        let adapter = test_adapter().map(|adapter| adapter.index.to_string());
        let gpu = GpuOptions::default().with_adapter(adapter).with_bounds_checks(self.bounds_checks);
        let gpu = gpu.with_points_at_once(self.points_at_once);
        SmootherOptions::new(self.engine, outputs).with_threads(self.threads).with_simd(self.simd).with_gpu(gpu)
    }

    /// Smooths a frame with all outputs.
    ///
    /// # Panics
    /// If the engine fails.
    pub fn smooth<'a>(self, frame: impl IntoFrame<'a>, params: impl Into<Params>) -> Smoothed {
        self.smooth_to(frame, params, Outputs::ALL)
    }

    /// Smooths a frame with the given outputs.
    ///
    /// # Panics
    /// If the engine fails.
    pub fn smooth_to<'a>(self, frame: impl IntoFrame<'a>, params: impl Into<Params>, outputs: Outputs) -> Smoothed {
        let frame = frame.into_frame().expect("a well-formed frame");
        let options = self.options(outputs);
        let opened = match (params.into(), frame.grid()) {
            (Params::Frame(params), Some(shape)) => Smoother::open_with(params, &options, shape),
            (Params::Cloud(params), None) => Smoother::open_clouds(params, &options),
            (params, grid) => panic!("{params:?} are not for a grid of {grid:?}"),
        };
        let mut smoother = opened.expect("an engine");
        let mut smoothed = Smoothed::default();
        smoother.smooth(frame, &mut smoothed).expect("a result");
        smoothed
    }
}

/// Returns the adapter on which the GPU engine is tested: the adapter that `Auto` chooses, otherwise the first, even
/// if it is a software adapter. Returns `None` if no adapter was found.
///
/// # Panics
/// If no adapter was found and the environment variable PLANISH_REQUIRE_GPU is set.
pub fn test_adapter() -> Option<&'static GpuAdapter> {
    static ADAPTER: OnceLock<Option<GpuAdapter>> = OnceLock::new();
    let adapter = ADAPTER.get_or_init(|| {
        let adapters = gpu_adapters();
        match auto_choice(&adapters).1 {
            ChoiceReason::RealGpu(adapter) => Some(adapter),
            _ => adapters.first().cloned(),
        }
    });
    assert!(
        adapter.is_some() || std::env::var_os("PLANISH_REQUIRE_GPU").is_none(),
        "no GPU adapter, but PLANISH_REQUIRE_GPU is set"
    );
    adapter.as_ref()
}

/// Returns true if the GPU engine is tested on a software adapter, on which tests take minutes instead of seconds.
pub fn is_software() -> bool {
    test_adapter().is_some_and(|adapter| adapter.kind == AdapterKind::Software)
}

/// Returns the corners of the parameter space and samples between them: windows 1 to 7, strides 1 to 8, degrees 1 to
/// 3, blocks averaged or not, and both radius rules. Edges are off; half of the settings are repeated with robust
/// edges. A third of all settings project along rays, and a few have a larger ridge.
pub fn parameter_grid() -> Vec<FrameParams> {
    let fixed = FrameRadius::Fixed { radius_m: 0.03 };
    let corners = [1, 7].into_iter().flat_map(|window| {
        [1, 3].into_iter().flat_map(move |stride| {
            [1, 2, 3].into_iter().flat_map(move |degree| {
                [fixed, FrameRadius::Sensor].map(|radius| {
                    FrameParams::paper().with_window(window).with_stride(stride).with_radius(radius).with_degree(degree)
                })
            })
        })
    });
    let between = [(2, 2, 3), (3, 1, 3), (3, 3, 2), (4, 2, 2), (5, 1, 3), (6, 2, 1), (3, 8, 3)].into_iter().flat_map(
        |(window, stride, degree)| {
            [fixed, FrameRadius::Sensor].map(|radius| {
                FrameParams::paper().with_window(window).with_stride(stride).with_radius(radius).with_degree(degree)
            })
        },
    );
    let bandwidth = FrameParams::paper().with_bandwidth_m(Some(0.01));
    let off: Vec<FrameParams> = corners.chain(between).chain([bandwidth]).collect();
    let robust = off.iter().enumerate().filter(|(i, _)| i % 4 == 0 || i % 4 == 3);
    let robust = robust.map(|(_, &params)| params.with_edges(Edges::Robust));
    let all = off.iter().copied().chain(robust);
    all.enumerate()
        .map(|(i, params)| if i % 3 == 1 { params.with_project(Project::Ray) } else { params })
        .map(|params| if params.window.nominal().half_width % 4 == 2 { params.with_ridge(0.3) } else { params })
        .enumerate()
        .map(|(i, params)| params.with_average_blocks(i % 4 != 2))
        .collect()
}
