//! The camera: intrinsics, lens distortion, and deprojection.
//!
//! Axes: x right, y down, z forward, in metres. Pixel (u, v) has its centre at integer coordinates. Deprojection
//! (docs/method.md, section 1): z = raw * metres_per_unit, X = z * ray_x, Y = z * ray_y. Without distortion the rays
//! are (u - cx)/fx and (v - cy)/fy. They are computed in f64 and rounded once to f32, so that one multiplication per
//! coordinate gives the same bits in every engine.

mod distortion;
mod rays;

use crate::error::{FrameError, ParamError};
use crate::xyz::validate_shape;

pub use distortion::Distortion;
pub(crate) use distortion::solve;
pub use rays::Rays;
pub(crate) use rays::{RowRays, RowRaysY};

/// The largest raw depth value, which sensors use for saturated pixels. It is a hole, like 0.
pub const SATURATED_DEPTH: u16 = u16::MAX;

/// Intrinsics of a depth camera, its lens distortion, and the unit of its depth values.
///
/// ```
/// use planish::Camera;
///
/// let camera = Camera::new((640, 480), [525.0, 525.0], [319.5, 239.5]).with_depth_units_per_metre(5000.0);
/// assert!(camera.validate().is_ok());
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Camera {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Focal length in pixels along x.
    pub fx: f64,
    /// Focal length in pixels along y.
    pub fy: f64,
    /// The x coordinate of the principal point in pixels.
    pub cx: f64,
    /// The y coordinate of the principal point in pixels.
    pub cy: f64,
    /// Number of depth units per metre: 1000 for millimetres, 5000 for TUM and ICL-NUIM data sets.
    pub depth_units_per_metre: f64,
    /// Lens distortion; [`Distortion::NONE`] for rectified images.
    pub distortion: Distortion,
}

impl Camera {
    /// Creates a pinhole camera from `(width, height)`, `[fx, fy]` and `[cx, cy]` in pixels, with depth in
    /// millimetres.
    pub const fn new(shape: (usize, usize), [fx, fy]: [f64; 2], [cx, cy]: [f64; 2]) -> Self {
        let (width, height) = shape;
        Self { width, height, fx, fy, cx, cy, depth_units_per_metre: 1000.0, distortion: Distortion::NONE }
    }

    /// Returns a Kinect v1 registered to its colour camera, the default of ROS and TUM: 640x480, f = 525, millimetres.
    pub const fn kinect_v1() -> Self {
        Self::new((640, 480), [525.0, 525.0], [319.5, 239.5])
    }

    /// Sets the number of depth units per metre.
    pub const fn with_depth_units_per_metre(self, depth_units_per_metre: f64) -> Self {
        Self { depth_units_per_metre, ..self }
    }

    /// Sets the lens distortion.
    pub const fn with_distortion(self, distortion: Distortion) -> Self {
        Self { distortion, ..self }
    }

    /// Sets the image size in pixels, and keeps focal lengths and principal point.
    pub const fn with_shape(self, (width, height): (usize, usize)) -> Self {
        Self { width, height, ..self }
    }

    /// Refuses invalid intrinsics, including those that could turn a depth value into a non-finite f32 point.
    pub fn validate(&self) -> Result<(), FrameError> {
        validate_shape(self.width, self.height)?;
        let within = |field, value: f64, range: std::ops::RangeInclusive<f64>, allowed| {
            // False for a NaN.
            if range.contains(&value) {
                Ok(())
            } else {
                Err(FrameError::BadCamera(ParamError { field, value: value.to_string(), allowed }))
            }
        };
        let focal_length = "0.001 to 1e12 pixels (if y points up in the data set, use the absolute value)";
        within("fx", self.fx, 1e-3..=1e12, focal_length)?;
        within("fy", self.fy, 1e-3..=1e12, focal_length)?;
        within("depth_units_per_metre", self.depth_units_per_metre, 1e-6..=1e12, "1e-6 to 1e12, 1000 for millimetres")?;
        within("cx", self.cx, -1e9..=1e9, "a principal point in pixels, -1e9 to 1e9")?;
        within("cy", self.cy, -1e9..=1e9, "a principal point in pixels, -1e9 to 1e9")?;
        self.distortion.validate()
    }

    /// Estimates the share of pixels, 0 to 1, that are holes because the lens model maps no ray to them: the image
    /// folds over itself, or the ray is more than 86 degrees from the axis. Samples 1024 pixels.
    pub fn lost_to_lens(&self) -> f32 {
        const COLUMNS: usize = 32;
        let Self { width, height, fx, fy, cx, cy, distortion, .. } = *self;
        if distortion.is_none() {
            return 0.0;
        }
        let place = |i: usize, size: usize| (i as f64 + 0.5) / COLUMNS as f64 * size as f64 - 0.5;
        let seen = |i: usize| [(place(i % COLUMNS, width) - cx) / fx, (place(i / COLUMNS, height) - cy) / fy];
        let lost = (0..COLUMNS * COLUMNS).filter(|&i| distortion.undistort(seen(i)).is_none()).count();
        lost as f32 / (COLUMNS * COLUMNS) as f32
    }

    /// Refuses a frame whose width or height differs from the camera's.
    pub fn check_shape(&self, (frame_width, frame_height): (usize, usize)) -> Result<(), FrameError> {
        let Self { width, height, .. } = *self;
        if (width, height) == (frame_width, frame_height) {
            return Ok(());
        }
        Err(FrameError::CameraShapeMismatch { frame_width, frame_height, width, height })
    }

    /// Returns the number of metres per raw depth unit, the factor that every engine uses.
    pub fn metres_per_unit(&self) -> f32 {
        (1.0 / self.depth_units_per_metre) as f32
    }

    /// Fits a camera to organized points that are in the camera's frame. `None` if the sample has fewer than 100
    /// points, or if they do not fit a camera without distortion.
    pub(crate) fn of_points((width, height): (usize, usize), points: &crate::xyz::Xyz) -> Option<Self> {
        /// Maximum number of sampled pixels.
        const SAMPLE: usize = 4096;
        /// Minimum number of points in the sample.
        const LEAST: usize = 100;
        /// Maximum RMS distance in pixels between the projected points and the centres of their pixels, separately
        /// along x and y.
        const MOST_OFF_PX: f64 = 0.1;
        let step = (width * height).div_ceil(SAMPLE).max(1);
        // Avoids a sample of a single column.
        let step = step + usize::from(step.is_multiple_of(width));
        let sample = || (0..width * height).step_by(step);
        let sample = || sample().filter(|&i| points.is_finite(i) && points.get(i)[2] > 0.0);
        let line = |axis: usize, pixel: &dyn Fn(usize) -> usize| -> Option<[f64; 2]> {
            let pairs =
                || sample().map(|i| (f64::from(points.get(i)[axis]) / f64::from(points.get(i)[2]), pixel(i) as f64));
            let count = pairs().count();
            let mean = |value: &dyn Fn((f64, f64)) -> f64| pairs().map(value).sum::<f64>() / count as f64;
            let (x, u) = (mean(&|pair| pair.0), mean(&|pair| pair.1));
            let focal = mean(&|pair| (pair.0 - x) * (pair.1 - u)) / mean(&|pair| (pair.0 - x).powi(2));
            let centre = u - focal * x;
            let off = mean(&|pair| (focal * pair.0 + centre - pair.1).powi(2)).sqrt();
            (count >= LEAST && focal > 0.0 && off <= MOST_OFF_PX).then_some([focal, centre])
        };
        let [fx, cx] = line(0, &|i| i % width)?;
        let [fy, cy] = line(1, &|i| i / width)?;
        Some(Self::new((width, height), [fx, fy], [cx, cy])).filter(|camera| camera.validate().is_ok())
    }

    /// Returns the camera of an image that was cropped to (columns, rows) pixels at `offset_px`, and then binned so
    /// that each block of `block_px` pixels became one pixel.
    pub fn of_region(self, offset_px: [usize; 2], (columns, rows): (usize, usize), block_px: [usize; 2]) -> Self {
        // Pixel centres are at integer coordinates, and the centre of a block is the mean of its pixels' centres.
        let centre = |c: f64, offset: usize, block: usize| (c - offset as f64 + 0.5) / block as f64 - 0.5;
        let [block_x, block_y] = block_px;
        Self {
            fx: self.fx / block_x as f64,
            fy: self.fy / block_y as f64,
            cx: centre(self.cx, offset_px[0], block_x),
            cy: centre(self.cy, offset_px[1], block_y),
            ..self.with_shape((columns / block_x, rows / block_y))
        }
    }

    /// Converts a raw depth value to metres; NaN for a hole (0 or saturated).
    pub fn depth_m(&self, raw: u16) -> f32 {
        depth_m(raw, self.metres_per_unit())
    }

    /// Returns the raw value nearest to a depth in metres; 0 (a hole) if it is not finite or not representable.
    pub fn raw_depth(&self, depth_m: f32) -> u16 {
        // The cast rounds down, hence the added 0.5.
        let raw = f64::from(depth_m) * self.depth_units_per_metre + 0.5;
        if raw >= 1.0 && raw < f64::from(SATURATED_DEPTH) { raw as u16 } else { 0 }
    }

    /// Projects the direction (x/z, y/z) to image coordinates (u, v).
    #[inline(always)]
    pub(crate) fn project_ray(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        if self.distortion.is_none() {
            return [self.fx as f32 * x + self.cx as f32, self.fy as f32 * y + self.cy as f32];
        }
        let [x, y] = self.distortion.distort(f64::from(x), f64::from(y));
        [(self.fx * x + self.cx) as f32, (self.fy * y + self.cy) as f32]
    }

    /// Projects a point in the camera's frame to image coordinates (u, v); `None` if the point is behind the camera.
    pub fn project(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        // False for a NaN.
        (z > 0.0).then(|| {
            let [x, y] = if self.distortion.is_none() { [x / z, y / z] } else { self.distortion.distort(x / z, y / z) };
            [self.fx * x + self.cx, self.fy * y + self.cy]
        })
    }

    /// Returns the index of the pixel that sees a point in the camera's frame; `None` if the point is outside the
    /// image.
    pub fn pixel_of(&self, point: [f64; 3]) -> Option<usize> {
        let [u, v] = self.project(point)?.map(f64::round);
        let is_inside = u >= 0.0 && v >= 0.0 && u < self.width as f64 && v < self.height as f64;
        is_inside.then(|| v as usize * self.width + u as usize)
    }

    /// Deprojects depth in metres, row by row, into x, y and z. Values that are not finite or not positive become NaN
    /// in all three.
    #[doc(hidden)]
    pub fn deproject_m(&self, depth_m: impl Iterator<Item = f32>) -> crate::xyz::Xyz {
        let mut rays = Rays::default();
        rays.set(self);
        let point = |(i, z): (usize, f32)| {
            let z = if z > 0.0 && z.is_finite() { z } else { f32::NAN };
            let [ray_x, ray_y] = rays.at(i % self.width, (i / self.width) % self.height);
            [ray_x * z, ray_y * z, z]
        };
        depth_m.enumerate().map(point).collect()
    }
}

/// Converts a raw depth value to metres; NaN for a hole.
#[inline(always)]
pub(crate) fn depth_m(raw: u16, metres_per_unit: f32) -> f32 {
    if raw == 0 || raw == SATURATED_DEPTH { f32::NAN } else { f32::from(raw) * metres_per_unit }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_survives_conversion_to_metres_and_back() {
        let camera = Camera::kinect_v1().with_depth_units_per_metre(5000.0);
        for raw in 1..SATURATED_DEPTH {
            assert_eq!(camera.raw_depth(camera.depth_m(raw)), raw);
        }
        assert!(camera.depth_m(0).is_nan() && camera.depth_m(SATURATED_DEPTH).is_nan());
        assert_eq!(camera.raw_depth(f32::NAN), 0);
        assert_eq!(camera.raw_depth(20.0), 0);
    }

    #[test]
    fn points_are_seen_at_the_pixels_that_they_came_from() {
        let plain = Camera::kinect_v1();
        let distorted = plain.with_distortion(Distortion::from_opencv(&[0.1, -0.2, 0.001, 0.002, 0.03]).unwrap());
        for camera in [plain, distorted] {
            let points = camera.deproject_m((0..640 * 480).map(|i| 0.5 + 1e-6 * i as f32));
            for i in [0, 639, 640 * 240 + 320, 640 * 479 + 17] {
                let [u, v] = camera.project(points.get(i).map(f64::from)).unwrap();
                assert!((u - (i % 640) as f64).abs() < 1e-3 && (v - (i / 640) as f64).abs() < 1e-3, "{u} {v}");
            }
            assert_eq!(camera.project([0.0, 0.0, -1.0]), None);
            assert_eq!(camera.project([f64::NAN; 3]), None);
        }
    }

    #[test]
    fn impossible_intrinsics_are_refused_by_name() {
        let camera = Camera { fy: -480.0, ..Camera::kinect_v1() };
        assert!(camera.validate().unwrap_err().to_string().contains("fy"));
        for mistaken in [1e-40, f64::NAN, f64::INFINITY] {
            assert!(Camera { fx: mistaken, ..Camera::kinect_v1() }.validate().is_err());
            assert!(Camera::kinect_v1().with_depth_units_per_metre(mistaken).validate().is_err());
        }
        // The widest camera that is allowed still gives finite points.
        let widest = Camera { fx: 1e-3, cx: -1e9, depth_units_per_metre: 1e-6, ..Camera::kinect_v1() };
        assert!(widest.validate().is_ok());
        let points = widest.deproject_m(std::iter::repeat_n(widest.depth_m(65534), 640));
        assert!(points.is_finite(639));
    }
}
