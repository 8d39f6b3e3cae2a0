//! What the caller may choose: one plain struct with public fields; its defaults live in `impl Default` alone.

use std::ops::RangeInclusive;

use crate::error::ParamError;
use crate::frame::{Frame, FrameGeometry, GeometryScratch, IntoFrame, PointsView};
use crate::sensor::SensorModel;

/// How the radius of a neighbourhood is found (docs/method.md, section 3).
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Radius {
    /// One radius for every point, in metres.
    Fixed {
        /// The radius in metres.
        radius_m: f32,
    },
    /// For general clouds: the radius within which evenly spread points would number so many, of the density around each point; at
    /// most one and a half times the mean radius of its neighbours (docs/method.md, section 8).
    Neighbours {
        /// How many, 6 to 1000.
        count: u32,
    },
    /// r(z) = max(2 k s pitch z, 4 step(z)): wide enough for the window at this range, and for the sensor's depth steps.
    Sensor,
}

/// What becomes of creases and steps (docs/method.md, section 10).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Edges {
    /// Every neighbour counts: the surface is rounded off within a window's reach of an edge.
    Off,
    /// The surface of each point is taken from the planes around it, and neighbours off that surface by more than the sensor's
    /// noise do not count: edges stay, and flat surfaces are smoother too. In general clouds the noise is that of the planes around a point.
    Robust,
}

/// Along which line a point is put onto the fitted surface (docs/method.md, section 7).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Project {
    /// Along the ray on which it was measured, as depth noise acts: points stay on the rays of their pixels. Where it is not
    /// known where the sensor stood, and in general clouds, along the normal.
    Ray,
    /// Along the normal of its plane.
    Normal,
}

/// The range at which sensors' noise is compared, in metres.
const TUNED_RANGE_M: f64 = 1.5;

/// Less noise than this at 1 m needs no wide windows: it is no more than what rounding to millimetres makes.
const LITTLE_SIGMA_M: f64 = 3e-4;

/// The focal length that strides are chosen for: a Kinect v1's, in pixels.
const TUNED_FOCAL_LENGTH_PX: f64 = 525.0;
/// Added before a stride is cut to a whole number: it is rounded up from 0.4 on, so that halves, of half the resolution, do not
/// hang on an estimate's last digits.
const ROUNDING: f64 = 0.6;
/// The share of its reach in pixels that a window keeps on coarse pixels, as far as windows go.
const LEAST_REACH: f64 = 0.5;
/// The widest window that is allowed.
const WIDEST: u32 = 7;
/// The strides that are allowed.
const STRIDES: RangeInclusive<u32> = 1..=8;

/// The ridge of [`SmoothParams::for_sensor`].
const RIDGE: f32 = 2.5e-2;
/// The same with [`Strength::LIGHT`].
const LIGHT_RIDGE: f32 = 1e-2;
/// The ridge of [`SmoothParams::paper`] and of sensors without noise: shapes are those of the plain polynomial.
const SMALL_RIDGE: f32 = 1e-3;

/// About how many neighbours points of general clouds have by default.
const GENERAL_NEIGHBOURS: u32 = 40;

/// How far and how much to smooth, from 0 to 1: windows grow in steps, the ridge steadily.
///
/// ```
/// use planish::{SmoothParams, Strength, SensorModel};
///
/// let params = SmoothParams::for_sensor(SensorModel::KINECT_V1, Strength::new(0.8)?);
/// assert_eq!(params.reach_px(), SmoothParams::for_sensor(SensorModel::KINECT_V1, Strength::STRONG).reach_px());
/// assert!(Strength::new(1.5).is_err());
/// # Ok::<(), planish::ParamError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strength(f32);

impl Strength {
    /// 0: windows of 15x15 pixels of a Kinect v1, for small things.
    pub const LIGHT: Self = Self(0.0);
    /// 0.5: windows of 25x25 pixels.
    pub const DEFAULT: Self = Self(0.5);
    /// 1: windows of 29x29 pixels, with 49 samples instead of 25: for walls, floors and far ranges.
    pub const STRONG: Self = Self(1.0);

    /// Returns a strength; refuses what is not 0 to 1.
    pub fn new(strength: f32) -> Result<Self, ParamError> {
        if (0.0..=1.0).contains(&strength) {
            Ok(Self(strength))
        } else {
            Err(ParamError { field: "strength", value: strength.to_string(), allowed: "0 (light) to 1 (strong)" })
        }
    }

    /// The strength, 0 to 1.
    pub const fn get(self) -> f32 {
        self.0
    }

    /// Window and stride for a sensor with noise of so many times a Kinect v1's: between light, default and strong the nearest.
    fn noisy_window(self, noise: f64) -> (u32, u32) {
        let (window, kinect_stride) = if self.0 < 0.75 { (2, 3.0 + 4.0 * self.0.min(0.5)) } else { (3, 4.0) };
        // Light and default differ by two pixels of stride, so the one between them is a step of its own.
        let stride = f64::from(kinect_stride).round() * noise.cbrt();
        (window, (stride.round() as u32).clamp(*STRIDES.start(), *STRIDES.end()))
    }

    /// Half width of the window for a sensor without: 2, 5 and 7 pixels at 0, 0.5 and 1, and the whole numbers between.
    fn exact_window(self) -> u32 {
        let half_px = if self.0 < 0.5 { 2.0 + 6.0 * self.0 } else { 3.0 + 4.0 * self.0 };
        half_px.round() as u32
    }

    /// The ridge for a sensor with noise: light's grows to the default's, which stays.
    fn noisy_ridge(self) -> f32 {
        LIGHT_RIDGE * (RIDGE / LIGHT_RIDGE).powf((2.0 * self.0).min(1.0))
    }
}

impl Default for Strength {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// The parameters of the smoother.
///
/// ```
/// use planish::SmoothParams;
///
/// let params = SmoothParams::default().with_window(4);
/// assert!(params.validate().is_ok());
/// let error = params.with_window(9).validate().unwrap_err();
/// assert_eq!(error.to_string(), "window = 9 is not allowed: 1 to 7");
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct SmoothParams {
    /// Half width k of the pixel window; the candidates are (2k+1)² samples. 1 to 7.
    pub window: u32,
    /// Distance s between candidates in pixels. 1 to 8.
    pub stride: u32,
    /// Whether every sample is the mean of its block of pixels, as wide as the stride or a pixel wider where that is even, so that every
    /// pixel of the window counts. General clouds have none.
    pub average_blocks: bool,
    /// The gate: candidates further away than this from the point are no neighbours.
    pub radius: Radius,
    /// Highest degree of the polynomial fitted over the plane. 1 (the plane itself) to 3.
    pub degree: u32,
    /// Bandwidth B of the Gaussian weight exp(-d²/B²) in metres; `None` is the radius.
    pub bandwidth_m: Option<f32>,
    /// Ridge lambda of the polynomial fit (docs/method.md, section 6): how much its slopes, curvatures and third derivatives are
    /// damped. A soft degree: small values leave the whole polynomial, large ones the plane. 1e-3 to 100.
    pub ridge: f32,
    /// Whether points move along their rays or along normals.
    pub project: Project,
    /// Whether edges are kept.
    pub edges: Edges,
    /// Whether isolated points of a general cloud become holes, those with fewer than three neighbours or a quarter of
    /// [`Radius::Neighbours`]; else they stay as measured.
    pub remove_isolated: bool,
    /// Whose steps and noise they are: [`Radius::Sensor`], [`Edges::Robust`] and block means go by it.
    pub sensor: SensorModel,
}

impl Default for SmoothParams {
    /// [`SmoothParams::for_sensor`] of a Kinect v1 and [`Strength::DEFAULT`]: on correlated Kinect noise this leaves a fifth of
    /// the error, and less than half of what [`SmoothParams::paper`] leaves.
    fn default() -> Self {
        Self::for_sensor(SensorModel::KINECT_V1, Strength::default())
    }
}

impl SmoothParams {
    /// A setting for a sensor: degree 2, edges kept, the radius and the noise of the sensor.
    ///
    /// The width of windows goes with the cube root of the noise at 1.5 m, where what is left of it and what a curved surface is
    /// flattened by balance: 25x25 pixels for a Kinect v1, 31x31 for a RealSense D435, 15x15 for an Azure Kinect. A sensor with hardly
    /// any noise (under 0.3 mm at 1 m) gets 11x11: there is little to gain, and small things to lose.
    pub fn for_sensor(sensor: SensorModel, strength: Strength) -> Self {
        let has_noise = sensor.sigma_m(1.0) >= LITTLE_SIGMA_M;
        let noise = sensor.sigma_m(TUNED_RANGE_M) / SensorModel::KINECT_V1.sigma_m(TUNED_RANGE_M);
        let (window, stride) = if has_noise { strength.noisy_window(noise) } else { (strength.exact_window(), 1) };
        let ridge = if has_noise { strength.noisy_ridge() } else { SMALL_RIDGE };
        let (radius, edges) = (Radius::Sensor, Edges::Robust);
        Self {
            window,
            stride,
            average_blocks: true,
            radius,
            degree: 2,
            bandwidth_m: None,
            ridge,
            project: Project::Ray,
            edges,
            remove_isolated: false,
            sensor,
        }
    }

    /// The same with another half width of the window, 1 to 7.
    pub const fn with_window(self, window: u32) -> Self {
        Self { window, ..self }
    }

    /// The same with another distance between candidates in pixels, 1 to 8.
    pub const fn with_stride(self, stride: u32) -> Self {
        Self { stride, ..self }
    }

    /// The same with block means or without.
    pub const fn with_average_blocks(self, average_blocks: bool) -> Self {
        Self { average_blocks, ..self }
    }

    /// The same with another rule for the radius.
    pub const fn with_radius(self, radius: Radius) -> Self {
        Self { radius, ..self }
    }

    /// The same with one radius in metres for every point.
    pub const fn with_radius_m(self, radius_m: f32) -> Self {
        self.with_radius(Radius::Fixed { radius_m })
    }

    /// The same with another highest degree of the polynomial, 1 to 3.
    pub const fn with_degree(self, degree: u32) -> Self {
        Self { degree, ..self }
    }

    /// The same with another bandwidth of the weights in metres; `None` is the radius.
    pub const fn with_bandwidth_m(self, bandwidth_m: Option<f32>) -> Self {
        Self { bandwidth_m, ..self }
    }

    /// The same with another ridge of the polynomial fit, 1e-3 to 100.
    pub const fn with_ridge(self, ridge: f32) -> Self {
        Self { ridge, ..self }
    }

    /// The same with points moved along their rays or along normals.
    pub const fn with_project(self, project: Project) -> Self {
        Self { project, ..self }
    }

    /// The same with edges kept or not.
    pub const fn with_edges(self, edges: Edges) -> Self {
        Self { edges, ..self }
    }

    /// The same with isolated points of a general cloud removed or kept.
    pub const fn with_remove_isolated(self, remove_isolated: bool) -> Self {
        Self { remove_isolated, ..self }
    }

    /// The same for another sensor.
    pub const fn with_sensor(self, sensor: SensorModel) -> Self {
        Self { sensor, ..self }
    }

    /// The same setting at the resolution of a frame. Strides are chosen for pixels of a Kinect v1, 1/525 of the range; where a
    /// frame's are coarser, they are as much shorter, so that windows span about as much of the scene, down to 1. (At 160x120 the
    /// default's windows would reach over whole objects and mix them.) Windows get wider where that leaves them less than half of
    /// their reach in pixels, since it is pixels that noise is averaged over. Finer pixels change nothing, and neither does a frame
    /// without any.
    ///
    /// ```
    /// use planish::{Camera, DepthFrame, SmoothParams};
    ///
    /// let camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);
    /// let frame = DepthFrame::new(camera, vec![1000; 320 * 240])?;
    /// assert_eq!(SmoothParams::default().stride, 5);
    /// assert_eq!(SmoothParams::default().at_resolution_of(&frame).stride, 3);
    /// # Ok::<(), planish::FrameError>(())
    /// ```
    pub fn at_resolution_of<'a>(self, frame: impl IntoFrame<'a>) -> Self {
        frame.into_frame().ok().and_then(|frame| self.at_known_resolution_of(frame)).unwrap_or(self)
    }

    /// The same, but `None` where the frame does not say, or where the stride is not allowed anyway.
    pub fn at_known_resolution_of(self, frame: Frame<'_>) -> Option<Self> {
        if !STRIDES.contains(&self.stride) || frame.grid().is_none() {
            return None;
        }
        let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
        let coarseness = geometry.rule.known_pitch_at_1m()? * TUNED_FOCAL_LENGTH_PX;
        let stride = (f64::from(self.stride) / coarseness + ROUNDING).floor();
        let stride = (stride as u32).clamp(1, self.stride);
        let least_reach_px = self.reach_px() as f64 * LEAST_REACH;
        let window = (least_reach_px / f64::from(stride)).ceil() as u32;
        Some(Self { stride, window: window.min(WIDEST).max(self.window), ..self })
    }

    /// The setting of the 2011 report: 49 adjacent pixels, 3 cm, degree 3.
    pub fn paper() -> Self {
        let radius = Radius::Fixed { radius_m: 0.03 };
        Self {
            window: 3,
            stride: 1,
            average_blocks: false,
            radius,
            degree: 3,
            bandwidth_m: None,
            ridge: SMALL_RIDGE,
            project: Project::Normal,
            edges: Edges::Off,
            remove_isolated: false,
            sensor: SensorModel::KINECT_V1,
        }
    }

    /// A setting for general clouds: degree 2, and a radius for about 40 neighbours by the density around each
    /// point.
    pub fn general() -> Self {
        Self { radius: Radius::Neighbours { count: GENERAL_NEIGHBOURS }, degree: 2, ..Self::paper() }
    }

    /// With fewer neighbours a point of a general cloud is isolated (docs/method.md, section 8).
    pub(crate) fn least_neighbours(&self, cloud: &PointsView<'_>) -> u32 {
        let Radius::Neighbours { count } = self.radius else { return 3 };
        let few = u32::try_from(cloud.points_of_whole().div_ceil(16)).unwrap_or(u32::MAX);
        count.div_ceil(4).min(few).max(3)
    }

    /// Refuses every value outside its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        let integer = |field, value: u32, range: std::ops::RangeInclusive<u32>, allowed| {
            if range.contains(&value) { Ok(()) } else { Err(ParamError { field, value: value.to_string(), allowed }) }
        };
        // Written so that a NaN is refused too.
        let real = |field, value: f32, range: std::ops::RangeInclusive<f32>, allowed| {
            if range.contains(&value) { Ok(()) } else { Err(ParamError { field, value: value.to_string(), allowed }) }
        };
        integer("window", self.window, 1..=WIDEST, "1 to 7")?;
        integer("stride", self.stride, STRIDES, "1 to 8")?;
        integer("degree", self.degree, 1..=3, "1 to 3")?;
        if let Radius::Fixed { radius_m } = self.radius {
            real("radius_m", radius_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
        }
        if let Radius::Neighbours { count } = self.radius {
            integer("neighbours", count, 6..=1000, "6 to 1000")?;
        }
        real("ridge", self.ridge, 1e-3..=100.0, "1e-3 to 100")?;
        self.sensor.validate()?;
        if let Some(bandwidth_m) = self.bandwidth_m {
            real("bandwidth_m", bandwidth_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
        }
        Ok(())
    }

    /// How far a window reaches from its centre, in pixels: k s.
    pub fn reach_px(&self) -> usize {
        (self.window * self.stride) as usize
    }

    /// Half width of the blocks that are averaged, in pixels: blocks are as wide as the stride, or a pixel wider where that is even.
    pub(crate) fn block_half_px(&self) -> usize {
        self.stride as usize / 2
    }

    /// Whether there is anything to average.
    pub(crate) fn averages_blocks(&self) -> bool {
        self.average_blocks && self.block_half_px() > 0
    }

    /// How many candidates a window has: (2k+1)².
    pub fn candidates(&self) -> usize {
        let side = 2 * self.window as usize + 1;
        side * side
    }
}

/// How far away in pixels the planes are that say which surface a point lies on: a little more than the reach k s of a window, so
/// that one of them is clear of an edge that the point itself is near to.
pub(crate) fn edge_shift_px(reach_px: usize) -> usize {
    (13 * reach_px + 6) / 12
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::frame::DepthFrame;

    #[test]
    fn strides_follow_coarse_pixels_and_nothing_else() {
        let strides = |fx: f64, stride| {
            let camera = Camera::new((40, 4), [fx; 2], [19.5, 1.5]);
            let depth = DepthFrame::new(camera, vec![1000; 160]).unwrap();
            let mut cloud = depth.deproject().unwrap();
            // As a file has it: the pitch must be estimated.
            cloud.camera = None;
            let params = SmoothParams::default().with_stride(stride);
            let [of_depth, of_cloud] = [params.at_resolution_of(&depth), params.at_resolution_of(&cloud)];
            assert_eq!(of_depth, of_cloud);
            assert_eq!(of_depth, params.with_stride(of_depth.stride).with_window(of_depth.window));
            (of_depth.window, of_depth.stride)
        };
        let of_default: Vec<_> =
            [1000.0, 525.0, 425.0, 366.0, 262.5, 210.0, 131.25, 10.0].map(|fx| strides(fx, 5)).into();
        assert_eq!(of_default, [(2, 5), (2, 5), (2, 4), (2, 4), (2, 3), (3, 2), (5, 1), (5, 1)]);
        assert_eq!((strides(525.0, 1), strides(262.5, 2), strides(262.5, 8)), ((2, 1), (2, 1), (2, 4)));
        // What is not allowed stays so, and is refused later.
        assert_eq!((strides(100.0, 0), strides(100.0, 12)), ((2, 0), (2, 12)));
    }

    #[test]
    fn windows_go_with_the_noise_of_the_sensor() {
        let of = |sensor| {
            [Strength::LIGHT, Strength::DEFAULT, Strength::STRONG].map(|strength| {
                let params = SmoothParams::for_sensor(sensor, strength);
                (params.window, params.stride)
            })
        };
        assert_eq!(of(SensorModel::KINECT_V1), [(2, 3), (2, 5), (3, 4)]);
        assert_eq!(of(SensorModel::REALSENSE_D435), [(2, 4), (2, 6), (3, 5)]);
        assert_eq!(of(SensorModel::AZURE_KINECT), [(2, 2), (2, 3), (3, 2)]);
        assert_eq!(of(SensorModel::REALSENSE_L515), [(2, 3), (2, 5), (3, 4)]);
    }

    #[test]
    fn strength_never_narrows_a_window_or_lessens_the_ridge() {
        for sensor in [SensorModel::KINECT_V1, SensorModel::REALSENSE_D435, SensorModel::EXACT] {
            let of = |percent: u32| SmoothParams::for_sensor(sensor, Strength::new(percent as f32 / 100.0).unwrap());
            for percent in 0..100 {
                let (weaker, stronger) = (of(percent), of(percent + 1));
                assert!(weaker.reach_px() <= stronger.reach_px() && weaker.ridge <= stronger.ridge, "{percent} %");
                assert!(stronger.validate().is_ok());
            }
        }
        let exact = [Strength::LIGHT, Strength::DEFAULT, Strength::STRONG].map(Strength::exact_window);
        assert_eq!(exact, [2, 5, 7]);
        let ridges = [Strength::LIGHT, Strength::DEFAULT, Strength::STRONG].map(Strength::noisy_ridge);
        for (ridge, expected) in ridges.into_iter().zip([LIGHT_RIDGE, RIDGE, RIDGE]) {
            assert!((ridge / expected - 1.0).abs() < 1e-6, "{ridge} {expected}");
        }
        assert!(Strength::new(f32::NAN).is_err() && Strength::new(-0.1).is_err());
    }

    #[test]
    fn a_frame_that_says_nothing_of_its_resolution_changes_nothing() {
        let params = SmoothParams::default();
        let camera = Camera::new((40, 4), [100.0; 2], [19.5, 1.5]);
        let depth = DepthFrame::new(camera, vec![0; 160]).unwrap();
        let mut empty = depth.deproject().unwrap();
        empty.camera = None;
        assert_eq!(params.at_resolution_of(&empty), params);
        assert_eq!(params.at_resolution_of(&depth).stride, 1, "depth has its camera");
        let short = DepthFrame { raw: vec![1000; 100], ..depth.clone() };
        let mut cut = depth.deproject().unwrap();
        cut.points.positions.x.truncate(20);
        let bad = DepthFrame { camera: Camera { fx: f64::NAN, ..camera }, ..depth };
        assert_eq!(params.at_resolution_of(&short), params);
        assert_eq!(params.at_resolution_of(&cut), params);
        assert_eq!(params.at_resolution_of(&bad), params);
    }

    #[test]
    fn every_field_is_refused_outside_its_range_by_name_value_and_range() {
        let ok = SmoothParams::default();
        let fixed = |radius_m| Radius::Fixed { radius_m };
        let cases = [
            (ok.with_window(0), "window", "0", "1 to 7"),
            (ok.with_window(8), "window", "8", "1 to 7"),
            (ok.with_stride(0), "stride", "0", "1 to 8"),
            (ok.with_stride(9), "stride", "9", "1 to 8"),
            (ok.with_degree(0), "degree", "0", "1 to 3"),
            (ok.with_degree(4), "degree", "4", "1 to 3"),
            (ok.with_radius(fixed(-0.5)), "radius_m", "-0.5", "1e-6 to 1000"),
            (ok.with_radius(fixed(f32::NAN)), "radius_m", "NaN", "1e-6 to 1000"),
            (ok.with_radius(fixed(f32::INFINITY)), "radius_m", "inf", "1e-6 to 1000"),
            (ok.with_sensor(SensorModel::new([-1.0, 0.0, 0.0], [0.0; 3])), "sensor.step", "[-1.0, 0.0, 0.0]", "three"),
            (ok.with_sensor(SensorModel::new([0.0; 3], [0.0, 0.0, 2.0])), "sensor.sigma", "[0.0, 0.0, 2.0]", "three"),
            (ok.with_bandwidth_m(Some(0.0)), "bandwidth_m", "0", "1e-6 to 1000"),
            (ok.with_ridge(0.0), "ridge", "0", "1e-3 to 100"),
            (ok.with_ridge(f32::NAN), "ridge", "NaN", "1e-3 to 100"),
        ];
        for (params, field, value, allowed) in cases {
            let error = params.validate().unwrap_err();
            assert_eq!((error.field, error.value.as_str()), (field, value));
            assert!(error.allowed.starts_with(allowed), "{error}");
        }
        assert!(ok.validate().is_ok());
        assert!(SmoothParams::paper().validate().is_ok());
    }
}
