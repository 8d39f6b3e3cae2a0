//! COLMAP: its `rig_config.json`, or a text model with one image per camera.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use super::{CalibrationOptions, as_name, camera_at, malformed};
use crate::rig::{RigCamera, file::MAX_BYTES};
use planish_core::{Camera, FormatError, SensorPose, internal::RigidTransform};
use planish_io::{self as io, ReadOptions};

/// Returns the cameras of a `rig_config.json`, which must contain one rig. Its poses are cam_from_rig; the frame of
/// the reference sensor is the rig's.
pub(super) fn rig_config(text: &str, options: &CalibrationOptions) -> Result<Vec<RigCamera>, FormatError> {
    #[derive(Deserialize)]
    struct RigEntry {
        cameras: Vec<CameraEntry>,
    }
    #[derive(Deserialize)]
    struct CameraEntry {
        image_prefix: String,
        #[serde(default)]
        ref_sensor: bool,
        cam_from_rig_rotation: Option<[f64; 4]>,
        cam_from_rig_translation: Option<[f64; 3]>,
        camera_model_name: Option<String>,
        #[serde(default)]
        camera_params: Vec<f64>,
    }
    let rigs: Vec<RigEntry> =
        serde_json::from_str(text).map_err(|error| malformed(format!("not a COLMAP rig_config.json: {error}")))?;
    let [rig] = &rigs[..] else {
        return Err(malformed(format!("found {} rigs; a rig_config.json must contain exactly one", rigs.len())));
    };
    let camera = |entry: &CameraEntry| {
        let prefix = entry.image_prefix.trim_end_matches('/');
        let problem = |what: String| malformed(format!("camera {prefix:?}: {what}"));
        let camera_from_rig = match (entry.cam_from_rig_rotation, entry.cam_from_rig_translation) {
            (Some(orientation), Some(position_m)) => SensorPose { position_m, orientation },
            (None, None) if entry.ref_sensor => SensorPose::IDENTITY,
            _ => return Err(problem("cam_from_rig_rotation or cam_from_rig_translation is missing; add both".into())),
        };
        let name = prefix.rsplit('/').next().unwrap_or(prefix);
        let placed = place(name, &camera_from_rig, options).map_err(|error| problem(error.to_string()))?;
        let intrinsics = entry.camera_model_name.as_ref().map(|model| {
            let parameters: Vec<String> = entry.camera_params.iter().map(f64::to_string).collect();
            // The file does not state the image size.
            planish_io::internal::colmap_camera(&format!("1 {model} 0 0 {}", parameters.join(" ")))
                .map_err(|error| problem(error.to_string()))
        });
        Ok(placed.with_camera(intrinsics.transpose()?))
    };
    rig.cameras.iter().map(camera).collect()
}

/// Returns the cameras of a text model: `cameras.txt`, and `images.txt` with one image per camera of the rig.
pub(super) fn model(folder: &Path, options: &CalibrationOptions) -> Result<Vec<RigCamera>, FormatError> {
    let read = |name: &str| {
        let path = folder.join(name);
        if !path.is_file() {
            let convert = "colmap model_converter --input_path MODEL --output_path MODEL --output_type TXT";
            return Err(malformed(format!("no {name} in the folder; convert a binary model with `{convert}`")));
        }
        let bytes = io::read_bytes(&path, &ReadOptions::default().with_max_memory_bytes(MAX_BYTES))?;
        String::from_utf8(bytes).map_err(|_| malformed(format!("{name} is not text")))
    };
    of_lists(&read("cameras.txt")?, &read("images.txt")?, options)
}

fn of_lists(cameras: &str, images: &str, options: &CalibrationOptions) -> Result<Vec<RigCamera>, FormatError> {
    let lines = |text: &'_ str| -> Vec<String> {
        text.lines().map(str::trim).filter(|line| !line.starts_with('#')).map(str::to_owned).collect()
    };
    let mut intrinsics: BTreeMap<String, Camera> = BTreeMap::new();
    for line in lines(cameras).iter().filter(|line| !line.is_empty()) {
        let id = line.split_whitespace().next().unwrap_or_default();
        intrinsics.insert(id.to_owned(), planish_io::internal::colmap_camera(line)?);
    }
    let mut found: Vec<RigCamera> = Vec::new();
    // Every second line lists the points of the image on the previous line, and may be empty.
    for line in lines(images).iter().step_by(2).filter(|line| !line.is_empty()) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let numbers: Option<Vec<f64>> = words.iter().skip(1).take(7).map(|word| word.parse().ok()).collect();
        let (Some(&[w, x, y, z, tx, ty, tz]), [_, _, _, _, _, _, _, _, id, name @ ..]) =
            (numbers.as_deref(), &words[..])
        else {
            return Err(malformed(format!(
                "invalid line in COLMAP's images.txt: {}",
                planish_io::internal::quoted(line)
            )));
        };
        let name = name.join(" ");
        let problem = |what: &str| malformed(format!("image {name:?}: {what}"));
        let camera_from_world = SensorPose { position_m: [tx, ty, tz], orientation: [w, x, y, z] };
        let intrinsics = intrinsics.get(*id).ok_or_else(|| problem("its camera is not in cameras.txt"))?;
        // The camera is named after the image's folder or, without one, after the image.
        let of_camera = name.rsplit_once('/').map_or_else(
            || name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem),
            |(folder, _)| folder.rsplit('/').next().unwrap_or(folder),
        );
        let placed = place(of_camera, &camera_from_world, options).map_err(|error| problem(&error.to_string()))?;
        if found.iter().any(|camera| camera.name == placed.name) {
            return Err(problem(
                "its camera has a second image; keep one image per camera in images.txt, all of the same moment",
            ));
        }
        found.push(placed.with_camera(Some(*intrinsics)));
    }
    Ok(found)
}

/// Returns a camera at the inverse of camera_from_rig, in metres.
fn place(name: &str, camera_from_rig: &SensorPose, options: &CalibrationOptions) -> Result<RigCamera, FormatError> {
    if camera_from_rig.orientation == [0.0; 4] {
        return Err(malformed("its rotation is 0, 0, 0, 0, which is invalid"));
    }
    let camera_from_rig = camera_from_rig.transform()?;
    let translation = camera_from_rig.translation * options.metres_per_unit;
    Ok(camera_at(&as_name(name), &RigidTransform { translation, ..camera_from_rig }.inverse()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERAS: &str =
        "# Camera list\n1 PINHOLE 640 480 525 525 320 240\n2 OPENCV 320 240 260 260 160 120 0.1 0 0 0\n";
    const IMAGES: &str = "# Image list\n1 1 0 0 0 0 0 0 1 left/000.png\n\n2 0.7071067811865476 0 0.7071067811865476 0 \
                          0 0 2 2 right/000.png\n1 2 3\n";

    #[test]
    fn a_model_s_images_are_the_cameras() {
        let cameras = of_lists(CAMERAS, IMAGES, &CalibrationOptions::default().with_metres_per_unit(0.5)).unwrap();
        assert_eq!(cameras.iter().map(|camera| camera.name.as_str()).collect::<Vec<_>>(), ["left", "right"]);
        // Seen from the second camera, the first is 2 units ahead; the x axis of the second is the z axis of the
        // first.
        let [x, y, z] = cameras[1].pose.position_m;
        assert!((x - 1.0).abs() < 1e-9 && y.abs() < 1e-9 && z.abs() < 1e-9, "{:?}", cameras[1].pose);
        assert_eq!(cameras[1].camera.map(|camera| (camera.width, camera.cx)), Some((320, 159.5)));
        let twice = IMAGES.replace("right/000", "left/001");
        assert!(
            of_lists(CAMERAS, &twice, &CalibrationOptions::default()).unwrap_err().to_string().contains("second image")
        );
        let unknown = IMAGES.replace(" 2 right", " 7 right");
        assert!(
            of_lists(CAMERAS, &unknown, &CalibrationOptions::default())
                .unwrap_err()
                .to_string()
                .contains("cameras.txt")
        );
    }

    #[test]
    fn a_rig_config_has_its_cameras_relative_to_the_reference() {
        let text = r#"[{"cameras":[
          {"image_prefix":"rig1/front/","ref_sensor":true,"camera_model_name":"PINHOLE","camera_params":[525,525,320,240]},
          {"image_prefix":"rig1/back/","cam_from_rig_rotation":[0,0,1,0],"cam_from_rig_translation":[0,0,-0.2]}]}]"#;
        let cameras = rig_config(text, &CalibrationOptions::default()).unwrap();
        assert_eq!(cameras[0].name, "front");
        assert_eq!(cameras[0].camera.map(|camera| (camera.width, camera.fx, camera.cx)), Some((0, 525.0, 319.5)));
        assert!((cameras[1].pose.position_m[2] + 0.2).abs() < 1e-12, "{:?}", cameras[1].pose);
        let without = text.replace("cam_from_rig_rotation", "rotation");
        assert!(rig_config(&without, &CalibrationOptions::default()).unwrap_err().to_string().contains("back"));
    }
}
