//! A RealSense's intrinsics as a [`Camera`].
//!
//! Most depth images are rectified. Intel has a distortion model that applies tangential distortion after radial
//! distortion. It is replaced by OpenCV's model with five coefficients, fitted over the image, with an error of at most
//! a hundredth of a pixel for these cameras.
//!
//! The library reports the colour camera's distortion for depth that is aligned to that camera, but its `align` applies
//! the distortion only for the modified Brown-Conrady model (sse-align.cpp and neon-align.cpp). With other models, the
//! aligned image has no distortion.

use std::ffi::c_int;

use super::api::Intrinsics;
use planish_core::{Camera, DeviceError, Distortion};

// rs2_distortion
const NONE: c_int = 0;
const MODIFIED_BROWN_CONRADY: c_int = 1;
const INVERSE_BROWN_CONRADY: c_int = 2;
const BROWN_CONRADY: c_int = 4;

/// Number of positions along each side of the image at which distortion is fitted.
const SAMPLES: u32 = 25;

/// Maximum error of a distortion fit, in pixels.
const MOST_ERROR_PX: f64 = 0.1;

/// Returns the camera of a depth image, either as measured or, if `is_aligned`, as mapped onto the colour image by
/// the library's `align`.
pub(super) fn camera_of(
    intrinsics: &Intrinsics,
    metres_per_unit: f32,
    is_aligned: bool,
) -> Result<Camera, DeviceError> {
    let size = |value: c_int| usize::try_from(value).unwrap_or(0);
    let shape = (size(intrinsics.width), size(intrinsics.height));
    let focal = [intrinsics.fx, intrinsics.fy].map(f64::from);
    let centre = [intrinsics.ppx, intrinsics.ppy].map(f64::from);
    let coefficients = intrinsics.coefficients.map(f64::from);
    let distortion = match intrinsics.model {
        _ if coefficients == [0.0; 5] => Distortion::NONE,
        NONE => Distortion::NONE,
        model if is_aligned && model != MODIFIED_BROWN_CONRADY => Distortion::NONE,
        BROWN_CONRADY => Distortion::from_opencv(&coefficients).unwrap_or_default(),
        MODIFIED_BROWN_CONRADY | INVERSE_BROWN_CONRADY => fitted(intrinsics, coefficients)?,
        model => {
            let what = format!(
                "the camera has librealsense's distortion model {model} (fisheye); only pinhole cameras are supported"
            );
            return Err(DeviceError::Failed { what });
        }
    };
    let units = units_per_metre(metres_per_unit);
    Ok(Camera::new(shape, focal, centre).with_depth_units_per_metre(units).with_distortion(distortion))
}

/// Returns the depth units per metre, rounded if they are whole to within f32 precision. The library states metres
/// per unit as f32: its 0.001 is 1000 units per metre, not 999.99995.
fn units_per_metre(metres_per_unit: f32) -> f64 {
    let units = 1.0 / f64::from(metres_per_unit);
    let whole = units.round();
    if (units - whole).abs() <= f64::from(f32::EPSILON) * whole { whole } else { units }
}

fn fitted(intrinsics: &Intrinsics, coefficients: [f64; 5]) -> Result<Distortion, DeviceError> {
    let pairs = pairs_of(intrinsics, coefficients);
    let fit = Distortion::fit(&pairs).map(|(distortion, error)| (distortion, error * f64::from(intrinsics.fx)));
    match fit {
        Some((distortion, error_px)) if error_px <= MOST_ERROR_PX => Ok(distortion),
        _ => {
            let what = format!(
                "the camera's distortion, model {} with {coefficients:?}, cannot be converted to OpenCV's model to \
                 within {MOST_ERROR_PX} pixels",
                intrinsics.model
            );
            Err(DeviceError::Failed { what })
        }
    }
}

/// Returns directions over the whole image, each with the position at which the camera sees it, both in units of the
/// focal length.
fn pairs_of(intrinsics: &Intrinsics, coefficients: [f64; 5]) -> Vec<([f64; 2], [f64; 2])> {
    let at = |i: u32, length: c_int, centre: f32, focal: f32| {
        let pixel = f64::from(i) / f64::from(SAMPLES - 1) * f64::from(length - 1);
        (pixel - f64::from(centre)) / f64::from(focal)
    };
    // 10 % beyond the image, so that the samples cover it despite distortion.
    let direction = |i: u32| {
        let x = 1.1 * at(i % SAMPLES, intrinsics.width, intrinsics.ppx, intrinsics.fx);
        let y = 1.1 * at(i / SAMPLES, intrinsics.height, intrinsics.ppy, intrinsics.fy);
        ([x, y], distorted([x, y], coefficients))
    };
    (0..SAMPLES * SAMPLES).map(direction).collect()
}

/// Distorts a direction as rs2_project_point_to_pixel does for both models. Despite its name, the "inverse" model is
/// applied in the same direction.
fn distorted([x, y]: [f64; 2], [k1, k2, p1, p2, k3]: [f64; 5]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let q = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let [x, y] = [x * q, y * q];
    [x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Coefficients of a D455's colour camera, which has a wide lens.
    const COEFFICIENTS: [f32; 5] = [-0.0559, 0.0668, -0.00077, 0.00044, -0.0213];

    fn intrinsics(model: c_int, coefficients: [f32; 5]) -> Intrinsics {
        Intrinsics { width: 1280, height: 720, ppx: 646.3, ppy: 367.1, fx: 644.2, fy: 643.8, model, coefficients }
    }

    #[test]
    fn distortion_sends_directions_where_the_library_sees_them() {
        let given = intrinsics(BROWN_CONRADY, COEFFICIENTS);
        let camera = camera_of(&given, 0.001, false).unwrap();
        assert_eq!(camera.depth_units_per_metre, 1000.0);
        assert_eq!(camera.distortion.coefficients()[..5], COEFFICIENTS.map(f64::from));
        // rs2_project_point_to_pixel (2.59) of the direction (0.9, -0.5, 1) for models 1 and 2, in units of the focal
        // length.
        let (r2, [k1, k2, p1, p2, k3]) = (0.9f64 * 0.9 + 0.25, COEFFICIENTS.map(f64::from));
        let q = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2;
        let (x, y) = (0.9 * q, -0.5 * q);
        let seen = [x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)];
        for model in [MODIFIED_BROWN_CONRADY, INVERSE_BROWN_CONRADY] {
            let camera = camera_of(&intrinsics(model, COEFFICIENTS), 0.001, false).unwrap();
            let found = camera.distortion.undistort(seen).unwrap();
            let error_px = 644.0 * (found[0] - 0.9).hypot(found[1] + 0.5);
            assert!(error_px < 0.05, "{model}: {error_px}");
        }
    }

    #[test]
    fn depth_that_was_aligned_is_distorted_as_the_library_aligns() {
        for (model, is_distorted) in
            [(MODIFIED_BROWN_CONRADY, true), (INVERSE_BROWN_CONRADY, false), (BROWN_CONRADY, false)]
        {
            let camera = camera_of(&intrinsics(model, COEFFICIENTS), 0.001, true).unwrap();
            assert_eq!(!camera.distortion.is_none(), is_distorted);
        }
    }

    #[test]
    fn a_lens_that_is_no_pinhole_is_refused_and_rectified_images_have_no_distortion() {
        let fisheye = camera_of(&intrinsics(5, [0.1, 0.0, 0.0, 0.0, 0.0]), 0.001, false);
        assert!(fisheye.unwrap_err().to_string().contains("fisheye"));
        assert!(camera_of(&intrinsics(5, [0.0; 5]), 0.001, false).unwrap().distortion.is_none());
        // No lens has such coefficients: the image folds over itself.
        assert!(camera_of(&intrinsics(MODIFIED_BROWN_CONRADY, [-3.0, 2.0, 0.5, 0.5, -9.0]), 0.001, false).is_err());
        // An L515 counts quarters of a millimetre, a D405 tenths.
        assert_eq!(units_per_metre(0.000_25), 4000.0);
        assert_eq!(units_per_metre(0.0001), 10_000.0);
        assert!((units_per_metre(0.000_333) - 3003.003).abs() < 0.001);
    }
}
