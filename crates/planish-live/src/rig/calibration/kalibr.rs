//! Kalibr's `camchain.yaml`: cameras in a chain, each calibrated relative to the previous one.

use serde::Deserialize;

use super::{camera_at, malformed};
use crate::rig::{RigCamera, file::pose_of_matrix};
use planish_core::{Camera, Distortion, FormatError, internal::RigidTransform};
use planish_io::internal::parse_yaml;

#[derive(Deserialize)]
struct Entry {
    camera_model: Option<String>,
    intrinsics: Vec<f64>,
    distortion_model: Option<String>,
    #[serde(default)]
    distortion_coeffs: Vec<f64>,
    resolution: Option<[usize; 2]>,
    /// Offset added to the camera's timestamps to get the IMU's time, in seconds.
    timeshift_cam_imu: Option<f64>,
    /// Transform from the previous camera's frame to this camera's frame.
    #[serde(rename = "T_cn_cnm1")]
    from_previous: Option<Vec<[f64; 4]>>,
}

/// Returns true if a text is a camchain.
pub(super) fn is_camchain(text: &str) -> bool {
    text.lines().any(|line| line.trim_end() == "cam0:")
}

/// Returns the cameras of a chain; the first one's frame is the rig's.
pub(super) fn camchain(text: &str) -> Result<Vec<RigCamera>, FormatError> {
    let file: serde_yaml_ng::Mapping =
        parse_yaml(text).map_err(|error| malformed(format!("not a Kalibr camchain: {error}")))?;
    let mut cameras = Vec::new();
    let mut rig_from_camera = RigidTransform::IDENTITY;
    loop {
        let name = format!("cam{}", cameras.len());
        let Some(entry) = file.get(name.as_str()) else { break };
        let problem = |what: String| malformed(format!("{name}: {what}"));
        let entry: Entry = serde_yaml_ng::from_value(entry.clone()).map_err(|error| problem(error.to_string()))?;
        let intrinsics = intrinsics(&entry).map_err(problem)?;
        match &entry.from_previous {
            Some(rows) => {
                let from_previous = pose_of_matrix(rows).map_err(problem)?;
                let from_previous = from_previous.transform().map_err(|error| problem(error.to_string()))?;
                rig_from_camera = rig_from_camera.after(from_previous.inverse());
            }
            None if cameras.is_empty() => {}
            None => return Err(problem("T_cn_cnm1 is missing; calibrate this camera with the previous one".into())),
        }
        let camera = camera_at(&name, &rig_from_camera).with_camera(Some(intrinsics));
        // The rig's and Kalibr's offsets are both added to timestamps. Kalibr's offset converts them to the IMU's
        // clock.
        cameras.push(camera.with_time_offset_s(entry.timeshift_cam_imu.unwrap_or(0.0)));
    }
    let is_camera = |key: &&str| key.strip_prefix("cam").is_some_and(|number| number.parse::<usize>().is_ok());
    let named = file.keys().filter_map(|key| key.as_str()).filter(is_camera).count();
    if named > cameras.len() {
        return Err(malformed(format!(
            "the chain has {named} cameras but no cam{}; number the cameras without gaps",
            cameras.len()
        )));
    }
    Ok(cameras)
}

fn intrinsics(entry: &Entry) -> Result<Camera, String> {
    let Entry { camera_model, distortion_model, distortion_coeffs, resolution, .. } = entry;
    let (model, distortion) =
        (camera_model.as_deref().unwrap_or("pinhole"), distortion_model.as_deref().unwrap_or("none"));
    let (&[fx, fy, cx, cy], "pinhole") = (&entry.intrinsics[..], model) else {
        return Err(format!(
            "unsupported camera model {model:?} with {} intrinsics; only pinhole with 4 is supported",
            entry.intrinsics.len()
        ));
    };
    let distortion = Distortion::of_model(distortion, distortion_coeffs).map_err(|error| error.to_string())?;
    let [width, height] = resolution.unwrap_or([0, 0]);
    let camera = Camera::new((width, height), [fx, fy], [cx, cy]).with_distortion(distortion);
    camera.with_shape((width.max(1), height.max(1))).validate().map_err(|error| error.to_string())?;
    Ok(camera)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHAIN: &str = "cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [461.6, 460.3, 363.0, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [457.6, 456.1, 379.0, 255.2]
  resolution: [752, 480]
cam2:
  T_cn_cnm1:
  - [0.0, 0.0, -1.0, 0.0]
  - [0.0, 1.0, 0.0, 0.0]
  - [1.0, 0.0, 0.0, -0.2]
  - [0.0, 0.0, 0.0, 1.0]
  intrinsics: [457.6, 456.1, 379.0, 255.2]
";

    #[test]
    fn time_shifts_are_taken_and_a_gap_in_the_chain_is_refused() {
        let shifted = CHAIN.replacen("cam1:\n", "cam1:\n  timeshift_cam_imu: 0.0125\n", 1);
        let offsets: Vec<f64> = camchain(&shifted).unwrap().iter().map(|camera| camera.time_offset_s).collect();
        assert_eq!(offsets, [0.0, 0.0125, 0.0]);
        let error = camchain(&CHAIN.replace("cam1:", "cam3:")).unwrap_err().to_string();
        assert!(error.contains("no cam1"), "{error}");
    }

    #[test]
    fn each_camera_stands_where_the_chain_leads() {
        assert!(is_camchain(CHAIN));
        let cameras = camchain(CHAIN).unwrap();
        let places: Vec<[f64; 3]> = cameras.iter().map(|camera| camera.pose.position_m).collect();
        // The second camera is 11 cm to the right of the first. The third is 20 cm to the right of the second, and
        // turned to the right.
        let expected = [[0.0, 0.0, 0.0], [0.11, 0.0, 0.0], [0.31, 0.0, 0.0]];
        let off = |i: usize, k: usize| (places[i][k] - expected[i][k]).abs();
        assert!((0..3).all(|i| (0..3).all(|k| off(i, k) < 1e-12)), "{places:?}");
        assert!((cameras[2].pose.rotation()[0][2] - 1.0).abs() < 1e-12, "its z is the first camera's x");
        let first = cameras[0].camera.unwrap();
        assert_eq!((first.width, first.fx, first.distortion.is_none()), (752, 461.6, false));
        assert_eq!(cameras[2].camera.unwrap().width, 0);
    }

    #[test]
    fn models_that_are_not_understood_name_the_camera() {
        for (from, to, said) in [
            ("distortion_model: radtan", "distortion_model: fov", "rectify"),
            ("camera_model: pinhole", "camera_model: omni", "pinhole"),
            ("intrinsics: [461.6, 460.3, 363.0, 248.1]", "intrinsics: [461.6]", "1 intrinsics"),
            ("intrinsics: [461.6, 460.3, 363.0, 248.1]", "intrinsics: [-461.6, 460.3, 363.0, 248.1]", "fx"),
        ] {
            let error = camchain(&CHAIN.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains("cam0") && error.contains(said), "{error}");
        }
        let unlinked = CHAIN.replace("T_cn_cnm1", "T_cam_imu");
        assert!(camchain(&unlinked).unwrap_err().to_string().contains("cam1: T_cn_cnm1 is missing"));
    }
}
