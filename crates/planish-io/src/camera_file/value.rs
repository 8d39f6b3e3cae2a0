//! Extracts the camera from the parsed contents of a file, using the names that various programs give to its
//! parameters.

use serde_json::{Map, Value};

use super::super::{FormatResult, quoted};
use super::matrix::{Intrinsics, intrinsics_of};
use super::{CameraFile, malformed};
use planish_core::{Camera, Distortion, FormatError};

const WIDTH: &[&str] = &["width", "image_width", "w", "depthWidth", "Camera.width"];
const HEIGHT: &[&str] = &["height", "image_height", "h", "depthHeight", "Camera.height"];
const RESOLUTION: &[&str] = &["resolution", "image_size"];
const FX: &[&str] = &["fx", "fl_x", "fx_depth", "Camera.fx", "Camera1.fx"];
const FY: &[&str] = &["fy", "fl_y", "fy_depth", "Camera.fy", "Camera1.fy"];
const CX: &[&str] = &["cx", "ppx", "mx_depth", "Camera.cx", "Camera1.cx"];
const CY: &[&str] = &["cy", "ppy", "my_depth", "Camera.cy", "Camera1.cy"];
/// Names under which a list of fx, fy, cx and cy is stored.
const FOUR: &[&str] = &["intrinsics"];
const MATRIX: &[&str] = &[
    "intrinsic_matrix",
    "K",
    "k",
    "camera_matrix",
    "cam_K",
    "cameraMatrix",
    "Camera_Matrix",
    "intrinsic",
    "depth_intrinsic",
];
const PROJECTION: &[&str] = &["P", "p", "projection_matrix"];
const DISTORTION: &[&str] = &[
    "distortion",
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "dist_coeff",
    "dist_coefs",
    "dist_coef",
    "dist",
    "distCoeffs",
    "coeffs",
    "D",
    "d",
];
const MODEL: &str = "distortion_model";
const CAMERA_MODEL: [&str; 2] = ["camera_model", "Camera.type"];
/// librealsense's key for the distortion model, and the prefix of its values. Other programs store a camera's name
/// under this key.
const MODEL_OF_REALSENSE: (&str, &str) = ("model", "distortion.");
/// Keys that mark a fisheye lens.
const FISHEYE: [&str; 2] = ["is_fisheye", "fisheye_model"];
const SINGLE: [&str; 8] = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
/// Names under which the number of depth units per metre is stored.
const UNITS: &[&str] = &["depth_units_per_metre"];
/// Names under which a depth scale is stored; [`units_of_scale`] interprets its value.
const SCALE: &[&str] = &[
    "depth_scale",
    "depthScale",
    "png_depth_scale",
    "integer_depth_scale",
    "DepthMapFactor",
    "Camera.RGBD.DepthMapFactor",
];
/// Replica's name for the depth scale, within `camera`; elsewhere, this name means the scale of a scene.
const REPLICA_SCALE: &str = "scale";
const REGION: &str = "roi";
const BINNING: [&[&str]; 2] = [&["binning_x"], &["binning_y"]];
/// Keys under which a camera may be nested.
const NESTED: [&str; 4] = ["intrinsic", "intrinsics", "camera", "depth"];

/// The named values of a camera, and of the object that contains it, which may state the depth unit.
struct Names<'a> {
    own: &'a Map<String, Value>,
    outer: Option<&'a Map<String, Value>>,
}

impl<'a> Names<'a> {
    fn get(&self, name: &str) -> Option<(&'a str, &'a Value)> {
        let own = self.own.get_key_value(name).filter(|(_, value)| !value.is_null());
        let outer = || self.outer?.get_key_value(name).filter(|(_, value)| !value.is_null() && !value.is_object());
        own.or_else(outer).map(|(name, value)| (name.as_str(), value))
    }

    fn value(&self, names: &[&str]) -> Option<(&'a str, &'a Value)> {
        names.iter().find_map(|name| self.get(name))
    }

    fn number(&self, names: &[&str]) -> FormatResult<Option<f64>> {
        let Some((name, value)) = self.value(names) else { return Ok(None) };
        let number = value.as_f64().or_else(|| value.as_str()?.trim().parse().ok());
        number.map(Some).ok_or_else(|| malformed(format!("{name} is {}, not a number", quoted(&value.to_string()))))
    }

    fn pixels(&self, names: &[&str]) -> FormatResult<Option<usize>> {
        let Some(number) = self.number(names)? else { return Ok(None) };
        let is_whole = number >= 0.0 && number.fract() == 0.0 && number <= f64::from(u32::MAX);
        let what = || malformed(format!("{} is {number}, not a number of pixels", names[0]));
        if is_whole { Ok(Some(number as usize)) } else { Err(what()) }
    }

    /// Returns the numbers in a list, in a list of lists, or in the `data` of an OpenCV matrix.
    fn numbers(&self, names: &[&str]) -> FormatResult<Option<Vec<f64>>> {
        let Some((name, value)) = self.value(names) else { return Ok(None) };
        let value = value.get("data").unwrap_or(value);
        flat(value).map(Some).ok_or_else(|| malformed(format!("{name} has values that are not numbers")))
    }
}

/// Returns the numbers of nested lists, in order.
fn flat(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Array(values) => Some(values.iter().map(flat).collect::<Option<Vec<_>>>()?.concat()),
        value => Some(vec![value.as_f64()?]),
    }
}

/// Returns the camera that a file's contents describe.
pub(super) fn camera_of(value: &Value) -> FormatResult<CameraFile> {
    let lacking = || malformed("the camera file lacks intrinsics: fx, fy, cx and cy, or a matrix".into());
    if let Value::Array(_) = value {
        let numbers = flat(value).ok_or_else(lacking)?;
        let (focal_length, centre) = match numbers[..] {
            [fx, fy, cx, cy] => ([fx, fy], [cx, cy]),
            _ => intrinsics_of(&numbers).ok_or_else(|| not_intrinsics(&numbers))?,
        };
        let camera = Camera::new((0, 0), focal_length, centre);
        return Ok(CameraFile { camera, states_units: false, notes: Vec::new() });
    }
    let Value::Object(map) = value else { return Err(lacking()) };
    let nested = NESTED.iter().find_map(|name| map.get(*name).and_then(Value::as_object));
    let (own, outer) = match nested {
        Some(nested) if !has_intrinsics(map) => (nested, Some(map)),
        _ => (map, None),
    };
    let names = Names { own, outer };
    if has_intrinsics(own) {
        return of_names(&names, lacking);
    }
    let mut of_images = map.values().filter(|value| value.get("cam_K").is_some() || value.get("intrinsics").is_some());
    if let Some(first) = of_images.next() {
        let camera = camera_of(first)?;
        let is_other = |value: &Value| camera_of(value).map_or(true, |other| other.camera != camera.camera);
        if of_images.any(is_other) {
            return Err(FormatError::Unsupported(
                "the file has different cameras; keep only the camera of this image".into(),
            ));
        }
        return Ok(camera);
    }
    of_names(&names, lacking)
}

/// Returns true if an object directly contains a focal length, a matrix or a list of intrinsics.
fn has_intrinsics(map: &Map<String, Value>) -> bool {
    [FX, MATRIX, FOUR]
        .iter()
        .flat_map(|names| names.iter())
        .any(|name| map.get(*name).is_some_and(|v| !v.is_object() || v.get("data").is_some()))
}

fn of_names(names: &Names<'_>, lacking: impl Fn() -> FormatError) -> FormatResult<CameraFile> {
    let mut notes = Vec::new();
    let (focal_length, centre) = intrinsics(names, &mut notes)?.ok_or_else(lacking)?;
    let resolution = names.numbers(RESOLUTION)?.and_then(|sizes| <[f64; 2]>::try_from(sizes).ok());
    let shape = match (names.pixels(WIDTH)?, names.pixels(HEIGHT)?, resolution) {
        (Some(width), Some(height), _) => (width, height),
        (None, None, Some([width, height])) => (width as usize, height as usize),
        (None, None, None) => (0, 0),
        _ => {
            let text = "the camera has only one of width and height; give both or neither";
            return Err(FormatError::Malformed(text.into()));
        }
    };
    let mut camera = Camera::new(shape, focal_length, centre).with_distortion(distortion(names)?);
    let replica = if names.outer.is_some() { names.own.get(REPLICA_SCALE).and_then(Value::as_f64) } else { None };
    let (units, scale) = (names.number(UNITS)?, names.number(SCALE)?.or(replica));
    let of_scale = scale.map(|scale| units_of_scale(scale, &mut notes)).transpose()?;
    if crate::HAS_ROOM
        && let (Some(units), Some(scale)) = (units, of_scale)
        && (units / scale - 1.0).abs() > 0.01
    {
        return Err(malformed(format!(
            "depth_units_per_metre is {units}, but the depth scale means {scale} units per metre; remove one of them"
        )));
    }
    if let Some(units) = units.or(of_scale) {
        camera = camera.with_depth_units_per_metre(units);
    }
    Ok(CameraFile { camera: part_of(names, camera)?, states_units: units.or(scale).is_some(), notes })
}

fn intrinsics(names: &Names<'_>, notes: &mut Vec<String>) -> FormatResult<Option<Intrinsics>> {
    let single = [FX, FY, CX, CY].map(|name| names.number(name));
    let [fx, fy, cx, cy] = single;
    let (fx, fy, cx, cy) = (fx?, fy?, cx?, cy?);
    let of_projection = names.numbers(PROJECTION)?.and_then(|p| intrinsics_of(&p)).filter(|(focal, _)| focal[0] != 0.0);
    if let Some(matrix) = names.numbers(MATRIX)?.filter(|matrix| matrix.iter().any(|number| *number != 0.0)) {
        let of_matrix = intrinsics_of(&matrix).ok_or_else(|| not_intrinsics(&matrix))?;
        let distorts = names.numbers(DISTORTION)?.is_some_and(|all| all.iter().any(|number| *number != 0.0));
        if let Some(projection) = of_projection.filter(|projection| !distorts && differ(projection, &of_matrix)) {
            notes.push(format!(
                "K and P differ although the distortion is zero: fx is {} or {}, cx is {} or {}; using K",
                of_matrix.0[0], projection.0[0], of_matrix.1[0], projection.1[0]
            ));
        }
        if crate::HAS_ROOM
            && let (Some(fx), Some(fy), Some(cx), Some(cy)) = (fx, fy, cx, cy)
            && differ(&([fx, fy], [cx, cy]), &of_matrix)
        {
            return Err(malformed(format!(
                "the matrix states fx = {}, cx = {}, but the file also has fx = {fx}, cx = {cx}; remove one of them",
                of_matrix.0[0], of_matrix.1[0]
            )));
        }
        return Ok(Some(of_matrix));
    }
    if let (Some(fx), Some(fy), Some(cx), Some(cy)) = (fx, fy, cx, cy) {
        return Ok(Some(([fx, fy], [cx, cy])));
    }
    if let Some(four) = names.numbers(FOUR)? {
        return match four[..] {
            [fx, fy, cx, cy] => Ok(Some(([fx, fy], [cx, cy]))),
            _ => intrinsics_of(&four).map(Some).ok_or_else(|| not_intrinsics(&four)),
        };
    }
    Ok(of_projection)
}

/// Returns true if intrinsics differ by more than rounding.
fn differ(a: &Intrinsics, b: &Intrinsics) -> bool {
    const SAME_PX: f64 = 0.5;
    [0, 1].iter().any(|&axis| (a.0[axis] - b.0[axis]).abs() > SAME_PX || (a.1[axis] - b.1[axis]).abs() > SAME_PX)
}

fn not_intrinsics(numbers: &[f64]) -> FormatError {
    malformed(format!("the {} numbers are not a matrix [fx 0 cx; 0 fy cy; 0 0 1]", numbers.len()))
}

fn distortion(names: &Names<'_>) -> FormatResult<Distortion> {
    let (key, prefix) = MODEL_OF_REALSENSE;
    let text = |key: &str| names.get(key).and_then(|(_, model)| model.as_str());
    let of_realsense = text(key).filter(|model| model.starts_with(prefix));
    let is_true = |value: &Value| match value {
        Value::String(text) => matches!(&text.to_ascii_lowercase()[..], "true" | "1" | "yes"),
        Value::Number(number) => number.as_f64() != Some(0.0),
        value => value.as_bool() == Some(true),
    };
    let is_fisheye = FISHEYE.iter().any(|name| names.get(name).is_some_and(|(_, value)| is_true(value)));
    // The camera model "pinhole" does not specify the lens distortion.
    let of_camera = CAMERA_MODEL.iter().filter_map(|key| text(key)).filter(|name| !is_pinhole(name));
    let mut models: Vec<&str> = text(MODEL).into_iter().chain(of_realsense).chain(of_camera).collect();
    if is_fisheye {
        models.insert(0, "fisheye");
    }
    let mut single = [None; SINGLE.len()];
    for (name, number) in SINGLE.iter().zip(&mut single) {
        *number = names.number(&[name, &format!("Camera.{name}"), &format!("Camera1.{name}")])?;
    }
    let [k1, k2, p1, p2, k3, k4, ..] = single.map(Option::unwrap_or_default);
    let listed = names.numbers(DISTORTION)?.unwrap_or_default();
    let is_single = single.iter().any(Option::is_some);
    let of_model = |model: &str| {
        let is_fisheye = matches!(Distortion::of_model(model, &[0.0; 4]), Ok(Distortion::Equidistant(_)));
        let coefficients = match is_single {
            true if is_fisheye && [p1, p2] == [0.0; 2] => vec![k1, k2, k3, k4],
            true => single.map(Option::unwrap_or_default).to_vec(),
            false => listed.clone(),
        };
        Distortion::of_model(model, &coefficients).map_err(|error| match error {
            FormatError::Malformed(text) => malformed(text),
            other => other,
        })
    };
    let first = of_model(models.first().copied().unwrap_or_default())?;
    models.iter().try_for_each(|model| of_model(model).map(drop))?;
    Ok(first)
}

/// Returns true for a camera model that does not specify the lens distortion.
fn is_pinhole(name: &str) -> bool {
    ["pinhole", "simple_pinhole", "rectified"].iter().any(|pinhole| name.eq_ignore_ascii_case(pinhole))
}

/// Converts a depth scale to depth units per metre. Depending on its size, the scale is read as units per metre,
/// millimetres per unit, or metres per unit.
fn units_of_scale(scale: f64, notes: &mut Vec<String>) -> FormatResult<f64> {
    let (units, convention) = match scale {
        100.0.. => return Ok(scale),
        0.01..=10.0 => (1000.0 / scale, "millimetres per unit, as in BOP"),
        1e-6..=0.005 => (1.0 / scale, "metres per unit, as in librealsense"),
        _ => {
            return Err(malformed(format!(
                "depth_scale {scale} is not the unit of any depth camera; set depth_units_per_metre instead (1000 for \
                 millimetres)"
            )));
        }
    };
    // Remove the rounding error of the division.
    let units = (units * 1e6).round() / 1e6;
    notes.push(format!("depth_scale {scale} is read as {convention}: {units} units per metre"));
    Ok(units)
}

/// Returns the camera restricted to the region of interest, whose pixels may be binned.
fn part_of(names: &Names<'_>, camera: Camera) -> FormatResult<Camera> {
    let binning = [names.pixels(BINNING[0])?.unwrap_or(0).max(1), names.pixels(BINNING[1])?.unwrap_or(0).max(1)];
    let (mut offset, mut size) = ([0, 0], (camera.width, camera.height));
    if let Some(Value::Object(region)) = names.own.get(REGION) {
        let region = Names { own: region, outer: None };
        let pixels = |name: &str| region.pixels(&[name]).map(Option::unwrap_or_default);
        let whole = (pixels("width")?, pixels("height")?);
        // An empty region means the whole image.
        if whole.0 > 0 && whole.1 > 0 {
            (offset, size) = ([pixels("x_offset")?, pixels("y_offset")?], whole);
        }
    }
    Ok(camera.of_region(offset, size, binning))
}

/// Iterates over the names that a camera file's values may have.
#[cfg(feature = "more-formats")]
pub(super) fn names() -> impl Iterator<Item = &'static str> {
    let all = [WIDTH, HEIGHT, RESOLUTION, FX, FY, CX, CY, FOUR, MATRIX, PROJECTION, DISTORTION, UNITS, SCALE];
    all.into_iter().flatten().copied().chain(SINGLE).chain(FISHEYE).chain([MODEL]).chain(CAMERA_MODEL)
}

/// Returns the first unknown key of a camera file.
pub(super) fn unknown_key(value: &Value) -> Option<String> {
    let known = [WIDTH, HEIGHT, RESOLUTION, FX, FY, CX, CY, FOUR, MATRIX, PROJECTION, DISTORTION, UNITS, SCALE];
    let is_known = |name: &str| {
        name == MODEL
            || CAMERA_MODEL.contains(&name)
            || known.iter().any(|names| names.contains(&name))
            || SINGLE.contains(&name)
            || FISHEYE.contains(&name)
            || NESTED.contains(&name)
            || BINNING.iter().any(|names| names.contains(&name))
            || [REGION, MODEL_OF_REALSENSE.0, REPLICA_SCALE].contains(&name)
    };
    value.as_object()?.keys().find(|name| !is_known(name)).cloned()
}
