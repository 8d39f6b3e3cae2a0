//! Running an engine on a cloud, and the grid of parameters that engines are compared on.

use planish::{
    Engine, Frame, OrganizedCloud, Outputs, Radius, SimdLevel, SmoothParams, Smoothed, Smoother, SmootherOptions,
};

/// An engine with the choices that must not change its result by more than the tolerances.
#[derive(Debug, Clone, Copy)]
pub struct TestEngine {
    /// Which engine.
    pub engine: Engine,
    /// Threads of the CPU engines.
    pub threads: Option<usize>,
    /// Instruction set of the CPU engine.
    pub simd: Option<SimdLevel>,
}

impl TestEngine {
    /// The oracle.
    pub const REFERENCE: Self = Self { engine: Engine::Reference, threads: None, simd: None };

    /// The CPU engine at one instruction set.
    pub fn cpu(simd: SimdLevel) -> Self {
        Self { engine: Engine::Cpu, threads: None, simd: Some(simd) }
    }

    /// Smooths a frame with all outputs.
    ///
    /// # Panics
    /// If the engine fails.
    pub fn smooth<'a>(self, frame: impl Into<Frame<'a>>, params: SmoothParams) -> Smoothed {
        let frame = frame.into();
        let options =
            SmootherOptions { engine: self.engine, outputs: Outputs::ALL, threads: self.threads, simd: self.simd };
        let mut smoother = Smoother::open_with(params, options, frame.shape()).expect("an engine");
        let mut smoothed = Smoothed::default();
        smoother.smooth(frame, &mut smoothed).expect("a result");
        smoothed
    }
}

/// r(z) of docs/method.md, section 3, written once more for the checks.
pub fn radius_m(cloud: &OrganizedCloud, params: SmoothParams) -> impl Fn(f64) -> f64 {
    let pitch = cloud.pixel_pitch_at_1m().unwrap_or(1.0 / 525.0);
    move |z| match params.radius {
        Radius::Fixed { radius_m } => f64::from(radius_m),
        Radius::Sensor { depth_step_at_1m } => {
            let reach = f64::from(params.window * params.stride);
            (1.5 * reach * z.abs() * pitch).max(4.0 * f64::from(depth_step_at_1m) * z * z)
        }
    }
}

/// The corners of the parameter space and a sample between them: windows 1 to 7, strides 1 to 3, degrees 1 to 3, both
/// radius rules.
pub fn parameter_grid() -> Vec<SmoothParams> {
    let fixed = Radius::Fixed { radius_m: 0.03 };
    let corners = [1, 7].into_iter().flat_map(|window| {
        [1, 3].into_iter().flat_map(move |stride| {
            [1, 2, 3].into_iter().flat_map(move |degree| {
                [fixed, Radius::KINECT_V1].map(|radius| SmoothParams {
                    window,
                    stride,
                    radius,
                    degree,
                    bandwidth_m: None,
                })
            })
        })
    });
    let between = [(2, 2, 3), (3, 1, 3), (3, 3, 2), (4, 2, 2), (5, 1, 3), (6, 2, 1), (3, 8, 3)].into_iter().flat_map(
        |(window, stride, degree)| {
            [fixed, Radius::KINECT_V1].map(|radius| SmoothParams { window, stride, radius, degree, bandwidth_m: None })
        },
    );
    let bandwidth = SmoothParams { bandwidth_m: Some(0.01), ..SmoothParams::paper() };
    corners.chain(between).chain([bandwidth]).collect()
}
