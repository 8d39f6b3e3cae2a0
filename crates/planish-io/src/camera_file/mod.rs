//! Reads camera files: JSON (planish's own, Open3D's, NeRF's, BOP's, Replica's), the YAML of a ROS camera_info,
//! OpenCV's YAML and XML, a matrix as text, COLMAP's `cameras.txt`, and ScanNet's text files. The format is detected
//! from the contents.

mod colmap;
mod matrix;
mod text;
mod value;

use std::path::Path;

use super::plain::text_in_utf_8;
use super::{FormatResult, ReadOptions};
pub use colmap::colmap_camera;
use colmap::from_colmap;
#[cfg(feature = "npz")]
pub(super) use matrix::{Intrinsics, intrinsics_of};
use planish_core::{Camera, FormatError, IoError};

const HELP: &str = "expected a camera file: JSON with fx, fy, cx, cy or a matrix (Open3D, NeRF, BOP and others), the YAML \
                    of a ROS camera_info, OpenCV's YAML or XML, a 3x3 or 4x4 matrix as text, or COLMAP's cameras.txt";

/// Maximum size of a camera file in bytes.
const MAX_BYTES: u64 = 16 << 20;

/// The contents of a camera file.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct CameraFile {
    /// The camera; its shape is 0x0 if neither the file nor the caller states one.
    pub camera: Camera,
    /// True if the file states the depth unit.
    pub states_units: bool,
    /// Notes for users on guesses and contradictions, one clause each.
    pub notes: Vec<String>,
}

/// Reads a camera file for frames of `shape` (width, height). A file that states another shape is an error.
///
/// If `shape` is `None`, the camera has the shape stated in the file, or 0x0.
pub fn read_camera(path: &Path, shape: Option<(usize, usize)>) -> Result<Camera, IoError> {
    read_camera_file(path, shape).map(|file| file.camera)
}

/// Same as [`read_camera`], but also returns notes, and whether the file states the depth unit.
pub fn read_camera_file(path: &Path, shape: Option<(usize, usize)>) -> Result<CameraFile, IoError> {
    read_text(path).and_then(|text| parse_camera_file(&text, shape)).map_err(IoError::at(path))
}

/// Reads the text of a camera file.
pub fn read_text(path: &Path) -> FormatResult<String> {
    let bytes = super::read_bytes(path, &ReadOptions::default().with_max_memory_bytes(MAX_BYTES));
    let bytes = bytes.map_err(|error| match error {
        FormatError::TooLarge { .. } => malformed("the file is too large for a camera file".into()),
        error => error,
    })?;
    let text = text_in_utf_8(&bytes);
    if text.contains(&0) {
        Err(malformed("the file is not text".into()))
    } else {
        Ok(super::text_of(&text).into_owned())
    }
}

/// Same as [`read_camera`], for the text of a camera file.
pub fn parse_camera(text: &str, shape: Option<(usize, usize)>) -> FormatResult<Camera> {
    parse_camera_file(text, shape).map(|file| file.camera)
}

/// Same as [`read_camera_file`], for the text of a camera file.
pub fn parse_camera_file(text: &str, shape: Option<(usize, usize)>) -> FormatResult<CameraFile> {
    let mut file = match from_colmap(text, shape) {
        Some(camera) => CameraFile { camera: camera?, states_units: false, notes: Vec::new() },
        None => value::camera_of(&text::parse(text)?)?,
    };
    let camera = &mut file.camera;
    match shape {
        Some(shape) if (camera.width, camera.height) != (0, 0) => camera.check_shape(shape)?,
        Some(shape) => *camera = camera.with_shape(shape),
        None => {}
    }
    // The shape may still be unknown, but the rest must describe a valid camera.
    let (width, height) = (camera.width.max(1), camera.height.max(1));
    camera.with_shape((width, height)).validate()?;
    Ok(file)
}

/// Returns the first unknown key of a camera file, such as a misspelt one; `None` if all keys are known.
///
/// # Errors
/// If the text cannot be parsed as JSON, YAML, XML or numbers.
pub fn unknown_camera_key(text: &str) -> FormatResult<Option<String>> {
    Ok(value::unknown_key(&text::parse(text)?))
}

/// Returns the camera as JSON that [`parse_camera`] can read.
pub fn camera_to_json(camera: &Camera) -> String {
    let Camera { width, height, fx, fy, cx, cy, depth_units_per_metre, distortion, .. } = camera;
    let mut json = serde_json::json!({
        "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_units_per_metre": depth_units_per_metre
    });
    if !distortion.is_none() {
        json["distortion"] = serde_json::json!(distortion.coefficients());
        json["distortion_model"] = serde_json::json!(distortion.model());
    }
    json.to_string()
}

fn malformed(what: String) -> FormatError {
    FormatError::Malformed(format!("{what}; {HELP}"))
}

#[cfg(test)]
mod tests {
    use planish_core::Distortion;

    use super::*;

    const SHAPE: Option<(usize, usize)> = Some((640, 480));

    #[test]
    fn every_format_describes_the_same_camera() {
        let files = [
            r#"{"width":640,"height":480,"intrinsic_matrix":[525.0,0,0,0,525.0,0,319.5,239.5,1]}"#,
            r#"{"fx":525,"fy":525,"cx":319.5,"cy":239.5,"depth_scale":1000}"#,
            r#"{"class_name":"PinholeCameraParameters","extrinsic":[1],"intrinsic":{"width":640,"height":480,"intrinsic_matrix":[525,0,0,0,525,0,319.5,239.5,1]}}"#,
            r#"{"K":[525,0,319.5,0,525,239.5,0,0,1],"coeffs":[0,0,0,0,0]}"#,
            r#"{"width":640,"height":480,"fx":525,"fy":525,"ppx":319.5,"ppy":239.5}"#,
            "525 0 319.5\n0 525 239.5\n0 0 1\n",
            "# Camera list\n# CAMERA_ID, MODEL, ...\n1 PINHOLE 640 480 525 525 320 240\n",
            "image_width: 640\nimage_height: 480\ncamera_name: depth\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
             data: [525.0, 0, 319.5, 0, 525.0, 239.5, 0, 0, 1]\ndistortion_model: plumb_bob\n\
             distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n",
            "header:\n  frame_id: camera\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\nd:\n- 0.0\n- 0.0\n- \
             0.0\n\
             - 0.0\n- 0.0\nk:\n- 525.0\n- 0.0\n- 319.5\n- 0.0\n- 525.0\n- 239.5\n- 0.0\n- 0.0\n- 1.0\nr: [1.0]\n---\n",
        ];
        for text in files {
            assert_eq!(parse_camera(text, SHAPE).unwrap(), Camera::kinect_v1(), "{text}");
        }
        assert_eq!(parse_camera(&camera_to_json(&Camera::kinect_v1()), None).unwrap(), Camera::kinect_v1());
    }

    #[test]
    fn distortion_is_read_from_json_colmap_and_camera_info() {
        let coefficients = [0.1, -0.2, 0.001, 0.002, 0.03, 0.0, 0.0, 0.0];
        let expected = Camera::kinect_v1().with_distortion(Distortion::from_opencv(&coefficients).unwrap());
        assert_eq!(parse_camera(&camera_to_json(&expected), SHAPE).unwrap(), expected);
        let colmap = "1 FULL_OPENCV 640 480 525 525 320 240 0.1 -0.2 0.001 0.002 0.03 0 0 0";
        assert_eq!(parse_camera(colmap, SHAPE).unwrap(), expected);
        let info = "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [525, 0, 319.5, 0, 525, 239.5, 0, 0, \
                    1]}\n\
                    distortion_model: plumb_bob\ndistortion_coefficients: {data: [0.1, -0.2, 0.001, 0.002, 0.03]}";
        assert_eq!(parse_camera(info, SHAPE).unwrap(), expected);
        let single = r#"{"fx":525,"fy":525,"cx":319.5,"cy":239.5,"k1":0.1,"k2":-0.2,"p1":0.001,"p2":0.002,"k3":0.03}"#;
        assert_eq!(parse_camera(single, SHAPE).unwrap(), expected);
        let fisheye = info.replace("plumb_bob", "ftheta");
        assert!(parse_camera(&fisheye, SHAPE).unwrap_err().to_string().contains("rectify"));
    }

    #[test]
    fn files_that_describe_no_camera_of_the_frame_are_refused() {
        let open3d = r#"{"width":640,"height":480,"intrinsic_matrix":[525.0,0,0,0,525.0,0,319.5,239.5,1]}"#;
        assert!(parse_camera(open3d, Some((320, 240))).unwrap_err().to_string().contains("640x480"));
        for text in ["", "{\"fx\":525}", "hello", "1 2 3", "525 1 319.5 0 525 239.5 0 0 1", "1 FISHEYE 640 480 1 2 3"] {
            assert!(parse_camera(text, SHAPE).is_err(), "{text}");
        }
        let two = "1 PINHOLE 640 480 525 525 320 240\n2 PINHOLE 640 480 500 500 320 240";
        assert!(parse_camera(two, SHAPE).unwrap_err().to_string().contains("several"));
        let other = "1 PINHOLE 640 480 525 525 320 240\n2 PINHOLE 320 240 250 250 160 120";
        assert_eq!(parse_camera(other, SHAPE).unwrap(), Camera::kinect_v1());
    }

    fn read(text: &str) -> CameraFile {
        parse_camera_file(text, None).unwrap_or_else(|error| panic!("{text}: {error}"))
    }

    #[test]
    fn files_of_other_programs_describe_the_same_camera() {
        let kinect = Camera::kinect_v1();
        let files = [
            // A row-major matrix where Open3D is column-major, and a column-major one where OpenCV is row-major.
            r#"{"width":640,"height":480,"intrinsic_matrix":[525.0,0,319.5,0,525.0,239.5,0,0,1]}"#,
            r#"{"K":[525,0,0,0,525,0,319.5,239.5,1]}"#,
            r#"{"K":[[525,0,319.5],[0,525,239.5],[0,0,1]]}"#,
            "[[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]]",
            // A 4x4 matrix, and a matrix with commas.
            "525 0 319.5 0\n0 525 239.5 0\n0 0 1 0\n0 0 0 1\n",
            "525,0,319.5\n0,525,239.5\n0,0,1\n",
            // NeRF, Replica, BOP.
            r#"{"fl_x":525,"fl_y":525,"cx":319.5,"cy":239.5,"w":640,"h":480,"frames":[]}"#,
            r#"{"camera":{"w":640,"h":480,"fx":525,"fy":525,"cx":319.5,"cy":239.5,"scale":1000}}"#,
            r#"{"0":{"cam_K":[525,0,319.5,0,525,239.5,0,0,1],"depth_scale":1.0},"1":{"cam_K":[525,0,319.5,0,525,239.5,0,0,1],"depth_scale":1.0}}"#,
            // OpenCV's YAML and XML, ScanNet, Kalibr.
            "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   \
             dt: d\n   data: [ 525., 0., 319.5, 0., 525., 239.5, 0., 0., 1. ]\n",
            "<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_width>640</image_width>\n<image_height>480</image_height>\n\
             <camera_matrix type_id=\"opencv-matrix\">\n  <rows>3</rows>\n  <cols>3</cols>\n  <dt>d</dt>\n  <data>\n    525. \
             0. 319.5 0. 525. 239.5 0. 0. 1.</data></camera_matrix>\n</opencv_storage>",
            "depthWidth = 640\ndepthHeight = 480\nfx_depth = 525\nfy_depth = 525\nmx_depth = 319.5\nmy_depth = 239.5\n",
            "cam0:\n  camera_model: pinhole\n  intrinsics: [525, 525, 319.5, 239.5]\n  distortion_model: radtan\n  \
             distortion_coeffs: [0, 0, 0, 0]\n  resolution: [640, 480]\n",
        ];
        let has_xml = cfg!(feature = "more-formats");
        for text in files.into_iter().filter(|text| has_xml || !text.starts_with('<')) {
            let camera = read(text).camera;
            assert_eq!(camera.with_shape((640, 480)), kinect, "{text}");
        }
    }

    #[test]
    fn the_unit_of_depth_beside_a_nested_camera_counts_and_scales_of_scenes_do_not() {
        const CAMERA: &str = r#""fx":525,"fy":525,"cx":319.5,"cy":239.5"#;
        for (text, units) in [
            (format!(r#"{{"depth_scale":5000,"intrinsic":{{{CAMERA}}}}}"#), 5000.0),
            (format!(r#"{{"depth_units_per_metre":5000,"camera":{{{CAMERA}}}}}"#), 5000.0),
            (format!(r#"{{{CAMERA},"png_depth_scale":6553.5}}"#), 6553.5),
            (format!(r#"{{{CAMERA},"integer_depth_scale":0.0002}}"#), 5000.0),
            (format!(r#"{{{CAMERA},"scale":0.33,"aabb_scale":4}}"#), 1000.0),
            (format!(r#"{{{CAMERA},"camera":{{"name":"D435"}},"model":"D435"}}"#), 1000.0),
            (
                "Camera.fx: 525\nCamera.fy: 525\nCamera.cx: 319.5\nCamera.cy: 239.5\nDepthMapFactor: 5000.0\n".into(),
                5000.0,
            ),
            ("525 525 319.5 239.5".into(), 1000.0),
        ] {
            let camera = read(&text).camera;
            assert_eq!((camera.fx, camera.cy, camera.depth_units_per_metre), (525.0, 239.5, units), "{text}");
        }
        for (more, problem) in [
            (r#""is_fisheye":true"#, "4 for a fisheye"),
            (r#""model":"distortion.inverse_brown_conrady","coeffs":[0.1,0,0,0,0]"#, "rectify"),
            (r#""distortion_model":"equidistant","D":[0,0,0,0,1]"#, "4 for a fisheye"),
            (r#""is_fisheye":"true","D":[0,0,0,0,1]"#, "4 for a fisheye"),
            (r#""camera_model":"omni","distortion_model":"radtan","dist":[0.1,0,0,0]"#, "omni"),
        ] {
            let error = parse_camera(&format!("{{{CAMERA},{more}}}"), None).unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
        let distorted = read(&format!(r#"{{{CAMERA},"dist":[0.1,0.01,0,0,0]}}"#)).camera;
        assert_eq!(distorted.distortion.coefficients()[0], 0.1);
        let hostile = format!("<{}", "a><".repeat(200_000));
        assert!(parse_camera(&hostile, None).is_err());
    }

    #[test]
    fn a_fisheye_is_read_from_the_files_of_other_programs_and_from_ours() {
        let files = [
            "%YAML:1.0\nfisheye_model: 1\ncamera_matrix: {data: [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]}\n\
             distortion_coefficients: {rows: 4, cols: 1, data: [0.1, 0.02, 0, -0.01]}\n",
            r#"{"fl_x":525,"fl_y":525,"cx":319.5,"cy":239.5,"k1":0.1,"k2":0.02,"k4":-0.01,"camera_model":"OPENCV_FISHEYE"}"#,
            r#"{"fl_x":525,"fl_y":525,"cx":319.5,"cy":239.5,"k1":0.1,"k2":0.02,"k4":-0.01,"is_fisheye":true}"#,
            "width: 640\nheight: 480\nk: [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]\ndistortion_model: equidistant\n\
             d: [0.1, 0.02, 0, -0.01]\n",
            "cam0:\n  camera_model: pinhole\n  intrinsics: [525, 525, 319.5, 239.5]\n  distortion_model: equidistant\n  \
             distortion_coeffs: [0.1, 0.02, 0, -0.01]\n  resolution: [640, 480]\n",
            "1 OPENCV_FISHEYE 640 480 525 525 320 240 0.1 0.02 0 -0.01\n",
            "Camera.type: \"KannalaBrandt8\"\nCamera.fx: 525\nCamera.fy: 525\nCamera.cx: 319.5\nCamera.cy: 239.5\n\
             Camera.k1: 0.1\nCamera.k2: 0.02\nCamera.k3: 0\nCamera.k4: -0.01\n",
            "<opencv_storage><fisheye_model>1</fisheye_model><camera_matrix type_id=\"opencv-matrix\"><data>525 0 319.5 0 525 \
             239.5 0 0 1</data></camera_matrix><distortion_coefficients type_id=\"opencv-matrix\"><data>0.1 0.02 0 -0.01\
             </data></distortion_coefficients></opencv_storage>",
            "<opencv_storage><distortion_model>equidistant</distortion_model><camera_matrix type_id=\"opencv-matrix\"><data>525 \
             0 319.5 0 525 239.5 0 0 1</data></camera_matrix><distortion_coefficients type_id=\"opencv-matrix\"><data>0.1 0.02 0 \
             -0.01</data></distortion_coefficients></opencv_storage>",
        ];
        let has_xml = cfg!(feature = "more-formats");
        for text in files.into_iter().filter(|text| has_xml || !text.starts_with('<')) {
            let camera = read(text).camera;
            assert_eq!(camera.distortion, Distortion::Equidistant([0.1, 0.02, 0.0, -0.01]), "{text}");
            assert_eq!(parse_camera(&camera_to_json(&camera), SHAPE).unwrap(), camera.with_shape((640, 480)));
        }
    }

    #[test]
    fn the_scale_of_depth_is_read_in_either_direction_and_said() {
        let with = |scale: &str| format!(r#"{{"fx":525,"fy":525,"cx":319.5,"cy":239.5,"depth_scale":{scale}}}"#);
        for (scale, units, notes) in [
            ("1000", 1000.0, 0),
            ("0.001", 1000.0, 1),
            ("0.00025", 4000.0, 1),
            ("0.1", 10_000.0, 1),
            ("1.0", 1000.0, 1),
        ] {
            let file = read(&with(scale));
            assert_eq!((file.camera.depth_units_per_metre, file.notes.len()), (units, notes), "{scale}");
        }
        for scale in ["50", "0.007", "0", "-1", "1e-9"] {
            let error = parse_camera(&with(scale), None).unwrap_err().to_string();
            assert!(error.contains("not the unit of any depth camera"), "{scale}: {error}");
        }
    }

    #[test]
    fn regions_binning_and_contradictions_of_a_camera_info_count() {
        let info = |rest: &str| {
            format!("width: 640\nheight: 480\nk: [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]\nd: [0, 0, 0, 0, 0]\n{rest}")
        };
        let region = read(&info("roi: {x_offset: 100, y_offset: 40, width: 320, height: 240}\n")).camera;
        assert_eq!((region.width, region.height, region.cx, region.cy), (320, 240, 219.5, 199.5));
        let binned = read(&info("binning_x: 2\nbinning_y: 2\n")).camera;
        assert_eq!((binned.width, binned.fx, binned.cx), (320, 262.5, 159.5));
        assert_eq!(read(&info("roi: {x_offset: 0, y_offset: 0, width: 0, height: 0}\n")).camera, Camera::kinect_v1());
        let projection = read(&info("p: [500, 0, 310, 0, 0, 500, 239.5, 0, 0, 0, 1, 0]\n"));
        assert!(projection.notes[0].contains("fx is 525 or 500"), "{:?}", projection.notes);
        assert_eq!(projection.camera.fx, 525.0);
        let uncalibrated = info("p: [500, 0, 310, 0, 0, 500, 239.5, 0, 0, 0, 1, 0]\n")
            .replace("525, 0, 319.5, 0, 525, 239.5, 0, 0, 1", "0, 0, 0, 0, 0, 0, 0, 0, 0");
        assert_eq!(read(&uncalibrated).camera.fx, 500.0);
        for (text, problem) in [
            ("K: [525, 3, 319.5, 0, 525, 239.5, 0, 0, 1]", "not a matrix"),
            ("fx: wide\nfy: 1\ncx: 1\ncy: 1", "not a number"),
            ("width: 640\nfx: 525\nfy: 525\ncx: 319.5\ncy: 239.5", "only one of width and height"),
            ("width: 6.5\nheight: 4\nfx: 525\nfy: 525\ncx: 319.5\ncy: 239.5", "not a number of pixels"),
        ] {
            let error = parse_camera(text, None).unwrap_err().to_string();
            assert!(error.contains(problem), "{text}: {error}");
        }
    }
}
