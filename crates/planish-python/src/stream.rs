//! A running stream that Python iterates over.

use std::path::{Path, PathBuf};
use std::time::Duration;

use numpy::{PyArray1, PyArrayMethods};
use planish::Xyz;
use planish::bag::{PoseTopic, camera_trajectory, file_of};
use planish::io::{ReadOptions, Trajectory, read_trajectory_with};
use planish::source::{self, Alignment, OwnedFrame, SourceOptions, StreamMode};
use planish::stream::{Frames, StreamFrame, StreamOptions, Waited};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::camera::PyCamera;
use crate::errors::to_py;
use crate::settings::from_dict;

/// Interval between checks for Python's signals.
const PATIENCE: Duration = Duration::from_millis(50);

/// A frame with its result, as rows of values for Python.
struct Delivered {
    frame: Frame,
    shape: (usize, usize),
    index: u64,
    name: Option<String>,
    timestamp_s: Option<f64>,
    latency_s: f64,
    points: Option<Vec<f32>>,
    normals: Option<Vec<f32>>,
    curvature: Option<Vec<f32>>,
    status: Option<Vec<u8>>,
    neighbours: Option<Vec<u32>>,
    depth: Option<Vec<u16>>,
    depth_m: Option<Vec<f32>>,
    frames: Option<Vec<f32>>,
    sigma: Option<Vec<f32>>,
}

/// The measured data of a frame.
enum Frame {
    Depth { raw: Vec<u16>, rgb: Option<Vec<u8>>, camera: PyCamera },
    Points(Vec<f32>),
}

fn rows(points: &Xyz) -> Vec<f32> {
    points.iter().flatten().collect()
}

impl Delivered {
    fn of(frame: &StreamFrame) -> Self {
        let smoothed = &frame.smoothed;
        Self {
            frame: match &frame.source {
                OwnedFrame::Depth(depth) => {
                    Frame::Depth { raw: depth.raw.clone(), rgb: depth.rgb.clone(), camera: PyCamera(depth.camera) }
                }
                OwnedFrame::Cloud { cloud, .. } => Frame::Points(rows(&cloud.points.positions)),
            },
            shape: (smoothed.width, smoothed.height),
            index: frame.index,
            name: frame.name.clone(),
            timestamp_s: frame.source.timestamp_s(),
            latency_s: frame.latency.as_secs_f64(),
            points: (!smoothed.points.is_empty()).then(|| rows(&smoothed.points)),
            normals: smoothed.normals.as_ref().map(rows),
            curvature: smoothed.curvature.clone(),
            status: smoothed.status.as_ref().map(|codes| codes.iter().map(|&status| status as u8).collect()),
            neighbours: smoothed.neighbours.clone(),
            depth: smoothed.depth.clone(),
            depth_m: smoothed.depth_m.clone(),
            frames: smoothed.frames.clone(),
            sigma: smoothed.sigma.clone(),
        }
    }

    fn into_dict(self, py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        fn put<T: numpy::Element>(
            to: &Bound<'_, PyDict>,
            name: &str,
            values: Option<Vec<T>>,
            (width, height): (usize, usize),
        ) -> PyResult<()> {
            let Some(values) = values else { return Ok(()) };
            let py = to.py();
            let each = values.len().checked_div(width * height).unwrap_or(1);
            let array = PyArray1::from_vec(py, values);
            match each {
                1 => to.set_item(name, array.reshape([height, width])?),
                each => to.set_item(name, array.reshape([height, width, each])?),
            }
        }
        let (found, result) = (PyDict::new(py), PyDict::new(py));
        let shape = self.shape;
        put(&result, "points", self.points, shape)?;
        put(&result, "normals", self.normals, shape)?;
        put(&result, "curvature", self.curvature, shape)?;
        put(&result, "status", self.status, shape)?;
        put(&result, "neighbours", self.neighbours, shape)?;
        put(&result, "depth", self.depth, shape)?;
        put(&result, "depth_m", self.depth_m, shape)?;
        put(&result, "frames", self.frames, shape)?;
        put(&result, "sigma", self.sigma, shape)?;
        found.set_item("smoothed", result)?;
        match self.frame {
            Frame::Depth { raw, rgb, camera } => {
                put(&found, "depth", Some(raw), shape)?;
                put(&found, "rgb", rgb, shape)?;
                found.set_item("camera", Py::new(py, camera)?)?;
            }
            Frame::Points(points) => put(&found, "points", Some(points), shape)?,
        }
        found.set_item("index", self.index)?;
        found.set_item("name", self.name)?;
        found.set_item("timestamp_s", self.timestamp_s)?;
        found.set_item("latency_s", self.latency_s)?;
        Ok(found)
    }
}

#[pyclass(frozen, name = "Stream", module = "planish._planish")]
pub struct PyStream {
    frames: Frames,
    /// ID of the process that opened the stream.
    process: u32,
}

#[pymethods]
impl PyStream {
    /// Opens a source and starts the stream.
    #[new]
    #[pyo3(signature = (
        source, outputs, settings, camera, fps, frames, depth_units_per_metre, align, mode, topic, poses, pose_topic, fixed_frame
    ))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        source: &str,
        outputs: Vec<String>,
        settings: &Bound<'_, PyDict>,
        camera: Option<PyRef<'_, PyCamera>>,
        fps: Option<f64>,
        frames: Option<u64>,
        depth_units_per_metre: Option<f64>,
        align: Option<&str>,
        mode: Option<&str>,
        topic: Option<String>,
        poses: Option<PathBuf>,
        pose_topic: Option<String>,
        fixed_frame: Option<String>,
    ) -> PyResult<Self> {
        let mut settings = from_dict(settings)?;
        settings.set("outputs", outputs).map_err(to_py)?;
        let source_options = SourceOptions::default()
            .with_camera(camera.map(|camera| camera.0))
            .with_tum_units_per_metre(depth_units_per_metre)
            .with_alignment(align.map(str::parse::<Alignment>).transpose().map_err(to_py)?)
            .with_mode(mode.map(str::parse::<StreamMode>).transpose().map_err(to_py)?)
            .with_topics(topic.clone(), None)
            .with_fps(fps);
        if poses.is_some() || pose_topic.is_some() {
            settings.check_poses().map_err(to_py)?;
        }
        let pose_topic = pose_topic.map(|topic| PoseTopic { topic, fixed_frame });
        let (source, poses) = py
            .detach(|| {
                let poses = trajectory(Path::new(source), topic.as_deref(), poses.as_deref(), pose_topic.as_ref())?;
                Ok((source::open(source, &source_options)?, poses))
            })
            .map_err(|error: planish::Error| to_py(error))?;
        let options = StreamOptions::from_settings(settings).map_err(to_py)?.with_max_frames(frames).with_poses(poses);
        Ok(Self { frames: Frames::start(source, options).map_err(to_py)?, process: std::process::id() })
    }

    /// Returns the next frame with its result, if one arrives within [`PATIENCE`]; the warnings; and whether the
    /// stream has ended.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<(Option<Bound<'py, PyDict>>, Vec<String>, bool)> {
        self.check_process()?;
        py.check_signals()?;
        let delivered = py.detach(|| match self.frames.next_within(PATIENCE) {
            Ok(Waited::Frame(frame)) => Ok((Some(Delivered::of(&frame)), false)),
            Ok(Waited::Ended) => Ok((None, true)),
            Ok(Waited::TimedOut) => Ok((None, false)),
            Err(error) => Err(error),
        });
        let (delivered, has_ended) = delivered.map_err(to_py)?;
        Ok((delivered.map(|delivered| delivered.into_dict(py)).transpose()?, self.frames.take_warnings(), has_ended))
    }

    /// Returns true if the source is a camera, or a recording played back in real time.
    fn is_live(&self) -> bool {
        self.frames.is_live()
    }

    /// Returns the final statistics of the stream; `None` while it runs.
    fn statistics<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let Some(statistics) = self.frames.statistics() else { return Ok(None) };
        let found = PyDict::new(py);
        found.set_item("frames_in", statistics.frames_in)?;
        found.set_item("frames_out", statistics.frames_out)?;
        found.set_item("dropped", statistics.dropped + statistics.dropped_by_sinks)?;
        found.set_item("unreadable", statistics.unreadable)?;
        found.set_item("without_pose", statistics.without_pose)?;
        found.set_item("fps", statistics.fps())?;
        let latency = statistics.latency();
        for (name, value) in [("p50", latency.p50), ("p95", latency.p95), ("p99", latency.p99)] {
            found.set_item(format!("latency_{name}_s"), value.as_secs_f64())?;
        }
        found.set_item("engine", statistics.engine.name())?;
        Ok(Some(found))
    }

    /// Ends the stream and waits until its source is closed.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.frames.stop();
        // Threads do not survive a fork: in another process there is nothing to wait for.
        while self.process == std::process::id() && !self.frames.has_ended() {
            py.check_signals()?;
            py.detach(|| std::thread::sleep(PATIENCE / 10));
        }
        Ok(())
    }
}

/// Reads the poses of a moving camera from a file, or from a topic of the recording `source`. Returns `None` if neither
/// is given.
fn trajectory(
    source: &Path,
    topic: Option<&str>,
    file: Option<&Path>,
    pose_topic: Option<&PoseTopic>,
) -> Result<Option<Trajectory>, planish::Error> {
    let options = ReadOptions::default();
    match (file, pose_topic) {
        (Some(file), _) => Ok(Some(read_trajectory_with(file, &options)?)),
        (None, Some(poses)) => Ok(Some(camera_trajectory(&file_of(source)?, topic, poses, &options)?)),
        (None, None) => Ok(None),
    }
}

impl PyStream {
    /// Returns an error if this is not the process that opened the stream, since threads do not survive a fork.
    fn check_process(&self) -> PyResult<()> {
        if self.process == std::process::id() {
            return Ok(());
        }
        Err(PyRuntimeError::new_err("this stream was opened by another process; open a new stream in this process"))
    }
}
