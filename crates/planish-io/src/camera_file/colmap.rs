//! Reads COLMAP's `cameras.txt`.

use super::super::{FormatResult, quoted};
use super::malformed;
use planish_core::{Camera, Distortion, FormatError};

/// Reads the camera from a COLMAP camera list with lines `ID MODEL WIDTH HEIGHT PARAMETERS`; returns `None` for other
/// text. If there are several cameras, only those with the given shape are considered. In COLMAP, pixel centres are at
/// half-integer coordinates.
pub(super) fn from_colmap(text: &str, shape: Option<(usize, usize)>) -> Option<FormatResult<Camera>> {
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
            _ => Err(FormatError::Unsupported(
                "the file lists several cameras; keep only the one that took the frame".into(),
            )),
        }
    }))
}

/// Parses one camera line of COLMAP's `cameras.txt`.
pub fn colmap_camera(line: &str) -> FormatResult<Camera> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let parsed = |range: std::ops::RangeFrom<usize>| {
        words.get(range)?.iter().map(|word| word.parse::<f64>().ok()).collect::<Option<Vec<f64>>>()
    };
    let size = |at: usize| words.get(at)?.parse::<usize>().ok();
    let (Some(width), Some(height), Some(parameters)) = (size(2), size(3), parsed(4..)) else {
        return Err(malformed(format!("invalid line in COLMAP's cameras.txt: {}", quoted(line))));
    };
    let parameters = &parameters[..];
    let (focal_length, centre, distortion) = match (words[1], parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], vec![]),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], vec![]),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => ([f, f], [cx, cy], vec![k1, 0.0, 0.0, 0.0]),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], vec![k1, k2, 0.0, 0.0]),
        ("OPENCV" | "OPENCV_FISHEYE", &[fx, fy, cx, cy, ref d @ ..]) if d.len() == 4 => {
            ([fx, fy], [cx, cy], d.to_vec())
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, ref d @ ..]) if d.len() == 8 => ([fx, fy], [cx, cy], d.to_vec()),
        (model, _) => {
            return Err(FormatError::Unsupported(format!(
                "unsupported COLMAP camera model {} with {} parameters; expected SIMPLE_PINHOLE, PINHOLE, \
                 SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE or FULL_OPENCV",
                quoted(model),
                parameters.len()
            )));
        }
    };
    let camera = Camera::new((width, height), focal_length, centre.map(|c| c - 0.5));
    let model = if words[1] == "OPENCV_FISHEYE" { words[1] } else { "OPENCV" };
    Ok(camera.with_distortion(Distortion::of_model(model, &distortion)?))
}
