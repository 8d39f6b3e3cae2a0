//! Parameters of frames on a grid: depth images and organized clouds.

use super::fit::{Edges, Fit, Project, SMALL_RIDGE, check, fit_setters};
use super::strength::Strength;
use super::window::{Window, WindowSize};
use crate::error::ParamError;
use crate::frame::{Frame, FrameGeometry, GeometryScratch, IntoFrame};
use crate::sensor::SensorModel;

/// Range in metres at which the noise of sensors is compared.
const TUNED_RANGE_M: f64 = 1.5;
/// Noise at a range of 1 m, in metres, below which a sensor needs no wide windows. Such noise is no larger than the
/// rounding of depth to millimetres.
const LITTLE_SIGMA_M: f64 = 3e-4;

/// The radius of a neighbourhood in frames (docs/method.md, section 3).
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum FrameRadius {
    /// A radius that grows with the range z: r(z) = max(2 k s pitch z, 4 step(z)), with the half-width k and the
    /// stride s of the window, the pixel pitch at 1 m, and the sensor's depth step. It covers the window at this
    /// range, and the depth steps.
    Sensor,
    /// One radius for every point, in metres.
    Fixed {
        /// The radius in metres.
        radius_m: f32,
    },
}

/// The parameters of frames on a grid.
///
/// ```
/// use planish::FrameParams;
///
/// let params = FrameParams::default().with_window(4);
/// assert!(params.validate().is_ok());
/// let error = params.with_window(9).validate().unwrap_err();
/// assert_eq!(error.to_string(), "window = 9 is not allowed: 1 to 7");
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct FrameParams {
    /// Parameters of the fitted surface.
    pub fit: Fit,
    /// The window of samples around each pixel.
    pub window: Window,
    /// Whether every sample is the mean of a block of pixels, so that every pixel of the window contributes. Blocks
    /// are as wide as the stride, or one pixel wider if the stride is even.
    pub average_blocks: bool,
    /// The gate: samples whose distance from the point exceeds this radius are not neighbours.
    pub radius: FrameRadius,
    /// Direction in which points move: along their rays or along normals.
    pub project: Project,
    /// Sensor noise model used by [`FrameRadius::Sensor`], [`Edges::Robust`] and block averaging.
    pub sensor: SensorModel,
}

impl Default for FrameParams {
    /// Returns [`FrameParams::for_sensor`] for a Kinect v1 and [`Strength::DEFAULT`]. With correlated Kinect noise, a
    /// fifth of the error remains: less than half of the error that remains with [`FrameParams::paper`].
    fn default() -> Self {
        Self::for_sensor(SensorModel::KINECT_V1, Strength::default())
    }
}

impl FrameParams {
    /// Returns the parameters for a sensor: degree 2, edges kept, and the radius and noise of the sensor's model.
    ///
    /// The width of windows grows with the cube root of the noise at 1.5 m, which balances the remaining noise
    /// against the flattening of curved surfaces: 25x25 pixels for a Kinect v1, 31x31 for a RealSense D435, 15x15 for
    /// an Azure Kinect. A sensor with little noise (under 0.3 mm at 1 m) gets 11x11, to preserve small objects.
    pub fn for_sensor(sensor: SensorModel, strength: Strength) -> Self {
        let has_noise = sensor.sigma_m(1.0) >= LITTLE_SIGMA_M;
        let noise = sensor.sigma_m(TUNED_RANGE_M) / SensorModel::KINECT_V1.sigma_m(TUNED_RANGE_M);
        let size = if has_noise { strength.noisy_window(noise) } else { strength.exact_window() };
        let ridge = if has_noise { strength.noisy_ridge() } else { SMALL_RIDGE };
        Self {
            fit: Fit { degree: 2, bandwidth_m: None, ridge, edges: Edges::Robust },
            window: Window::Auto(size),
            average_blocks: true,
            radius: FrameRadius::Sensor,
            project: Project::Ray,
            sensor,
        }
    }

    /// Returns the parameters of the 2011 report: windows of 49 adjacent pixels, a radius of 3 cm, degree 3.
    pub fn paper() -> Self {
        Self {
            fit: Fit::PAPER,
            window: Window::Fixed(WindowSize { half_width: 3, stride: 1 }),
            average_blocks: false,
            radius: FrameRadius::Fixed { radius_m: 0.03 },
            project: Project::Normal,
            sensor: SensorModel::KINECT_V1,
        }
    }

    fit_setters!();

    /// Fixes the half-width of the window in samples, 1 to 7, and keeps the nominal stride.
    pub const fn with_window(mut self, half_width: u32) -> Self {
        self.window = Window::Fixed(WindowSize { half_width, ..self.window.nominal() });
        self
    }

    /// Fixes the distance between samples in pixels, 1 to 8, and keeps the nominal half-width.
    pub const fn with_stride(mut self, stride: u32) -> Self {
        self.window = Window::Fixed(WindowSize { stride, ..self.window.nominal() });
        self
    }

    /// Sets whether samples are means of blocks.
    pub const fn with_average_blocks(self, average_blocks: bool) -> Self {
        Self { average_blocks, ..self }
    }

    /// Sets the radius.
    pub const fn with_radius(self, radius: FrameRadius) -> Self {
        Self { radius, ..self }
    }

    /// Sets one radius in metres for every point.
    pub const fn with_radius_m(self, radius_m: f32) -> Self {
        self.with_radius(FrameRadius::Fixed { radius_m })
    }

    /// Sets the direction in which points move: along their rays or along normals.
    pub const fn with_project(self, project: Project) -> Self {
        Self { project, ..self }
    }

    /// Sets the sensor noise model, but not the values that [`for_sensor`](Self::for_sensor) derives from it.
    pub const fn with_sensor(self, sensor: SensorModel) -> Self {
        Self { sensor, ..self }
    }

    /// Returns these parameters with the window fixed for the resolution of a frame. A window that is already fixed
    /// is unchanged. If the resolution is unknown, the nominal size is used. Smoothers fix the window automatically.
    ///
    /// ```
    /// use planish::{Camera, DepthFrame, FrameParams};
    ///
    /// let camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);
    /// let frame = DepthFrame::new(camera, vec![1000; 320 * 240])?;
    /// assert_eq!(FrameParams::default().window.nominal().stride, 5);
    /// assert_eq!(FrameParams::default().at_resolution_of(&frame).window.nominal().stride, 3);
    /// # Ok::<(), planish::FrameError>(())
    /// ```
    pub fn at_resolution_of<'a>(self, frame: impl IntoFrame<'a>) -> Self {
        let pitch_at_1m = || {
            let frame: Frame<'_> = frame.into_frame().ok()?;
            frame.grid()?;
            FrameGeometry::of(frame, true, &mut GeometryScratch::default()).rule.known_pitch_at_1m()
        };
        let size = if self.window.is_auto() { pitch_at_1m() } else { None };
        let size = size.map_or(self.window.nominal(), |pitch| self.window.at_pitch(pitch));
        Self { window: Window::Fixed(size), ..self }
    }

    /// Refuses every value outside its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        self.window.nominal().validate()?;
        self.fit.validate()?;
        if let FrameRadius::Fixed { radius_m } = self.radius {
            check("radius_m", radius_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
        }
        self.sensor.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::frame::DepthFrame;

    fn size(params: FrameParams) -> (u32, u32) {
        let size = params.window.nominal();
        (size.half_width, size.stride)
    }

    #[test]
    fn windows_go_with_the_noise_of_the_sensor() {
        let of = |sensor| {
            [Strength::LIGHT, Strength::DEFAULT, Strength::STRONG]
                .map(|strength| size(FrameParams::for_sensor(sensor, strength)))
        };
        assert_eq!(of(SensorModel::KINECT_V1), [(2, 3), (2, 5), (3, 4)]);
        assert_eq!(of(SensorModel::REALSENSE_D435), [(2, 4), (2, 6), (3, 5)]);
        assert_eq!(of(SensorModel::AZURE_KINECT), [(2, 2), (2, 3), (3, 2)]);
        assert_eq!(of(SensorModel::REALSENSE_L515), [(2, 3), (2, 5), (3, 4)]);
    }

    #[test]
    fn strength_never_narrows_a_window_or_lessens_the_ridge() {
        for sensor in [SensorModel::KINECT_V1, SensorModel::REALSENSE_D435, SensorModel::EXACT] {
            let of = |percent: u32| FrameParams::for_sensor(sensor, Strength::new(percent as f32 / 100.0).unwrap());
            for percent in 0..100 {
                let (weaker, stronger) = (of(percent), of(percent + 1));
                let reach = |params: FrameParams| params.window.nominal().reach_px();
                assert!(reach(weaker) <= reach(stronger) && weaker.fit.ridge <= stronger.fit.ridge, "{percent} %");
                assert!(stronger.validate().is_ok());
            }
        }
    }

    #[test]
    fn depth_and_its_points_have_the_same_resolution() {
        for fx in [1000.0, 525.0, 262.5, 131.25] {
            let camera = Camera::new((40, 4), [fx; 2], [19.5, 1.5]);
            let depth = DepthFrame::new(camera, vec![1000; 160]).unwrap();
            let mut cloud = depth.deproject().unwrap();
            // As read from a file: the pitch must be estimated.
            cloud.camera = None;
            let params = FrameParams::default();
            assert_eq!(params.at_resolution_of(&depth), params.at_resolution_of(&cloud));
            let expected = params.window.at_pitch(1.0 / fx);
            assert_eq!(params.at_resolution_of(&depth).window, Window::Fixed(expected));
        }
    }

    #[test]
    fn a_frame_of_unknown_resolution_changes_nothing() {
        let params = FrameParams::default();
        let camera = Camera::new((40, 4), [100.0; 2], [19.5, 1.5]);
        let depth = DepthFrame::new(camera, vec![0; 160]).unwrap();
        let mut empty = depth.deproject().unwrap();
        empty.camera = None;
        assert_eq!(size(params.at_resolution_of(&empty)), size(params));
        assert_eq!(size(params.at_resolution_of(&depth)).1, 1, "depth has its camera");
        let short = DepthFrame { raw: vec![1000; 100], ..depth.clone() };
        let mut cut = depth.deproject().unwrap();
        cut.points.positions.resize(20, 0.0);
        let bad = DepthFrame { camera: Camera { fx: f64::NAN, ..camera }, ..depth };
        assert_eq!(size(params.at_resolution_of(&short)), size(params));
        assert_eq!(size(params.at_resolution_of(&cut)), size(params));
        assert_eq!(size(params.at_resolution_of(&bad)), size(params));
    }

    #[test]
    fn every_field_is_refused_outside_its_range_by_name_value_and_range() {
        let ok = FrameParams::default();
        let cases = [
            (ok.with_window(0), "window", "0", "1 to 7"),
            (ok.with_window(8), "window", "8", "1 to 7"),
            (ok.with_stride(0), "stride", "0", "1 to 8"),
            (ok.with_stride(9), "stride", "9", "1 to 8"),
            (ok.with_degree(0), "degree", "0", "1 to 3"),
            (ok.with_degree(4), "degree", "4", "1 to 3"),
            (ok.with_radius_m(-0.5), "radius_m", "-0.5", "1e-6 to 1000"),
            (ok.with_radius_m(f32::NAN), "radius_m", "NaN", "1e-6 to 1000"),
            (ok.with_radius_m(f32::INFINITY), "radius_m", "inf", "1e-6 to 1000"),
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
        assert!(FrameParams::paper().validate().is_ok());
    }
}
