//! `rig.json`: the cameras of a rig and their poses.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{Clock, DEFAULT_TOLERANCE_S, Rig, RigCamera, Viewpoint, folder_of, resolve_source};
use crate::source::Alignment;
use planish_core::{Camera, FormatError, IoError, ParamError, SensorModel, SensorPose};
use planish_io::{self as io, ReadOptions};

/// Maximum size of a rig or calibration file, in bytes.
pub(super) const MAX_BYTES: u64 = 1 << 24;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RigFile {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    frame: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    tolerance_ms: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    clock: Option<String>,
    cameras: Vec<CameraEntry>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    viewpoints: Vec<ViewpointEntry>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewpointEntry {
    pose: PoseEntry,
    /// Intrinsics in the format of a camera file, with the image size, or the name of such a file.
    camera: serde_json::Value,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraEntry {
    name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    source: Option<String>,
    /// Intrinsics in the format of a camera file, or the name of such a file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera: Option<serde_json::Value>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pose: Option<PoseEntry>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sensor: Option<SensorEntry>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    time_offset_s: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    align: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    mode: Option<String>,
}

/// A sensor model: its name, or its coefficients of 1, z and z² in metres.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum SensorEntry {
    Named(String),
    Model { step: [f32; 3], sigma: [f32; 3] },
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseEntry {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    position_m: Option<[f64; 3]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    orientation_xyzw: Option<[f64; 4]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    matrix: Option<Vec<[f64; 4]>>,
}

impl Rig {
    /// Reads a `rig.json`. Its sources and camera files are relative to its folder.
    ///
    /// ```json
    /// {
    ///   "frame": "base_link",
    ///   "tolerance_ms": 16,
    ///   "cameras": [
    ///     {
    ///       "name": "left",
    ///       "source": "realsense:038122250123",
    ///       "sensor": "d435",
    ///       "pose": { "position_m": [0.1, 0.2, 0.5], "orientation_xyzw": [-0.5, 0.5, -0.5, 0.5] }
    ///     },
    ///     {
    ///       "name": "right",
    ///       "source": "recordings/right",
    ///       "camera": { "fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5 },
    ///       "pose": { "matrix": [[1, 0, 0, 0.1], [0, 1, 0, -0.2], [0, 0, 1, 0.5], [0, 0, 0, 1]] },
    ///       "time_offset_s": 0.004
    ///     }
    ///   ],
    ///   "viewpoints": [
    ///     {
    ///       "pose": { "position_m": [0.1, 0, 0.5], "orientation_xyzw": [-0.5, 0.5, -0.5, 0.5] },
    ///       "camera": { "width": 640, "height": 480, "fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5 }
    ///     }
    ///   ]
    /// }
    /// ```
    pub fn read(path: &Path) -> Result<Self, IoError> {
        let read = || {
            let bytes = io::read_bytes(path, &ReadOptions::default().with_max_memory_bytes(MAX_BYTES))?;
            let text = String::from_utf8(bytes).map_err(|_| malformed("the file is not text; expected JSON"))?;
            parse(&text, &folder_of(path))
        };
        read().map_err(IoError::at(path))
    }
}

fn malformed(problem: impl Into<String>) -> FormatError {
    FormatError::Malformed(problem.into())
}

fn parse(text: &str, folder: &Path) -> Result<Rig, FormatError> {
    let file: RigFile = serde_json::from_str(text).map_err(|error| malformed(format!("not a rig.json: {error}")))?;
    let clock = match file.clock.as_deref() {
        None | Some("source") => Clock::Source,
        Some("arrival") => Clock::Arrival,
        Some(other) => return Err(malformed(format!("clock is {other:?}; expected \"source\" or \"arrival\""))),
    };
    let cameras = file.cameras.into_iter().map(|entry| camera_of(entry, folder)).collect::<Result<_, _>>()?;
    if let Some(tolerance_ms) = file.tolerance_ms.filter(|ms| !(*ms > 0.0 && *ms <= 1000.0)) {
        return Err(malformed(format!("tolerance_ms is {tolerance_ms:?}; expected a value above 0 and at most 1000")));
    }
    let tolerance_s = file.tolerance_ms.map_or(DEFAULT_TOLERANCE_S, |tolerance_ms| 1e-3 * tolerance_ms);
    let viewpoint = |(i, entry): (usize, ViewpointEntry)| {
        let of = |problem: String| malformed(format!("viewpoint {i}: {problem}"));
        let (camera, _) = intrinsics_of(&entry.camera, folder).map_err(of)?;
        Ok(Viewpoint::new(pose_of(&entry.pose).map_err(of)?, camera))
    };
    let viewpoints = file.viewpoints.into_iter().enumerate().map(viewpoint).collect::<Result<_, FormatError>>()?;
    let rig = Rig { cameras, frame: file.frame, tolerance_s, clock, viewpoints };
    rig.validate().map_err(|error| malformed(error.to_string()))?;
    Ok(rig)
}

fn camera_of(entry: CameraEntry, folder: &Path) -> Result<RigCamera, FormatError> {
    let CameraEntry { name, source, camera, pose, sensor, time_offset_s, align, mode } = entry;
    let of = |problem: String| malformed(format!("camera {name:?}: {problem}"));
    let pose = pose.ok_or_else(|| of("no pose; add \"pose\", the camera's pose in the rig's frame".into()))?;
    let (camera, depth_units_per_metre) = match camera {
        Some(camera) => intrinsics_of(&camera, folder).map(|(camera, units)| (Some(camera), units)).map_err(of)?,
        None => (None, None),
    };
    let sensor = match sensor {
        None => None,
        Some(SensorEntry::Named(name)) => Some(name.parse().map_err(|error: ParamError| of(error.to_string()))?),
        Some(SensorEntry::Model { step, sigma }) => Some(SensorModel::new(step, sigma)),
    };
    let alignment = align.map(|align| align.parse()).transpose();
    let alignment: Option<Alignment> = alignment.map_err(|error: ParamError| of(error.to_string()))?;
    let mode = mode.map(|mode| mode.parse().map_err(|error: ParamError| of(error.to_string()))).transpose()?;
    Ok(RigCamera {
        source: source.map(|source| resolve_source(folder, &source)),
        camera,
        depth_units_per_metre,
        pose: pose_of(&pose).map_err(of)?,
        sensor,
        time_offset_s: time_offset_s.unwrap_or(0.0),
        alignment,
        mode,
        name,
    })
}

/// Reads a camera from an object, or from the camera file that a string names. The second value is the number of
/// depth units per metre, if stated.
fn intrinsics_of(value: &serde_json::Value, folder: &Path) -> Result<(Camera, Option<f64>), String> {
    let parse = |text: &str| {
        let io::CameraFile { camera, states_units, .. } = io::parse_camera_file(text, None)?;
        Ok((camera, states_units.then_some(camera.depth_units_per_metre)))
    };
    match value {
        serde_json::Value::String(file) => {
            let path = folder.join(file);
            let camera =
                planish_io::internal::camera_text(&path).and_then(|text| parse(&text)).map_err(IoError::at(&path));
            camera.map_err(|error| error.to_string())
        }
        value => {
            let text = value.to_string();
            let quoted = |error: FormatError| error.to_string();
            match io::unknown_camera_key(&text).map_err(quoted)? {
                Some(key) => Err(format!(
                    "unknown camera field {}; remove it (optional fields are depth_units_per_metre, width and height)",
                    planish_io::internal::quoted(&key)
                )),
                None => parse(&text).map_err(quoted),
            }
        }
    }
}

fn pose_of(entry: &PoseEntry) -> Result<SensorPose, String> {
    match (entry.position_m, entry.orientation_xyzw, &entry.matrix) {
        (Some(position_m), Some(orientation), None) => Ok(SensorPose::from_xyzw(position_m, orientation)),
        (None, None, Some(rows)) => pose_of_matrix(rows),
        _ => Err("a pose needs position_m and orientation_xyzw, or a matrix of three or four rows".into()),
    }
}

/// Returns the pose of a homogeneous matrix, given row by row; the last row may be omitted.
pub(super) fn pose_of_matrix(rows: &[[f64; 4]]) -> Result<SensorPose, String> {
    let &[a, b, c, ref last @ ..] = rows else {
        return Err(format!("the matrix has {} rows; expected 3 or 4", rows.len()));
    };
    if !matches!(last, [] | [[0.0, 0.0, 0.0, 1.0]]) {
        return Err("the last row of the matrix must be 0, 0, 0, 1".into());
    }
    let rotation = [a, b, c].map(|[x, y, z, _]| [x, y, z]);
    let pose = SensorPose::from_rotation([a[3], b[3], c[3]], rotation);
    pose.ok_or_else(|| {
        "the matrix is not a rotation and translation; the columns of its rotation must have length 1 and be \
         perpendicular"
            .into()
    })
}

/// Returns a rig as the text of a `rig.json`, in the format of [`Rig::read`].
pub fn rig_to_json(rig: &Rig) -> String {
    let entry = |camera: &RigCamera| CameraEntry {
        name: camera.name.clone(),
        source: camera.source.clone(),
        camera: camera.camera.as_ref().and_then(|of| intrinsics_entry(of, camera.depth_units_per_metre)),
        pose: Some(pose_entry(&camera.pose)),
        sensor: camera.sensor.map(|sensor| match sensor.name() {
            Some(name) => SensorEntry::Named(name.to_owned()),
            None => SensorEntry::Model { step: sensor.step, sigma: sensor.sigma },
        }),
        time_offset_s: (camera.time_offset_s != 0.0).then_some(camera.time_offset_s),
        align: camera.alignment.map(|alignment| alignment.name().to_owned()),
        mode: camera.mode.map(|mode| mode.to_string()),
    };
    let viewpoint = |viewpoint: &Viewpoint| {
        let camera = intrinsics_entry(&viewpoint.camera, None)?;
        Some(ViewpointEntry { pose: pose_entry(&viewpoint.pose), camera })
    };
    let file = RigFile {
        frame: rig.frame.clone(),
        tolerance_ms: (rig.tolerance_s != DEFAULT_TOLERANCE_S).then_some(1e3 * rig.tolerance_s),
        clock: (rig.clock == Clock::Arrival).then(|| "arrival".to_owned()),
        cameras: rig.cameras.iter().map(entry).collect(),
        viewpoints: rig.viewpoints.iter().filter_map(viewpoint).collect(),
    };
    // Numbers and strings can always be written as JSON.
    serde_json::to_string_pretty(&file).unwrap_or_default() + "\n"
}

/// Returns the entry for intrinsics, with the depth unit only if it is given or is not the millimetre.
fn intrinsics_entry(camera: &Camera, depth_units_per_metre: Option<f64>) -> Option<serde_json::Value> {
    let mut entry: serde_json::Value = serde_json::from_str(&io::camera_to_json(camera)).ok()?;
    let fields = entry.as_object_mut()?;
    let other = (camera.depth_units_per_metre != 1000.0).then_some(camera.depth_units_per_metre);
    match depth_units_per_metre.or(other) {
        Some(units) => fields.insert("depth_units_per_metre".to_owned(), units.into()),
        None => fields.remove("depth_units_per_metre"),
    };
    Some(entry)
}

fn pose_entry(pose: &SensorPose) -> PoseEntry {
    let [w, x, y, z] = pose.orientation;
    PoseEntry { position_m: Some(pose.position_m), orientation_xyzw: Some([x, y, z, w]), matrix: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    const POSE: &str = r#""pose":{"position_m":[1,2,3],"orientation_xyzw":[-0.5,0.5,-0.5,0.5]}"#;

    fn parse_cameras(cameras: &str) -> Result<Rig, FormatError> {
        parse(&format!(r#"{{"cameras":[{cameras}]}}"#), Path::new("/rigs"))
    }

    #[test]
    fn a_rig_comes_back_from_its_file() {
        let text = format!(
            r#"{{"frame":"base_link","tolerance_ms":5,"clock":"arrival","cameras":[
            {{"name":"left","source":"realsense:0123","sensor":"d435","align":"none","mode":"848x480@30",{POSE}}},
            {{"name":"right","source":"right","camera":{{"fx":525,"fy":525,"cx":319.5,"cy":239.5}},"time_offset_s":0.004,
              "pose":{{"matrix":[[0,0,1,1],[-1,0,0,2],[0,-1,0,3],[0,0,0,1]]}}}}]}}"#
        );
        let rig = parse(&text, Path::new("/rigs")).unwrap();
        let [left, right] = &rig.cameras[..] else { panic!("two cameras") };
        assert_eq!(left.source.as_deref(), Some("realsense:0123"));
        assert_eq!(right.source.as_deref(), Some("/rigs/right"));
        assert_eq!(left.sensor, Some(SensorModel::REALSENSE_D435));
        assert_eq!((right.time_offset_s, rig.tolerance_s, rig.clock), (0.004, 0.005, Clock::Arrival));
        assert_eq!(right.camera.map(|camera| camera.fx), Some(525.0));
        // The same pose, stated in two ways.
        let off = |i: usize, k: usize| (left.pose.rotation()[i][k] - right.pose.rotation()[i][k]).abs();
        assert_eq!(left.pose.position_m, right.pose.position_m);
        assert!((0..9).all(|i| off(i / 3, i % 3) < 1e-12), "{:?} {:?}", left.pose, right.pose);
        assert_eq!(parse(&rig_to_json(&rig), Path::new("/elsewhere")).unwrap(), rig);
    }

    #[test]
    fn viewpoints_come_back_and_what_is_wrong_with_one_says_which() {
        let of = |viewpoints: &str| {
            let text = format!(r#"{{"cameras":[{{"name":"a",{POSE}}}],"viewpoints":[{viewpoints}]}}"#);
            parse(&text, Path::new("/rigs"))
        };
        let camera = r#""camera":{"width":320,"height":240,"fx":262,"fy":263,"cx":160,"cy":120}"#;
        let rig = of(&format!("{{{POSE},{camera}}}")).unwrap();
        assert_eq!(rig.viewpoints[0].pose, rig.cameras[0].pose);
        assert_eq!((rig.viewpoints[0].camera.width, rig.viewpoints[0].camera.fy), (320, 263.0));
        assert_eq!(parse(&rig_to_json(&rig), Path::new("/elsewhere")).unwrap(), rig);
        let without_size = r#""camera":{"fx":262,"fy":263,"cx":160,"cy":120}"#;
        for (viewpoint, said) in [
            (format!("{{{POSE}}}"), "camera"),
            (format!("{{{camera}}}"), "pose"),
            (format!("{{{POSE},{camera}}},{{{POSE},{without_size}}}"), "viewpoint 1"),
            (format!(r#"{{{POSE},"camera":"missing.json"}}"#), "missing.json"),
            (vec![format!("{{{POSE},{camera}}}"); 65].join(","), "at most 64"),
            (format!("{{{POSE},{}}}", camera.replace("320", "16384").replace("240", "1025")), "2^24"),
        ] {
            let error = of(&viewpoint).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }

    #[test]
    fn the_units_of_depth_are_stated_or_the_source_s() {
        let of = |scale: &str| {
            let camera = format!(r#"{{"name":"a","camera":{{"fx":5,"fy":5,"cx":2,"cy":2{scale}}},{POSE}}}"#);
            let rig = parse_cameras(&camera).unwrap();
            assert_eq!(parse(&rig_to_json(&rig), Path::new("/elsewhere")).unwrap(), rig);
            rig.cameras[0].source_options().tum_units_per_metre
        };
        assert_eq!(of(""), None);
        assert_eq!(of(r#","depth_scale":1000"#), Some(1000.0));
        assert_eq!(of(r#","depth_units_per_metre":4000"#), Some(4000.0));
    }

    #[test]
    fn sources_are_named_as_from_the_folder_of_the_file() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("rigs/left")).unwrap();
        std::fs::create_dir_all(folder.path().join("right")).unwrap();
        let mut rig =
            parse_cameras(&format!(r#"{{"name":"a",{POSE}}},{{"name":"b",{POSE}}},{{"name":"c",{POSE}}}"#)).unwrap();
        let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
        let sources = [path("rigs/left"), path("right"), "realsense:0123".to_owned()];
        rig.cameras.iter_mut().zip(sources).for_each(|(camera, source)| camera.source = Some(source));
        let seen = rig.seen_from(&folder.path().join("rigs"));
        let sources: Vec<&str> = seen.cameras.iter().filter_map(|camera| camera.source.as_deref()).collect();
        let right = folder.path().canonicalize().unwrap().join("right").to_string_lossy().into_owned();
        assert_eq!(sources, ["./left", right.as_str(), "realsense:0123"]);
    }

    #[test]
    fn what_is_wrong_with_a_camera_names_it() {
        let said = |camera: &str| parse_cameras(camera).unwrap_err().to_string();
        for (camera, expected) in [
            (r#"{"name":"left"}"#.to_owned(), "no pose"),
            (format!(r#"{{"name":"left","sensor":"d999",{POSE}}}"#), "kinect1"),
            (format!(r#"{{"name":"left","camera":"missing.json",{POSE}}}"#), "missing.json"),
            (format!(r#"{{"name":"left","camera":{{"fx":1}},{POSE}}}"#), "fx, fy, cx and cy"),
            (
                format!(r#"{{"name":"left","camera":{{"fx":5,"fy":5,"cx":2,"cy":2,"depthscale":5000}},{POSE}}}"#),
                "unknown camera field \"depthscale\"",
            ),
            (format!(r#"{{"name":"left","mode":"big",{POSE}}}"#), "WIDTHxHEIGHT"),
            (format!(r#"{{"name":"left","align":"up",{POSE}}}"#), "align = up is not allowed: depth, color or none"),
            (r#"{"name":"left","pose":{"position_m":[0,0,0]}}"#.to_owned(), "orientation_xyzw"),
            (r#"{"name":"left","pose":{"matrix":[[2,0,0,0],[0,1,0,0],[0,0,1,0]]}}"#.to_owned(), "perpendicular"),
            (r#"{"name":"left","pose":{"matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,0,0,1]]}}"#.to_owned(), "last row"),
            (r#"{"name":"left","pose":{"position_m":[0,0,0],"orientation_xyzw":[0,0,0,2]}}"#.to_owned(), "length 1"),
            (r#"{"name":"left","pose":{"position_m":[0,0,0],"orientation_xyzw":[0,0,0,0]}}"#.to_owned(), "length 1"),
            (format!(r#"{{"name":"left","time_offset_s":1e300,{POSE}}}"#), "1e10"),
        ] {
            let said = said(&camera);
            assert!(said.contains("\"left\"") && said.contains(expected), "{said}");
        }
        assert!(said(&format!(r#"{{"name":"left","poze":1,{POSE}}}"#)).contains("poze"));
        let twice = said(&format!(r#"{{"name":"left",{POSE}}},{{"name":"left",{POSE}}}"#));
        assert!(twice.contains("unique"), "{twice}");
        assert!(parse_cameras("").unwrap_err().to_string().contains("1 to 256"));
        assert!(parse("[]", Path::new("")).unwrap_err().to_string().contains("rig.json"));
    }
}
