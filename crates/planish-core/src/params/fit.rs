//! Parameters of the fit, shared by frames and clouds, and checks of ranges.

use crate::error::ParamError;

/// The ridge of [`Strength::DEFAULT`](super::Strength::DEFAULT) and all higher strengths, for sensors with noise.
pub(super) const RIDGE: f32 = 2.5e-2;
/// The ridge of [`Strength::LIGHT`](super::Strength::LIGHT), for sensors with noise.
pub(super) const LIGHT_RIDGE: f32 = 1e-2;
/// The ridge of [`FrameParams::paper`](super::FrameParams::paper) and of sensors without noise: small enough to leave
/// the plain polynomial unchanged.
pub(super) const SMALL_RIDGE: f32 = 1e-3;

/// Parameters of the surface that is fitted to the neighbours of a point, in frames and in clouds.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Fit {
    /// Highest degree of the polynomial over the plane: 1 (the plane itself) to 3.
    pub degree: u32,
    /// Bandwidth B of the Gaussian weight exp(-d²/B²) in metres; `None` for the radius.
    pub bandwidth_m: Option<f32>,
    /// Ridge lambda of the polynomial fit (docs/method.md, section 6), 1e-3 to 100: damps slopes, curvatures and
    /// third derivatives. Small values keep the whole polynomial, large values reduce it to the plane.
    pub ridge: f32,
    /// Handling of creases and steps.
    pub edges: Edges,
}

impl Fit {
    /// The fit of the 2011 report: degree 3, hardly any ridge, edges rounded.
    pub(super) const PAPER: Self = Self { degree: 3, bandwidth_m: None, ridge: SMALL_RIDGE, edges: Edges::Off };

    /// Refuses every value outside its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        check("degree", self.degree, 1..=3, "1 to 3")?;
        check("ridge", self.ridge, 1e-3..=100.0, "1e-3 to 100")?;
        match self.bandwidth_m {
            Some(bandwidth_m) => check("bandwidth_m", bandwidth_m, 1e-6..=1e3, "1e-6 to 1000 metres"),
            None => Ok(()),
        }
    }
}

/// Implements the setters of [`Fit`]'s fields for a struct with a field `fit`.
macro_rules! fit_setters {
    () => {
        /// Sets the highest degree of the polynomial, 1 to 3.
        pub const fn with_degree(mut self, degree: u32) -> Self {
            self.fit.degree = degree;
            self
        }

        /// Sets the bandwidth of the weights in metres; `None` for the radius.
        pub const fn with_bandwidth_m(mut self, bandwidth_m: Option<f32>) -> Self {
            self.fit.bandwidth_m = bandwidth_m;
            self
        }

        /// Sets the ridge of the polynomial fit, 1e-3 to 100.
        pub const fn with_ridge(mut self, ridge: f32) -> Self {
            self.fit.ridge = ridge;
            self
        }

        /// Sets the handling of edges.
        pub const fn with_edges(mut self, edges: Edges) -> Self {
            self.fit.edges = edges;
            self
        }
    };
}
pub(super) use fit_setters;

/// Handling of creases and steps (docs/method.md, section 10).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Edges {
    /// Every neighbour counts: the surface is rounded off within a window's reach of an edge.
    Off,
    /// The surface of each point is found from the planes around it, and neighbours that are farther from that
    /// surface than the sensor's noise are ignored. Edges stay sharp, and flat surfaces become smoother too. In
    /// unorganized clouds, the planes around a point determine its noise.
    Robust,
}

impl Edges {
    /// All choices with their names in settings.
    pub const NAMED: [(&'static str, Self); 2] = [("off", Self::Off), ("robust", Self::Robust)];

    /// Returns the name in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Robust => "robust",
        }
    }
}

/// Direction in which a point is moved onto the fitted surface (docs/method.md, section 7).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Project {
    /// Along the measuring ray, the direction of depth noise: points stay on the rays of their pixels. If the sensor
    /// position is unknown, along the normal.
    Ray,
    /// Along the normal of the point's plane.
    Normal,
}

impl Project {
    /// All choices with their names in settings.
    pub const NAMED: [(&'static str, Self); 2] = [("ray", Self::Ray), ("normal", Self::Normal)];
}

/// Refuses a value outside its range, NaN included.
pub(super) fn check<T: PartialOrd + ToString>(
    field: &'static str,
    value: T,
    range: std::ops::RangeInclusive<T>,
    allowed: &'static str,
) -> Result<(), ParamError> {
    if range.contains(&value) { Ok(()) } else { Err(ParamError { field, value: value.to_string(), allowed }) }
}
