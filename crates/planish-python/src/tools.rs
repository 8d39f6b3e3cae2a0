//! Operations on files and clouds: conversion, comparison, merging, meshes, cleaning, pictures.

use std::path::{Path, PathBuf};

use numpy::{PyArray1, PyArrayMethods, PyReadonlyArray2};
use planish::clean::CleanSteps;
use planish::compare;
use planish::io::{self, Contents, ConvertOptions};
use planish::mesh::mesh_of;
use planish::{Camera, DepthFrame, DepthImage, OrganizedCloud, PointCloud, SensorPose, render, rig};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::camera::PyCamera;
use crate::errors::{frame, to_py};
use crate::files::{cloud_of, encoding_of, put_cloud};
use crate::settings::from_dict;

/// Runs `work` detached from the interpreter, on new threads, since shared threads do not survive a fork.
fn on_own_threads<T: Send, E: Send>(
    py: Python<'_>,
    work: impl FnOnce() -> Result<T, E> + Send,
) -> Result<T, planish::Error>
where
    planish::Error: From<E>,
{
    py.detach(|| {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Ok(planish::internal::Threads::open(Some(cores))?.install(work)?)
    })
}

/// Refuses to overwrite an input.
fn check_not_input(input: &Path, output: &Path) -> PyResult<()> {
    match io::is_same_file(input, output) {
        true => {
            Err(PyValueError::new_err(format!("{}: the output is the input; write to another file", output.display())))
        }
        false => Ok(()),
    }
}

/// The formats that were read and written, the shape, the number of valid points, and notes.
type Converted = (String, String, (usize, usize), usize, Vec<String>);

/// Converts a file; returns formats, shape, number of valid points, and notes.
#[pyfunction]
pub fn convert(
    py: Python<'_>,
    input: PathBuf,
    output: PathBuf,
    camera: Option<PyRef<'_, PyCamera>>,
    drop_holes: bool,
    fields: Option<Vec<String>>,
    encoding: Vec<String>,
) -> PyResult<Converted> {
    check_not_input(&input, &output)?;
    let (encoding, precision) = encoding_of(&encoding)?;
    let options = ConvertOptions::default()
        .with_camera(camera.map(|camera| camera.0))
        .with_drop_holes(drop_holes)
        .with_fields(fields)
        .with_encoding(encoding)
        .with_precision(precision);
    let report = on_own_threads(py, || {
        let file = io::read_file(&input, &io::ReadOptions::default())?;
        io::convert(file, &output, &options)
    });
    let report = report.map_err(to_py)?;
    let (width, height) = report.shape;
    Ok((report.from.name().into(), report.to.name().into(), (height, width), report.valid, report.notes))
}

fn read(file: &Path, camera: Option<&Camera>) -> Result<Contents, planish::Error> {
    let (_, contents) = io::read(file)?;
    Ok(contents.with_points(camera).map_err(planish::IoError::at(file))?)
}

/// Compares two files; returns JSON.
#[pyfunction]
pub fn compare_files(
    py: Python<'_>,
    a: PathBuf,
    b: PathBuf,
    camera: Option<PyRef<'_, PyCamera>>,
    nearest: bool,
) -> PyResult<String> {
    let camera = camera.map(|camera| camera.0);
    let found =
        on_own_threads(py, || compare::compare(&read(&a, camera.as_ref())?, &read(&b, camera.as_ref())?, nearest));
    serde_json::to_string(&found.map_err(to_py)?).map_err(|error| PyValueError::new_err(error.to_string()))
}

/// Merges the clouds of files, each with its pose; returns the number of points, and notes.
#[pyfunction]
pub fn merge(
    py: Python<'_>,
    inputs: Vec<PathBuf>,
    output: PathBuf,
    poses: Option<Vec<[f64; 7]>>,
    encoding: Vec<String>,
) -> PyResult<(usize, Vec<String>)> {
    inputs.iter().try_for_each(|input| check_not_input(input, &output))?;
    let (encoding, precision) = encoding_of(&encoding)?;
    let merged = on_own_threads(py, || {
        let mut clouds = Vec::new();
        for (i, input) in inputs.iter().enumerate() {
            let (_, contents) = io::read(input)?;
            let cloud = match contents {
                Contents::General(cloud) => cloud,
                contents => contents.into_organized(None).map_err(planish::IoError::at(input))?.points,
            };
            let pose = poses.as_ref().and_then(|poses| poses.get(i)).map(|pose| SensorPose::from_viewpoint(*pose));
            clouds.push((cloud, pose.unwrap_or(SensorPose::IDENTITY)));
        }
        let (mut merged, mut notes) = rig::merge(clouds)?;
        notes.extend(io::write_merged(&output, &mut merged, encoding.unwrap_or_default(), precision)?);
        Ok::<(usize, Vec<String>), planish::Error>((merged.len(), notes))
    });
    merged.map_err(to_py)
}

/// Smooths the frame of a file and writes its mesh. With `raw`, the frame is not smoothed. Returns the numbers of
/// vertices and triangles.
#[pyfunction]
pub fn mesh(
    py: Python<'_>,
    input: PathBuf,
    output: PathBuf,
    camera: Option<PyRef<'_, PyCamera>>,
    raw: bool,
    settings: &Bound<'_, PyDict>,
) -> PyResult<(usize, usize)> {
    check_not_input(&input, &output)?;
    let settings = from_dict(settings)?;
    let camera = camera.map(|camera| camera.0);
    let written = on_own_threads(py, || {
        let (_, contents) = io::read(&input)?;
        let cloud = contents.into_organized(camera.as_ref()).map_err(planish::IoError::at(&input))?;
        let mesh = mesh_of(cloud, settings, raw)?.mesh;
        io::write_mesh(&output, &mesh)?;
        Ok::<(usize, usize), planish::Error>((mesh.positions.len(), mesh.triangles.len()))
    });
    written.map_err(to_py)
}

/// A cloud: points, origin in metres, grid (height, width), fields and pose.
type Given<'py> = (PyReadonlyArray2<'py, f64>, [f64; 3], Option<(usize, usize)>, Bound<'py, PyDict>, Option<[f64; 7]>);

fn cloud_given(given: &Given<'_>) -> PyResult<PointCloud> {
    let (points, origin_m, _, fields, pose) = given;
    cloud_of(points, *origin_m, fields, *pose)
}

/// Cleans a cloud; returns the remaining points in the same form as `read`.
#[pyfunction]
pub fn clean<'py>(
    py: Python<'py>,
    given: Given<'py>,
    crop_m: Option<[[f64; 3]; 2]>,
    voxel_m: Option<f64>,
    statistical: Option<(usize, f32)>,
    radius: Option<(f32, usize)>,
) -> PyResult<Bound<'py, PyDict>> {
    let mut cloud = cloud_given(&given)?;
    let mut grid = given.2.map(|(height, width)| (width, height));
    let steps = CleanSteps { crop_m, voxel_m, statistical, radius };
    on_own_threads(py, || steps.apply(&mut cloud, &mut grid)).map_err(to_py)?;
    let found = PyDict::new(py);
    if let Some((width, height)) = grid {
        found.set_item("grid", (height, width))?;
    }
    put_cloud(py, &found, cloud)?;
    Ok(found)
}

/// Draws a cloud as a shaded relief, with its colours next to it; returns [H, W, 3] bytes.
#[pyfunction]
pub fn draw<'py>(py: Python<'py>, given: Given<'py>, from: [f64; 3]) -> PyResult<Bound<'py, PyAny>> {
    /// Length in pixels of the longer side of an unorganized cloud's picture.
    const LONGEST_SIDE: usize = 1280;
    let cloud = cloud_given(&given)?;
    let grid = given.2;
    let picture = on_own_threads(py, || {
        let cloud = match grid {
            Some((height, width)) => OrganizedCloud::new(width, height, cloud)?,
            None => render::seen_from(&cloud, from, LONGEST_SIDE)?,
        };
        let mut pictures = vec![render::relief(cloud.width(), cloud.height(), &render::normals_of(&cloud))];
        pictures.extend(render::colours(&cloud));
        Ok::<_, planish::FrameError>(render::side_by_side(&pictures))
    });
    let picture = picture.map_err(to_py)?;
    Ok(PyArray1::from_vec(py, picture.rgb).reshape([picture.height, picture.width, 3])?.into_any())
}

/// Applies the steps before smoothing to a depth image; returns the image and its camera.
#[pyfunction]
pub fn prepare<'py>(
    py: Python<'py>,
    depth: PyReadonlyArray2<'py, u16>,
    camera: PyRef<'py, PyCamera>,
    settings: &Bound<'_, PyDict>,
) -> PyResult<(Bound<'py, PyAny>, PyCamera)> {
    let settings = from_dict(settings)?;
    let (steps, sensor) = (settings.preparation(), settings.known_sensor().unwrap_or_default());
    let (height, width) = (depth.as_array().nrows(), depth.as_array().ncols());
    let raw: Vec<u16> = depth.as_array().iter().copied().collect();
    let mut image = DepthFrame::from_image(camera.0, DepthImage { width, height, raw }).map_err(frame)?;
    on_own_threads(py, || steps.depth(&mut image, &sensor)).map_err(to_py)?;
    let DepthFrame { raw, camera, .. } = image;
    Ok((PyArray1::from_vec(py, raw).reshape([camera.height, camera.width])?.into_any(), PyCamera(camera)))
}
