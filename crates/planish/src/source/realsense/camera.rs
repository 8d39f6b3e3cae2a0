//! A RealSense's intrinsics as a [`Camera`].
//!
//! Its depth images are rectified, but those aligned to the colour camera have that one's distortion, which Intel gives by models of
//! its own. Those that are not OpenCV's are replaced by OpenCV's with five coefficients, fitted over the image: to a hundredth of a
//! pixel for the lenses of these cameras.

use std::ffi::c_int;

use super::api::Intrinsics;
use crate::camera::{Camera, Distortion};
use crate::error::DeviceError;

// rs2_distortion
const NONE: c_int = 0;
const MODIFIED_BROWN_CONRADY: c_int = 1;
const INVERSE_BROWN_CONRADY: c_int = 2;
const BROWN_CONRADY: c_int = 4;

/// Positions along each side at which distortion is fitted.
const SAMPLES: u32 = 25;

/// The largest error of a fit, in pixels.
const MOST_ERROR_PX: f64 = 0.1;

/// Returns the camera of a stream whose depth is in units of so many metres.
pub(super) fn camera_of(intrinsics: &Intrinsics, metres_per_unit: f32) -> Result<Camera, DeviceError> {
    let size = |value: c_int| usize::try_from(value).unwrap_or(0);
    let shape = (size(intrinsics.width), size(intrinsics.height));
    let focal = [intrinsics.fx, intrinsics.fy].map(f64::from);
    let centre = [intrinsics.ppx, intrinsics.ppy].map(f64::from);
    let coefficients = intrinsics.coefficients.map(f64::from);
    let distortion = match intrinsics.model {
        _ if coefficients == [0.0; 5] => Distortion::NONE,
        NONE => Distortion::NONE,
        BROWN_CONRADY => Distortion::from_opencv(&coefficients).unwrap_or_default(),
        MODIFIED_BROWN_CONRADY | INVERSE_BROWN_CONRADY => fitted(intrinsics, coefficients)?,
        model => {
            let what = format!(
                "the camera's lens has distortion model {model} of librealsense, a fisheye's: pinhole cameras are smoothed"
            );
            return Err(DeviceError::Failed { what });
        }
    };
    let units = units_per_metre(metres_per_unit);
    Ok(Camera::new(shape, focal, centre).with_depth_units_per_metre(units).with_distortion(distortion))
}

/// The library gives metres per unit as f32: 0.001 there is 1000 units a metre, not 999.99995.
fn units_per_metre(metres_per_unit: f32) -> f64 {
    let units = 1.0 / f64::from(metres_per_unit);
    let whole = units.round();
    if (units - whole).abs() <= 1e-6 * whole { whole } else { units }
}

fn fitted(intrinsics: &Intrinsics, coefficients: [f64; 5]) -> Result<Distortion, DeviceError> {
    let pairs = pairs_of(intrinsics, coefficients);
    let fit = Distortion::fit(&pairs).map(|(distortion, error)| (distortion, error * f64::from(intrinsics.fx)));
    match fit {
        Some((distortion, error_px)) if error_px <= MOST_ERROR_PX => Ok(distortion),
        _ => {
            let what = format!(
                "the camera's distortion, model {} with {coefficients:?}, has no equivalent in OpenCV's to {MOST_ERROR_PX} pixels",
                intrinsics.model
            );
            Err(DeviceError::Failed { what })
        }
    }
}

/// Returns directions with the positions at which they are seen, over the image: both in units of the focal length.
fn pairs_of(intrinsics: &Intrinsics, coefficients: [f64; 5]) -> Vec<([f64; 2], [f64; 2])> {
    let at = |i: u32, length: c_int, centre: f32, focal: f32| {
        let pixel = f64::from(i) / f64::from(SAMPLES - 1) * f64::from(length - 1);
        (pixel - f64::from(centre)) / f64::from(focal)
    };
    let pixel = |i: u32| {
        let x = at(i % SAMPLES, intrinsics.width, intrinsics.ppx, intrinsics.fx);
        let y = at(i / SAMPLES, intrinsics.height, intrinsics.ppy, intrinsics.fy);
        match intrinsics.model {
            // The formula takes distortion out.
            INVERSE_BROWN_CONRADY => (inverse_brown_conrady([x, y], coefficients), [x, y]),
            // It puts distortion in: directions somewhat beyond the image cover it.
            _ => {
                let direction = [1.1 * x, 1.1 * y];
                (direction, modified_brown_conrady(direction, coefficients))
            }
        }
    };
    (0..SAMPLES * SAMPLES).map(pixel).collect()
}

/// rs2_deproject_pixel_to_point.
fn inverse_brown_conrady([x, y]: [f64; 2], [k1, k2, p1, p2, k3]: [f64; 5]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let q = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    [x * q + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * q + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)]
}

/// rs2_project_point_to_pixel: tangential distortion of what is radially distorted already.
fn modified_brown_conrady([x, y]: [f64; 2], [k1, k2, p1, p2, k3]: [f64; 5]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let q = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let [x, y] = [x * q, y * q];
    [x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn intrinsics(model: c_int, coefficients: [f32; 5]) -> Intrinsics {
        Intrinsics { width: 1280, height: 720, ppx: 646.3, ppy: 367.1, fx: 911.2, fy: 910.8, model, coefficients }
    }

    #[test]
    fn distortion_of_each_model_sends_pixels_where_the_library_does() {
        // Of a D455's colour camera, which has a wide lens.
        let coefficients = [-0.0559, 0.0668, -0.00077, 0.00044, -0.0213];
        for model in [MODIFIED_BROWN_CONRADY, INVERSE_BROWN_CONRADY, BROWN_CONRADY] {
            let given = intrinsics(model, coefficients);
            let camera = camera_of(&given, 0.001).unwrap();
            assert_eq!(camera.depth_units_per_metre, 1000.0);
            if model == BROWN_CONRADY {
                assert_eq!(camera.distortion.to_opencv()[..5], coefficients.map(f64::from));
                continue;
            }
            for (direction, seen) in pairs_of(&given, coefficients.map(f64::from)) {
                let found = camera.distortion.undistort(seen).unwrap();
                let error_px = 911.0 * (found[0] - direction[0]).hypot(found[1] - direction[1]);
                assert!(error_px < 0.05, "{model}: {error_px} at {seen:?}");
            }
        }
    }

    #[test]
    fn a_lens_that_is_no_pinhole_is_refused_and_rectified_images_have_no_distortion() {
        assert!(
            camera_of(&intrinsics(5, [0.1, 0.0, 0.0, 0.0, 0.0]), 0.001).unwrap_err().to_string().contains("fisheye")
        );
        assert!(camera_of(&intrinsics(5, [0.0; 5]), 0.001).unwrap().distortion.is_none());
        // No polynomial of five terms inverts this one.
        assert!(camera_of(&intrinsics(INVERSE_BROWN_CONRADY, [-3.0, 2.0, 0.0, 0.0, -9.0]), 0.001).is_err());
        // An L515 counts quarters of a millimetre, a D405 tenths.
        assert_eq!(units_per_metre(0.000_25), 4000.0);
        assert_eq!(units_per_metre(0.0001), 10_000.0);
        assert!((units_per_metre(0.000_333) - 3003.003).abs() < 0.001);
    }
}
