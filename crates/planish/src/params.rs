//! What the caller may choose: one plain struct with public fields; its defaults live in `impl Default` alone.

use std::ops::RangeInclusive;

use crate::error::ParamError;
use crate::frame::Frame;

/// How the radius of a neighbourhood is found (docs/method.md, section 3).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Radius {
    /// One radius for every point, in metres.
    Fixed {
        /// The radius in metres.
        radius_m: f32,
    },
    /// r(z) = max(1.5 k s z/fx, 4 step z²): wide enough for the window at this range, and for the depth noise.
    Sensor {
        /// The depth step of the sensor at 1 m, in metres; it grows with z². Kinect v1: 2.85e-3.
        depth_step_at_1m: f32,
    },
}

/// The depth step of a Kinect v1 in metres at a range of 1 m: one unit of its 11-bit disparity
/// (Khoshelham & Elberink 2012).
pub const KINECT_V1_DEPTH_STEP_AT_1M: f32 = 2.85e-3;

impl Radius {
    /// The sensor rule with the depth step of a Kinect v1.
    pub const KINECT_V1: Self = Self::Sensor { depth_step_at_1m: KINECT_V1_DEPTH_STEP_AT_1M };
}

/// The noise of a Kinect v1 in metres at a range of 1 m, as standard deviation: 0.63 of its depth step.
pub const KINECT_V1_NOISE_AT_1M: f32 = 1.8e-3;

/// What becomes of creases and steps (docs/method.md, section 10).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Edges {
    /// Every neighbour counts: the surface is rounded off within a window's reach of an edge.
    Off,
    /// The surface of each point is taken from the planes around it, and neighbours off that surface by more than the noise do
    /// not count: edges stay, and flat surfaces are smoother too. Clouds without a grid are smoothed without it.
    Robust {
        /// The standard deviation of depth at 1 m, in metres; it grows with z². Kinect v1: 1.8e-3.
        noise_at_1m: f32,
    },
}

/// What a smoother must know of a depth sensor. Both numbers grow with z², as those of triangulating sensors do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// From one depth that it can tell to the next at 1 m, in metres.
    pub depth_step_at_1m: f32,
    /// The standard deviation of depth at 1 m, in metres.
    pub noise_at_1m: f32,
}

impl Sensor {
    /// A Kinect v1, or another camera with its pattern (Xtion, PrimeSense Carmine).
    pub const KINECT_V1: Self =
        Self { depth_step_at_1m: KINECT_V1_DEPTH_STEP_AT_1M, noise_at_1m: KINECT_V1_NOISE_AT_1M };
    /// Stereo of some 5 cm baseline with disparities in 32nds of a pixel, as a RealSense D400.
    pub const STEREO: Self = Self { depth_step_at_1m: 3.2e-3, noise_at_1m: 2e-3 };
    /// Depth without noise: rendered, or averaged long.
    pub const EXACT: Self = Self { depth_step_at_1m: 0.0, noise_at_1m: 0.0 };
}

/// Less noise than this needs no wide windows.
const LITTLE_NOISE_AT_1M: f32 = 2e-4;

/// The focal length that strides are chosen for: a Kinect v1's, in pixels.
const TUNED_FOCAL_LENGTH_PX: f64 = 525.0;
/// Added before a stride is cut to a whole number: it is rounded up from 0.4 on, so that halves, of half the resolution, do not
/// hang on an estimate's last digits.
const ROUNDING: f64 = 0.6;
/// The strides that are allowed.
const STRIDES: RangeInclusive<u32> = 1..=8;

/// How far and how much to smooth; the pixels are those for a sensor with noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Strength {
    /// 49 candidates over 13x13 pixels: for small things.
    Light,
    /// 121 candidates over 31x31 pixels.
    #[default]
    Default,
    /// 225 candidates over 43x43 pixels: for walls, floors and far ranges.
    Strong,
}

impl Edges {
    /// Robust against the noise of a Kinect v1.
    pub const KINECT_V1: Self = Self::Robust { noise_at_1m: KINECT_V1_NOISE_AT_1M };
}

/// The parameters of the smoother.
///
/// ```
/// use planish::{Radius, SmoothParams};
///
/// let params = SmoothParams { window: 4, ..SmoothParams::default() };
/// assert!(params.validate().is_ok());
/// let error = SmoothParams { window: 9, ..params }.validate().unwrap_err();
/// assert_eq!(error.to_string(), "window = 9 is not allowed: 1 to 7");
/// # let _ = Radius::KINECT_V1;
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SmoothParams {
    /// Half width k of the pixel window; the candidates are (2k+1)² pixels. 1 to 7.
    pub window: u32,
    /// Distance s between candidates in pixels. 1 to 8.
    pub stride: u32,
    /// The gate: candidates further away than this from the point are no neighbours.
    pub radius: Radius,
    /// Highest degree of the polynomial fitted over the plane. 1 (the plane itself) to 3.
    pub degree: u32,
    /// Bandwidth g of the Gaussian weight exp(-d²/g²) in metres; `None` is the radius.
    pub bandwidth_m: Option<f32>,
    /// Whether edges are kept.
    pub edges: Edges,
}

impl Default for SmoothParams {
    /// [`SmoothParams::for_sensor`] of a Kinect v1 and [`Strength::Default`]: on correlated Kinect noise this leaves a quarter of
    /// the error, and less than half of what [`SmoothParams::paper`] leaves.
    fn default() -> Self {
        Self::for_sensor(Sensor::KINECT_V1, Strength::default())
    }
}

impl SmoothParams {
    /// A setting for a sensor: degree 2, edges kept, the radius and the noise of the sensor.
    ///
    /// A sensor with hardly any noise (under 0.2 mm at 1 m) gets windows a third as wide: there is little to gain, and small
    /// things to lose.
    pub fn for_sensor(sensor: Sensor, strength: Strength) -> Self {
        let has_noise = sensor.noise_at_1m >= LITTLE_NOISE_AT_1M;
        let (window, stride) = match strength {
            Strength::Light if has_noise => (3, 2),
            Strength::Default if has_noise => (5, 3),
            Strength::Strong if has_noise => (7, 3),
            Strength::Light => (2, 1),
            Strength::Default => (5, 1),
            Strength::Strong => (7, 1),
        };
        let radius = Radius::Sensor { depth_step_at_1m: sensor.depth_step_at_1m };
        let edges = Edges::Robust { noise_at_1m: sensor.noise_at_1m };
        Self { window, stride, radius, degree: 2, bandwidth_m: None, edges }
    }

    /// The same setting at the resolution of a frame. Strides are chosen for pixels of a Kinect v1, 1/525 of the range; where a
    /// frame's are coarser, they are as much shorter, so that windows span about as much of the scene, down to 1. Finer pixels
    /// change nothing, and neither does a frame without any. (At 160x120 the default's windows would reach over whole objects and
    /// mix them.)
    ///
    /// ```
    /// use planish::{Camera, DepthFrame, SmoothParams};
    ///
    /// let camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5, ..Camera::kinect_v1() };
    /// let frame = DepthFrame { camera, raw: vec![1000; 320 * 240], rgb: None, timestamp_s: None };
    /// assert_eq!(SmoothParams::default().stride, 3);
    /// assert_eq!(SmoothParams::default().at_resolution_of(&frame).stride, 2);
    /// ```
    pub fn at_resolution_of<'a>(self, frame: impl Into<Frame<'a>>) -> Self {
        self.at_known_resolution_of(frame.into()).unwrap_or(self)
    }

    /// The same, but `None` where the frame does not say, being empty or not what it says, or where the stride is not allowed
    /// anyway.
    pub(crate) fn at_known_resolution_of(self, frame: Frame<'_>) -> Option<Self> {
        if frame.validate().is_err() || !STRIDES.contains(&self.stride) {
            return None;
        }
        let coarseness = frame.known_pitch_at_1m(&mut Vec::new())? * TUNED_FOCAL_LENGTH_PX;
        let stride = (f64::from(self.stride) / coarseness + ROUNDING).floor();
        Some(Self { stride: (stride as u32).clamp(1, self.stride), ..self })
    }

    /// The setting of the 2011 report: 49 adjacent pixels, 3 cm, degree 3.
    pub fn paper() -> Self {
        let radius = Radius::Fixed { radius_m: 0.03 };
        Self { window: 3, stride: 1, radius, degree: 3, bandwidth_m: None, edges: Edges::Off }
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
        integer("window", self.window, 1..=7, "1 to 7")?;
        integer("stride", self.stride, STRIDES, "1 to 8")?;
        integer("degree", self.degree, 1..=3, "1 to 3")?;
        match self.radius {
            Radius::Fixed { radius_m } => {
                real("radius_m", radius_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
            }
            Radius::Sensor { depth_step_at_1m } => {
                real("depth_step_at_1m", depth_step_at_1m, 0.0..=1.0, "0 to 1 metre")?
            }
        }
        if let Edges::Robust { noise_at_1m } = self.edges {
            real("noise_at_1m", noise_at_1m, 0.0..=1.0, "0 to 1 metre")?;
        }
        if let Some(bandwidth_m) = self.bandwidth_m {
            real("bandwidth_m", bandwidth_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
        }
        Ok(())
    }

    /// How far a window reaches from its centre, in pixels: k s.
    pub fn reach_px(&self) -> usize {
        (self.window * self.stride) as usize
    }

    /// How many candidates a window has: (2k+1)².
    pub fn candidates(&self) -> usize {
        let side = 2 * self.window as usize + 1;
        side * side
    }
}

/// How far away in pixels the planes are that say which surface a point lies on: nine tenths of the reach k s of a window, so
/// that one of them is clear of an edge that the point itself is near to.
pub(crate) fn edge_shift_px(reach_px: u32) -> u32 {
    (9 * reach_px + 5) / 10
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::frame::DepthFrame;

    #[test]
    fn strides_follow_coarse_pixels_and_nothing_else() {
        let strides = |fx: f64, stride| {
            let camera = Camera { width: 40, height: 4, fx, fy: fx, cx: 19.5, cy: 1.5, ..Camera::kinect_v1() };
            let depth = DepthFrame { camera, raw: vec![1000; 160], rgb: None, timestamp_s: None };
            let mut cloud = depth.deproject().unwrap();
            // As a file has it: the pitch must be estimated.
            cloud.camera = None;
            let params = SmoothParams { stride, ..SmoothParams::default() };
            let [of_depth, of_cloud] = [params.at_resolution_of(&depth), params.at_resolution_of(&cloud)];
            assert_eq!(of_depth, of_cloud);
            assert_eq!(of_depth, SmoothParams { stride: of_depth.stride, ..params });
            of_depth.stride
        };
        let of_default: Vec<_> =
            [1000.0, 525.0, 425.0, 366.0, 262.5, 210.0, 131.25, 10.0].map(|fx| strides(fx, 3)).into();
        assert_eq!(of_default, [3, 3, 3, 2, 2, 1, 1, 1]);
        assert_eq!((strides(525.0, 1), strides(262.5, 2), strides(262.5, 8)), (1, 1, 4));
        // What is not allowed stays so, and is refused later.
        assert_eq!((strides(100.0, 0), strides(100.0, 12)), (0, 12));
    }

    #[test]
    fn a_frame_that_says_nothing_of_its_resolution_changes_nothing() {
        let params = SmoothParams::default();
        let camera = Camera { width: 40, height: 4, fx: 100.0, fy: 100.0, cx: 19.5, cy: 1.5, ..Camera::kinect_v1() };
        let depth = DepthFrame { camera, raw: vec![0; 160], rgb: None, timestamp_s: None };
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
            (SmoothParams { window: 0, ..ok }, "window", "0", "1 to 7"),
            (SmoothParams { window: 8, ..ok }, "window", "8", "1 to 7"),
            (SmoothParams { stride: 0, ..ok }, "stride", "0", "1 to 8"),
            (SmoothParams { stride: 9, ..ok }, "stride", "9", "1 to 8"),
            (SmoothParams { degree: 0, ..ok }, "degree", "0", "1 to 3"),
            (SmoothParams { degree: 4, ..ok }, "degree", "4", "1 to 3"),
            (SmoothParams { radius: fixed(-0.5), ..ok }, "radius_m", "-0.5", "1e-6 to 1000"),
            (SmoothParams { radius: fixed(f32::NAN), ..ok }, "radius_m", "NaN", "1e-6 to 1000"),
            (SmoothParams { radius: fixed(f32::INFINITY), ..ok }, "radius_m", "inf", "1e-6 to 1000"),
            (
                SmoothParams { radius: Radius::Sensor { depth_step_at_1m: -1.0 }, ..ok },
                "depth_step_at_1m",
                "-1",
                "0 to 1",
            ),
            (SmoothParams { edges: Edges::Robust { noise_at_1m: 2.0 }, ..ok }, "noise_at_1m", "2", "0 to 1"),
            (SmoothParams { bandwidth_m: Some(0.0), ..ok }, "bandwidth_m", "0", "1e-6 to 1000"),
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
