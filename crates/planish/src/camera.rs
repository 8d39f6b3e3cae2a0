//! The pinhole camera: intrinsics, deprojection, and the files that describe them.
//!
//! Axes: x right, y down, z forward, in metres. Pixel (u, v) has its centre at integer coordinates.
//! Deprojection (docs/method.md, section 1): z = raw * metres_per_unit, X = z (u - cx)/fx, Y = z (v - cy)/fy.
//! The factors (u - cx)/fx are computed in f64 and rounded once to f32, so that every engine gets the same bits from one
//! multiplication each.

use serde::Deserialize;

use crate::error::{FormatError, FrameError, ParamError};

/// The largest raw depth value; sensors use it for "saturated". It is a hole, as 0 is.
pub const SATURATED_DEPTH: u16 = u16::MAX;

/// Intrinsics of a depth camera without lens distortion, and the unit of its depth values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Focal length in pixels along x.
    pub fx: f64,
    /// Focal length in pixels along y.
    pub fy: f64,
    /// Principal point in pixels, x.
    pub cx: f64,
    /// Principal point in pixels, y.
    pub cy: f64,
    /// Depth units in a metre: 1000 for millimetres, 5000 for TUM and ICL-NUIM data sets.
    pub depth_units_per_metre: f64,
}

impl Camera {
    /// A Kinect v1 registered to its colour camera, as the ROS and TUM default has it: 640x480, f = 525, millimetres.
    pub fn kinect_v1() -> Self {
        Self { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5, depth_units_per_metre: 1000.0 }
    }

    /// Refuses intrinsics that describe no camera, among them all with which a depth value would become a point that is not
    /// finite in f32.
    pub fn validate(&self) -> Result<(), FrameError> {
        crate::cloud::validate_shape(self.width, self.height)?;
        let within = |field, value: f64, range: std::ops::RangeInclusive<f64>, allowed| {
            // False for a NaN.
            if range.contains(&value) {
                Ok(())
            } else {
                Err(FrameError::BadCamera(ParamError { field, value: value.to_string(), allowed }))
            }
        };
        let focal_length = "0.001 to 1e12 pixels (for y pointing up in a data set, give its absolute value)";
        within("fx", self.fx, 1e-3..=1e12, focal_length)?;
        within("fy", self.fy, 1e-3..=1e12, focal_length)?;
        within("depth_units_per_metre", self.depth_units_per_metre, 1e-6..=1e12, "1e-6 to 1e12, 1000 for millimetres")?;
        within("cx", self.cx, -1e9..=1e9, "a principal point in pixels, -1e9 to 1e9")?;
        within("cy", self.cy, -1e9..=1e9, "a principal point in pixels, -1e9 to 1e9")?;
        Ok(())
    }

    /// Metres in one raw depth unit, as every engine multiplies by it.
    pub fn metres_per_unit(&self) -> f32 {
        (1.0 / self.depth_units_per_metre) as f32
    }

    /// (u - cx)/fx for every column, in f32: X = z * `ray_x[u]`.
    pub fn rays_x(&self) -> Vec<f32> {
        (0..self.width).map(|u| ((u as f64 - self.cx) / self.fx) as f32).collect()
    }

    /// (v - cy)/fy for every row, in f32: Y = z * `ray_y[v]`.
    pub fn rays_y(&self) -> Vec<f32> {
        (0..self.height).map(|v| ((v as f64 - self.cy) / self.fy) as f32).collect()
    }

    /// A raw depth value in metres; NaN for a hole (0 or saturated).
    pub fn depth_m(&self, raw: u16) -> f32 {
        if raw == 0 || raw == SATURATED_DEPTH { f32::NAN } else { f32::from(raw) * self.metres_per_unit() }
    }

    /// The raw value nearest to a depth in metres; 0 (a hole) where it is not finite or not representable.
    pub fn raw_depth(&self, depth_m: f32) -> u16 {
        let raw = (f64::from(depth_m) * self.depth_units_per_metre).round();
        if raw >= 1.0 && raw < f64::from(SATURATED_DEPTH) { raw as u16 } else { 0 }
    }

    /// The camera as JSON, as [`Camera::from_json`] reads it.
    pub fn to_json(&self) -> String {
        let Self { width, height, fx, fy, cx, cy, depth_units_per_metre } = self;
        serde_json::json!({
            "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": depth_units_per_metre
        })
        .to_string()
    }

    /// The same as [`Camera::from_json`] before any frame is known: width and height are 0 where the file does not say them.
    pub fn from_json_of_any_shape(text: &str) -> Result<Self, FormatError> {
        #[derive(Deserialize)]
        struct Shape {
            width: Option<usize>,
            height: Option<usize>,
        }
        let shape: Shape = serde_json::from_str(text)
            .map_err(|error| FormatError::Malformed(format!("not a camera file: {error}; {CAMERA_FILE_HELP}")))?;
        match (shape.width, shape.height) {
            (Some(width), Some(height)) => Self::from_json(text, (width, height)),
            (width, height) => {
                let camera = Self::from_json(text, (width.unwrap_or(1), height.unwrap_or(1)))?;
                Ok(Self { width: 0, height: 0, ..camera })
            }
        }
    }

    /// Reads a camera from JSON: Open3D's layout (`width`, `height`, `intrinsic_matrix` in column-major order) or a flat
    /// object with `fx`, `fy`, `cx`, `cy` and optionally `width`, `height`, `depth_scale` (units per metre).
    ///
    /// `shape` gives width and height where the file has none; a file that contradicts it is refused.
    pub fn from_json(text: &str, shape: (usize, usize)) -> Result<Self, FormatError> {
        let file: CameraFile = serde_json::from_str(text)
            .map_err(|error| FormatError::Malformed(format!("not a camera file: {error}; {CAMERA_FILE_HELP}")))?;
        let (fx, fy, cx, cy) = match (file.intrinsic_matrix, file.fx, file.fy, file.cx, file.cy) {
            (Some(m), ..) => (m[0], m[4], m[6], m[7]),
            (None, Some(fx), Some(fy), Some(cx), Some(cy)) => (fx, fy, cx, cy),
            _ => {
                return Err(FormatError::Malformed(format!("the camera file lacks intrinsics; {CAMERA_FILE_HELP}")));
            }
        };
        let (width, height) = (file.width.unwrap_or(shape.0), file.height.unwrap_or(shape.1));
        if (width, height) != shape {
            return Err(FormatError::Malformed(format!(
                "the camera is {width}x{height}, the frame {}x{}: give the camera of this frame",
                shape.0, shape.1
            )));
        }
        let camera = Self { width, height, fx, fy, cx, cy, depth_units_per_metre: file.depth_scale.unwrap_or(1000.0) };
        camera.validate()?;
        Ok(camera)
    }
}

/// The factors of deprojection, kept while the camera stays the same.
#[derive(Default)]
pub(crate) struct Rays {
    camera: Option<Camera>,
    pub(crate) x: Vec<f32>,
    pub(crate) y: Vec<f32>,
}

impl Rays {
    pub(crate) fn set(&mut self, camera: &Camera) {
        if self.camera.as_ref() != Some(camera) {
            *self = Self { camera: Some(*camera), x: camera.rays_x(), y: camera.rays_y() };
        }
    }
}

const CAMERA_FILE_HELP: &str =
    "it holds {\"fx\":..,\"fy\":..,\"cx\":..,\"cy\":..} or Open3D's \"intrinsic_matrix\" of 9 numbers";

#[derive(Deserialize)]
struct CameraFile {
    width: Option<usize>,
    height: Option<usize>,
    intrinsic_matrix: Option<[f64; 9]>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    #[serde(alias = "depth_units_per_metre")]
    depth_scale: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn open3d_and_flat_files_describe_the_same_camera() {
        let open3d = r#"{"width":640,"height":480,"intrinsic_matrix":[525.0,0,0,0,525.0,0,319.5,239.5,1]}"#;
        let flat = r#"{"fx":525,"fy":525,"cx":319.5,"cy":239.5,"depth_scale":1000}"#;
        let shape = (640, 480);
        assert_eq!(Camera::from_json(open3d, shape).unwrap(), Camera::kinect_v1());
        assert_eq!(Camera::from_json(flat, shape).unwrap(), Camera::kinect_v1());
        assert!(Camera::from_json(open3d, (320, 240)).is_err());
        assert!(Camera::from_json("{\"fx\":525}", shape).is_err());
    }

    #[test]
    fn depth_survives_the_way_to_metres_and_back() {
        let camera = Camera { depth_units_per_metre: 5000.0, ..Camera::kinect_v1() };
        for raw in 1..SATURATED_DEPTH {
            assert_eq!(camera.raw_depth(camera.depth_m(raw)), raw);
        }
        assert!(camera.depth_m(0).is_nan() && camera.depth_m(SATURATED_DEPTH).is_nan());
        assert_eq!(camera.raw_depth(f32::NAN), 0);
        assert_eq!(camera.raw_depth(20.0), 0);
    }

    #[test]
    fn impossible_intrinsics_are_refused_by_name() {
        let camera = Camera { fy: -480.0, ..Camera::kinect_v1() };
        assert!(camera.validate().unwrap_err().to_string().contains("fy"));
        for mistaken in [1e-40, f64::NAN, f64::INFINITY] {
            assert!(Camera { fx: mistaken, ..Camera::kinect_v1() }.validate().is_err());
            assert!(Camera { depth_units_per_metre: mistaken, ..Camera::kinect_v1() }.validate().is_err());
        }
        // The widest camera that is allowed still gives finite points.
        let widest = Camera { fx: 1e-3, cx: -1e9, depth_units_per_metre: 1e-6, ..Camera::kinect_v1() };
        assert!(widest.validate().is_ok());
        assert!((widest.rays_x()[639] * widest.depth_m(65534)).is_finite());
    }
}
