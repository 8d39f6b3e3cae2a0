//! Files, simulated frames, scores and devices.

use std::path::PathBuf;

use numpy::{PyArray1, PyArrayMethods, PyReadonlyArray2};
use planish::evaluate::{Evaluation, Suite};
use planish::io::{self, Contents, Encoding, FileRead, LengthUnit, ReadOptions};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{
    Attribute, AttributeValues, Camera, DepthImage, IntoFrame, OrganizedCloud, Outputs, PointCloud, Precision,
    SensorChoice, SensorModel, Session, Smoothed, Xyz,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::camera::PyCamera;
use crate::errors::{frame, to_py, warn};
use crate::settings::{from_dict, sensor_named, to_dict};

/// Reads a file into a dictionary of its contents.
#[pyfunction]
pub fn read<'py>(
    py: Python<'py>,
    path: PathBuf,
    unit: Option<&str>,
    columns: Option<usize>,
    image: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let unit: Option<LengthUnit> = unit.map(str::parse).transpose().map_err(to_py)?;
    let options = ReadOptions::default().with_unit(unit).with_columns(columns).with_image(image);
    let FileRead { format, contents, camera, notes, .. } =
        py.detach(|| io::read_file(&path, &options)).map_err(to_py)?;
    // The stack level is 2, since the Python function of the same name calls this one.
    warn(py, &path, &notes, 2)?;
    let found = PyDict::new(py);
    if let Some(camera) = camera {
        found.set_item("camera", Py::new(py, PyCamera(camera))?)?;
    }
    found.set_item("format", format.name())?;
    let (width, height) = contents.shape();
    match contents {
        Contents::Depth(image) => {
            found.set_item("depth", PyArray1::from_vec(py, image.raw).reshape([height, width])?)?;
        }
        Contents::DepthMetres { depth_m, .. } => {
            found.set_item("depth", PyArray1::from_vec(py, depth_m).reshape([height, width])?)?;
        }
        Contents::Organized(cloud) => {
            found.set_item("grid", (height, width))?;
            if let Some(camera) = cloud.camera {
                found.set_item("camera", Py::new(py, PyCamera(camera))?)?;
            }
            put_cloud(py, &found, cloud.points)?;
        }
        Contents::General(cloud) => put_cloud(py, &found, cloud)?,
        _ => return Err(PyValueError::new_err(format!("{}: contains neither depth nor points", path.display()))),
    }
    Ok(found)
}

pub fn put_cloud<'py>(py: Python<'py>, found: &Bound<'py, PyDict>, cloud: PointCloud) -> PyResult<()> {
    let len = cloud.len();
    if cloud.origin_m == [0.0; 3] {
        let rows: Vec<f32> = cloud.positions.iter().flatten().collect();
        found.set_item("points", PyArray1::from_vec(py, rows).reshape([len, 3])?)?;
    } else {
        let absolute = |i: usize| [0, 1, 2].map(|axis| cloud.coordinate(axis, i));
        let rows: Vec<f64> = (0..len).flat_map(absolute).collect();
        found.set_item("points", PyArray1::from_vec(py, rows).reshape([len, 3])?)?;
    }
    if !cloud.pose.is_identity() {
        found.set_item("pose", cloud.pose.viewpoint())?;
    }
    let fields = PyDict::new(py);
    for attribute in cloud.attributes.into_iter().filter(|attribute| attribute.name != "_") {
        let values = match attribute.values {
            AttributeValues::I8(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::U8(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::I16(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::U16(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::I32(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::U32(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::I64(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::U64(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::F32(values) => PyArray1::from_vec(py, values).into_any(),
            AttributeValues::F64(values) => PyArray1::from_vec(py, values).into_any(),
        };
        let shaped =
            if attribute.count == 1 { values } else { values.call_method1("reshape", (len, attribute.count))? };
        fields.set_item(attribute.name, shaped)?;
    }
    found.set_item("fields", fields)
}

/// Writes points with their fields; `grid` is (height, width) of an organized cloud.
#[pyfunction]
#[allow(clippy::too_many_arguments)]
pub fn write_points(
    py: Python<'_>,
    path: PathBuf,
    points: PyReadonlyArray2<'_, f64>,
    origin_m: [f64; 3],
    grid: Option<(usize, usize)>,
    fields: &Bound<'_, PyDict>,
    pose: Option<[f64; 7]>,
    encoding: &str,
) -> PyResult<()> {
    let (encoding, precision) = encoding_of(&[encoding.to_owned()])?;
    let mut cloud = cloud_of(&points, origin_m, fields, pose)?;
    cloud.position_columns.precision = precision.unwrap_or_default();
    let encoding = encoding.unwrap_or_default();
    let written = match grid {
        None => py.detach(|| io::write_cloud(&path, &cloud, encoding)),
        Some((height, width)) => {
            let cloud = OrganizedCloud::new(width, height, cloud).map_err(frame)?;
            py.detach(|| io::write_cloud(&path, &cloud, encoding))
        }
    };
    written.map_err(to_py)
}

/// Parses names such as "ascii" and "f64" into an encoding and a precision of coordinates.
pub fn encoding_of(names: &[String]) -> PyResult<(Option<Encoding>, Option<Precision>)> {
    let (mut encoding, mut precision) = (None, None);
    for name in names.iter().flat_map(|names| names.split(',')) {
        match name {
            "binary" => encoding = Some(Encoding::Binary),
            "ascii" => encoding = Some(Encoding::Ascii),
            "compressed" => encoding = Some(Encoding::BinaryCompressed),
            "f32" => precision = Some(Precision::F32),
            "f64" => precision = Some(Precision::F64),
            _ => {
                return Err(PyValueError::new_err(format!(
                    "encoding = {name:?} is not allowed; expected \"binary\", \"ascii\", \"compressed\", \"f32\" or \
                     \"f64\""
                )));
            }
        }
    }
    Ok((encoding, precision))
}

/// Creates a cloud from points and fields, with coordinates relative to an origin.
pub fn cloud_of(
    points: &PyReadonlyArray2<'_, f64>,
    origin_m: [f64; 3],
    fields: &Bound<'_, PyDict>,
    pose: Option<[f64; 7]>,
) -> PyResult<PointCloud> {
    let rows = points.as_array();
    let positions: Xyz = rows.outer_iter().map(|p| [0, 1, 2].map(|axis| (p[axis] - origin_m[axis]) as f32)).collect();
    let mut cloud = PointCloud::new(positions);
    cloud.origin_m = origin_m;
    if let Some(pose) = pose {
        cloud.pose = planish::SensorPose::from_viewpoint(pose);
        cloud.pose.validate().map_err(frame)?;
    }
    for (name, values) in fields.iter() {
        let name: String = name.extract()?;
        let values = attribute_values(&values).ok_or_else(|| {
            PyTypeError::new_err(format!(
                "fields[{name:?}]: expected an array of integers or floats with one value per point"
            ))
        })?;
        // Python has checked the shape of fields with several values per point.
        let count = values.len() / cloud.len().max(1);
        cloud.attributes.push(Attribute { name, count: count.max(1), values });
    }
    Ok(cloud)
}

fn attribute_values(array: &Bound<'_, PyAny>) -> Option<AttributeValues> {
    macro_rules! of_type {
        ($($scalar:ty => $kind:ident),*) => {
            $(if let Ok(array) = array.cast::<PyArray1<$scalar>>() {
                return Some(AttributeValues::$kind(array.to_vec().ok()?));
            })*
        };
    }
    of_type!(i8 => I8, u8 => U8, i16 => I16, u16 => U16, i32 => I32, u32 => U32, i64 => I64, u64 => U64, f32 => F32, f64 => F64);
    None
}

/// Writes a depth image of raw values or of metres.
#[pyfunction]
pub fn write_depth(py: Python<'_>, path: PathBuf, depth: &Bound<'_, PyAny>) -> PyResult<()> {
    if let Ok(raw) = depth.extract::<PyReadonlyArray2<'_, u16>>() {
        let (height, width) = (raw.as_array().nrows(), raw.as_array().ncols());
        let values: Vec<u16> = raw.as_array().iter().copied().collect();
        let image = DepthImage { width, height, raw: values };
        return py.detach(|| io::write_depth(&path, &image)).map_err(to_py);
    }
    let depth_m = depth.extract::<PyReadonlyArray2<'_, f32>>()?;
    let width = depth_m.as_array().ncols();
    let values: Vec<f32> = depth_m.as_array().iter().copied().collect();
    py.detach(|| io::write_depth_metres(&path, width, &values)).map_err(to_py)
}

/// Simulates a depth image; returns its raw depth, and the true points and normals of its pixels.
#[pyfunction]
pub fn simulate<'py>(
    py: Python<'py>,
    scene: &str,
    seed: u64,
    camera: PyRef<'py, PyCamera>,
    sensor: &str,
    index: u64,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let (scene, pose) = match scene {
        "table" => Scene::tabletop(seed),
        "room" => Scene::room(seed),
        "shapes" => {
            let (scene, pose, _) = Scene::gauges(seed);
            (scene, pose)
        }
        "curves" => {
            const RANGE_M: f64 = 1.2;
            let (scene, pose, _) = Scene::curves(seed, RANGE_M);
            (scene, pose)
        }
        _ => {
            return Err(PyValueError::new_err(format!(
                "scene = {scene:?} is not allowed; expected \"table\", \"room\", \"shapes\" or \"curves\""
            )));
        }
    };
    let (camera, noise): (Camera, DepthNoise) = (camera.0, DepthNoise::of_sensor(&sensor_named(sensor)?));
    let (depth, truth) = py
        .detach(|| {
            let truth = scene.render(&camera, &pose);
            DepthSimulator::new(noise, camera, seed).frame(&truth, index).map(|depth| (depth, truth))
        })
        .map_err(frame)?;
    let shape = [camera.height, camera.width];
    let vectors = |of: &Xyz| {
        let rows: Vec<f32> = of.iter().flatten().collect();
        PyArray1::from_vec(py, rows).reshape([shape[0], shape[1], 3])
    };
    let raw = PyArray1::from_vec(py, depth.raw).reshape(shape)?;
    Ok((raw.into_any(), vectors(&truth.points)?.into_any(), vectors(&truth.normals)?.into_any()))
}

/// Evaluates settings on simulated frames; returns the scores as JSON.
#[pyfunction]
pub fn evaluate(py: Python<'_>, settings: &Bound<'_, PyDict>, seeds: Vec<u64>) -> PyResult<String> {
    let settings = from_dict(settings)?;
    settings.check_no_video().map_err(to_py)?;
    let sensor = match settings.sensor {
        Some(SensorChoice::Known(sensor)) => sensor,
        _ => SensorModel::KINECT_V1,
    };
    let suite = Suite { noise: DepthNoise::of_sensor(&sensor), ..Suite::default() };
    let mut session = Session::new(settings).map_err(to_py)?;
    session.set_outputs(Outputs::POINTS.with_normals(true));
    let (mut raw, mut smoothed) = (Evaluation::default(), Evaluation::default());
    for seed in seeds {
        py.check_signals()?;
        for case in suite.cases(seed).map_err(frame)? {
            let view = (&case.frame).into_frame().map_err(frame)?;
            let cloud = case.frame.deproject().map_err(frame)?;
            let normals = planish::render::difference_normals(cloud.width(), cloud.height(), cloud.positions());
            raw.add(&case, cloud.positions(), &normals);
            let result = py.detach(|| -> Result<Smoothed, planish::Error> {
                let mut out = Smoothed::default();
                session.smooth(view, &mut out)?;
                Ok(out)
            });
            let result = result.map_err(to_py)?;
            if let Some(normals) = &result.normals {
                smoothed.add(&case, &result.points, normals);
            }
        }
    }
    let scores = serde_json::json!({ "raw": raw.report(), "smoothed": smoothed.report() });
    Ok(scores.to_string())
}

/// Reads a settings file in JSON or YAML.
#[pyfunction]
pub fn read_settings(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    to_dict(py, &planish::io::read_settings(&path).map_err(to_py)?)
}

/// Checks settings; returns them as JSON.
#[pyfunction]
pub fn settings_to_json(settings: &Bound<'_, PyDict>) -> PyResult<String> {
    Ok(planish::io::settings_to_json(&from_dict(settings)?))
}

/// Returns the origin mask value of each status, indexed by status code.
#[pyfunction]
pub fn origin_values() -> Vec<u8> {
    planish::Status::ALL.iter().map(|status| status.origin().mask_value()).collect()
}

/// Returns the GPUs of this machine, the name of the engine that `auto` chooses, and the reason.
#[pyfunction]
pub fn devices(py: Python<'_>) -> (Vec<(usize, String, String)>, String, String) {
    let adapters = py.detach(planish::gpu_adapters);
    let (engine, reason) = planish::auto_choice(&adapters);
    let listed = adapters
        .iter()
        .map(|adapter| (adapter.index, adapter.name.clone(), format!("{:?}", adapter.kind).to_lowercase()))
        .collect();
    (listed, engine.name().to_owned(), reason.to_string())
}
