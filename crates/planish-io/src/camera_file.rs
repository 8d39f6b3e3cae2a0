//! Camera files: JSON (planish's own and Open3D's), ROS `camera_info` YAML, the 3x3 matrix of 7-Scenes as text, and
//! COLMAP's `cameras.txt`. Detected from their contents.

use std::path::Path;

use serde::Deserialize;

use super::plain::text_in_utf_8;
use super::{FormatResult, ReadOptions};
use planish_core::{Camera, Distortion, FormatError, IoError};

const HELP: &str = "expected a camera file: JSON with fx, fy, cx, cy or Open3D's intrinsic_matrix, the YAML of a ROS \
                    camera_info, a \
                    3x3 matrix as text, or COLMAP's cameras.txt";

/// The largest camera file accepted, in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Reads a camera file for frames of `shape` (width, height); a file of another shape is refused.
///
/// With `None`, the camera has the shape stated in the file, or 0x0.
pub fn read_camera(path: &Path, shape: Option<(usize, usize)>) -> Result<Camera, IoError> {
    read_text(path).and_then(|text| parse_camera(&text, shape)).map_err(IoError::at(path))
}

/// Returns the text of a camera file.
pub fn read_text(path: &Path) -> FormatResult<String> {
    let bytes = super::read_bytes(path, &ReadOptions::default().with_max_memory_bytes(MAX_BYTES));
    let bytes = bytes.map_err(|error| match error {
        FormatError::TooLarge { .. } => malformed("larger than any camera file".into()),
        error => error,
    })?;
    let text = text_in_utf_8(&bytes);
    if text.contains(&0) { Err(malformed("not text".into())) } else { Ok(super::text_of(&text).into_owned()) }
}

/// [`read_camera`] of a file's text.
pub fn parse_camera(text: &str, shape: Option<(usize, usize)>) -> FormatResult<Camera> {
    let camera = match text.trim_start().chars().next() {
        Some('{') => from_json(text)?,
        _ => match (from_matrix(text), from_colmap(text, shape)) {
            (Some(camera), _) => camera,
            (None, Some(camera)) => camera?,
            (None, None) => from_camera_info(text)?,
        },
    };
    let states_shape = (camera.width, camera.height) != (0, 0);
    let camera = match shape {
        Some(shape) if states_shape => {
            camera.check_shape(shape)?;
            camera
        }
        Some(shape) => camera.with_shape(shape),
        None => camera,
    };
    // Whatever the shape turns out to be, the rest must describe a camera.
    let (width, height) = (camera.width.max(1), camera.height.max(1));
    camera.with_shape((width, height)).validate()?;
    Ok(camera)
}

/// Returns true if a JSON camera file states the units of depth.
pub fn states_depth_scale(text: &str) -> bool {
    serde_json::from_str::<serde_json::Map<String, serde_json::Value>>(text)
        .is_ok_and(|file| ["depth_scale", "depth_units_per_metre"].iter().any(|key| file.contains_key(*key)))
}

/// Returns the camera as JSON, as [`parse_camera`] reads it.
pub fn camera_to_json(camera: &Camera) -> String {
    let Camera { width, height, fx, fy, cx, cy, depth_units_per_metre, distortion, .. } = camera;
    let mut json = serde_json::json!({
        "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_units_per_metre": depth_units_per_metre
    });
    if !distortion.is_none() {
        json["distortion"] = serde_json::json!(distortion.to_opencv());
    }
    json.to_string()
}

fn malformed(what: String) -> FormatError {
    FormatError::Malformed(format!("{what}; {HELP}"))
}

fn distortion_of(coefficients: &[f64]) -> FormatResult<Distortion> {
    Distortion::from_opencv(coefficients).ok_or_else(|| {
        malformed(format!(
            "{} distortion coefficients; 4 (k1 k2 p1 p2), 5 (and k3) or 8 (and k4 k5 k6) are supported",
            coefficients.len()
        ))
    })
}

/// Returns the size of the images; 0 by 0 where none is stated.
fn shape_of(width: Option<usize>, height: Option<usize>) -> FormatResult<(usize, usize)> {
    match (width, height) {
        (Some(width), Some(height)) => Ok((width, height)),
        (None, None) => Ok((0, 0)),
        _ => Err(FormatError::Malformed("the camera has only one of width and height; give both or neither".into())),
    }
}

/// A camera file in JSON: planish's own layout, or Open3D's with its matrix in column-major order.
#[derive(Deserialize)]
struct JsonCamera {
    width: Option<usize>,
    height: Option<usize>,
    intrinsic_matrix: Option<[f64; 9]>,
    fx: Option<f64>,
    fy: Option<f64>,
    #[serde(alias = "ppx")]
    cx: Option<f64>,
    #[serde(alias = "ppy")]
    cy: Option<f64>,
    #[serde(alias = "depth_units_per_metre")]
    depth_scale: Option<f64>,
    #[serde(
        default,
        alias = "distortion_coefficients",
        alias = "dist_coeffs",
        alias = "coeffs",
        alias = "D",
        alias = "d"
    )]
    distortion: Vec<f64>,
    /// Row by row, as in OpenCV and ROS.
    #[serde(rename = "K", alias = "k", alias = "camera_matrix")]
    matrix: Option<[f64; 9]>,
    k1: Option<f64>,
    k2: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    /// What else it says.
    #[serde(flatten)]
    others: serde_json::Map<String, serde_json::Value>,
}

impl JsonCamera {
    fn parse(text: &str) -> FormatResult<Self> {
        let error = |error: serde_json::Error| malformed(format!("not a camera file: {error}"));
        let mut value: serde_json::Value = serde_json::from_str(text).map_err(error)?;
        // Open3D's PinholeCameraParameters nest them one level deeper.
        if let Some(intrinsic) = value.get_mut("intrinsic").map(serde_json::Value::take) {
            value = intrinsic;
        }
        serde_json::from_value(value).map_err(error)
    }
}

/// Returns a key in a JSON camera that no camera has, such as a misspelt one.
///
/// # Errors
/// If the text is not a camera in JSON.
pub fn unknown_camera_key(text: &str) -> FormatResult<Option<String>> {
    Ok(JsonCamera::parse(text)?.others.keys().next().cloned())
}

fn from_json(text: &str) -> FormatResult<Camera> {
    let file = JsonCamera::parse(text)?;
    let (focal_length, centre) = match (file.intrinsic_matrix, file.matrix, file.fx, file.fy, file.cx, file.cy) {
        (Some(m), ..) => ([m[0], m[4]], [m[6], m[7]]),
        (None, Some(m), ..) => ([m[0], m[4]], [m[2], m[5]]),
        (None, None, Some(fx), Some(fy), Some(cx), Some(cy)) => ([fx, fy], [cx, cy]),
        _ => return Err(malformed("the camera file lacks intrinsics: fx, fy, cx and cy, or a matrix".into())),
    };
    let single = [file.k1, file.k2, file.p1, file.p2, file.k3, file.k4, file.k5, file.k6];
    let coefficients = match single.iter().any(Option::is_some) {
        true => single.map(Option::unwrap_or_default).to_vec(),
        false => file.distortion,
    };
    let shape = shape_of(file.width, file.height)?;
    Ok(Camera::new(shape, focal_length, centre)
        .with_depth_units_per_metre(file.depth_scale.unwrap_or(1000.0))
        .with_distortion(distortion_of(&coefficients)?))
}

/// Returns a 3x3 matrix: nine numbers and nothing else.
fn from_matrix(text: &str) -> Option<Camera> {
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
    let [fx, skew, cx, zero_a, fy, cy, zero_b, zero_c, one]: [f64; 9] = numbers?.try_into().ok()?;
    ([skew, zero_a, zero_b, zero_c, one] == [0.0, 0.0, 0.0, 0.0, 1.0]).then(|| Camera::new((0, 0), [fx, fy], [cx, cy]))
}

/// COLMAP's list of cameras: `ID MODEL WIDTH HEIGHT PARAMETERS`. Its pixel centres are at half coordinates.
fn from_colmap(text: &str, shape: Option<(usize, usize)>) -> Option<FormatResult<Camera>> {
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    let is_colmap = |line: &str| {
        let mut words = line.split_whitespace();
        let is_model = |word: &str| word.chars().all(|c| c.is_ascii_uppercase() || c == '_') && word.len() > 2;
        words.next().is_some_and(|id| id.parse::<u32>().is_ok()) && words.next().is_some_and(is_model)
    };
    let cameras: Vec<&str> = lines.filter(|line| is_colmap(line)).collect();
    if cameras.is_empty() {
        return None;
    }
    let cameras: FormatResult<Vec<Camera>> = cameras.into_iter().map(colmap_camera).collect();
    Some(cameras.and_then(|mut cameras| {
        if cameras.len() > 1 {
            cameras.retain(|camera| shape.is_none_or(|shape| (camera.width, camera.height) == shape));
            cameras.dedup();
        }
        match cameras[..] {
            [camera] => Ok(camera),
            _ => {
                Err(FormatError::Unsupported("it lists several cameras; keep only the one that took the frame".into()))
            }
        }
    }))
}

/// Returns the camera of a line of COLMAP's `cameras.txt`.
pub fn colmap_camera(line: &str) -> FormatResult<Camera> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let parsed = |range: std::ops::RangeFrom<usize>| {
        words.get(range)?.iter().map(|word| word.parse::<f64>().ok()).collect::<Option<Vec<f64>>>()
    };
    let size = |at: usize| words.get(at)?.parse::<usize>().ok();
    let (Some(width), Some(height), Some(parameters)) = (size(2), size(3), parsed(4..)) else {
        return Err(malformed(format!("not a line of COLMAP's cameras.txt: {}", super::quoted(line))));
    };
    let parameters = &parameters[..];
    let (focal_length, centre, distortion) = match (words[1], parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], vec![]),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], vec![]),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => ([f, f], [cx, cy], vec![k1, 0.0, 0.0, 0.0]),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], vec![k1, k2, 0.0, 0.0]),
        ("OPENCV", &[fx, fy, cx, cy, ref d @ ..]) if d.len() == 4 => ([fx, fy], [cx, cy], d.to_vec()),
        ("FULL_OPENCV", &[fx, fy, cx, cy, ref d @ ..]) if d.len() == 8 => ([fx, fy], [cx, cy], d.to_vec()),
        (model, _) => {
            return Err(FormatError::Unsupported(format!(
                "COLMAP's camera model {} with {} parameters: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV \
                 and FULL_OPENCV are supported",
                super::quoted(model),
                parameters.len()
            )));
        }
    };
    let camera = Camera::new((width, height), focal_length, centre.map(|c| c - 0.5));
    Ok(camera.with_distortion(distortion_of(&distortion)?))
}

/// Parses the YAML of a ROS camera_info, from a calibration file or from `topic echo`.
fn from_camera_info(text: &str) -> FormatResult<Camera> {
    #[derive(Deserialize)]
    struct Matrix {
        data: Vec<f64>,
    }
    #[derive(Deserialize)]
    struct File {
        #[serde(alias = "width")]
        image_width: Option<usize>,
        #[serde(alias = "height")]
        image_height: Option<usize>,
        camera_matrix: Option<Matrix>,
        distortion_coefficients: Option<Matrix>,
        distortion_model: Option<String>,
        #[serde(alias = "K")]
        k: Option<Vec<f64>>,
        #[serde(alias = "D")]
        d: Option<Vec<f64>>,
    }
    // `topic echo` ends a message with the mark of a new document.
    let first = text.trim_start().trim_start_matches("---").split("\n---").next().unwrap_or_default();
    let file: File =
        serde_yaml_ng::from_str(first).map_err(|error| malformed(format!("not a camera file: {error}")))?;
    let matrix = file.camera_matrix.map(|matrix| matrix.data).or(file.k);
    let Some(&[fx, _, cx, _, fy, cy, ..]) = matrix.as_deref() else {
        return Err(malformed("the camera file lacks intrinsics".into()));
    };
    let coefficients = file.distortion_coefficients.map(|matrix| matrix.data).or(file.d).unwrap_or_default();
    let is_known = |model: &str| matches!(model, "plumb_bob" | "rational_polynomial" | "none" | "");
    let distorts = coefficients.iter().any(|c| *c != 0.0);
    match file.distortion_model.as_deref() {
        Some(model) if !is_known(model) => {
            return Err(FormatError::Unsupported(format!(
                "the distortion model {}: only plumb_bob and rational_polynomial are supported; rectify the images \
                 first",
                super::quoted(model)
            )));
        }
        _ => {}
    }
    let distortion = if distorts { distortion_of(&coefficients)? } else { Distortion::NONE };
    let shape = shape_of(file.image_width, file.image_height)?;
    Ok(Camera::new(shape, [fx, fy], [cx, cy]).with_distortion(distortion))
}

#[cfg(test)]
mod tests {
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
        let fisheye = info.replace("plumb_bob", "equidistant");
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
}
