//! A running stream, as Python iterates over it: the library's own, with a sink that hands results over.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use numpy::{PyArray1, PyArrayMethods};
use planish::source::{self, Alignment, OwnedFrame, SourceOptions, StreamMode};
use planish::stream::{self, Sink, StreamEvent, StreamFrame, StreamOptions, StreamStatistics};
use planish::{Error, Outputs, Xyz};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::camera::PyCamera;
use crate::errors::to_py;
use crate::settings::from_dict;

/// Results that wait to be taken, of a source that is not live.
const WAITING: usize = 2;
/// Between two looks at Python's signals.
const PATIENCE: Duration = Duration::from_millis(50);

/// Warnings that wait to be told.
const MOST_WARNINGS: usize = 100;

/// A frame with its result, in rows as Python has them.
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
}

/// A frame as it was measured.
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

/// What the stream's threads and Python share.
#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Delivered>,
    /// Results of a live source that a newer one replaced before they were taken.
    replaced: u64,
    warnings: Vec<String>,
    has_ended: bool,
    /// What the stream came to, or why it ended.
    statistics: Option<StreamStatistics>,
    error: Option<Error>,
}

impl Shared {
    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next result, once there is one or the stream has ended; `None` if neither is so for a while.
    fn take(&self) -> Option<Option<Delivered>> {
        let mut state = self.lock();
        let until = Instant::now() + PATIENCE;
        loop {
            if let Some(delivered) = state.waiting.pop_front() {
                self.changed.notify_all();
                return Some(Some(delivered));
            }
            if state.has_ended {
                return Some(None);
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return None;
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// Hands results over: of a live source the newest, of any other all.
struct Handover {
    shared: Arc<Shared>,
    is_live: bool,
}

impl Sink for Handover {
    fn name(&self) -> String {
        "Python".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let delivered = Delivered::of(frame);
        let mut state = self.shared.lock();
        if self.is_live {
            state.replaced += state.waiting.len() as u64;
            state.waiting.clear();
        }
        while state.waiting.len() >= WAITING && !self.shared.stop.load(Ordering::Relaxed) {
            state = self.shared.changed.wait_timeout(state, PATIENCE).unwrap_or_else(PoisonError::into_inner).0;
        }
        state.waiting.push_back(delivered);
        self.shared.changed.notify_all();
        Ok(())
    }
}

fn alignment_of(name: &str) -> PyResult<Alignment> {
    match name {
        "depth" => Ok(Alignment::Depth),
        "color" => Ok(Alignment::Color),
        "none" => Ok(Alignment::None),
        name => Err(PyValueError::new_err(format!("align: {name:?} is not allowed: depth, color or none"))),
    }
}

#[pyclass(frozen, name = "Stream", module = "planish._planish")]
pub struct PyStream {
    shared: Arc<Shared>,
    is_live: bool,
    thread: Mutex<Option<JoinHandle<()>>>,
    /// The process that has opened it.
    process: u32,
}

#[pymethods]
impl PyStream {
    /// Opens a source and begins.
    #[new]
    #[pyo3(signature = (source, outputs, settings, camera, fps, frames, depth_units_per_metre, align, mode))]
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
    ) -> PyResult<Self> {
        let mut settings = from_dict(settings)?;
        let outputs =
            outputs.iter().try_fold(Outputs::POINTS.with_points(false), |outputs, name| match name.as_str() {
                "points" => Ok(outputs.with_points(true)),
                "normals" => Ok(outputs.with_normals(true)),
                "curvature" => Ok(outputs.with_curvature(true)),
                "status" => Ok(outputs.with_status(true)),
                "neighbours" => Ok(outputs.with_neighbours(true)),
                "depth" => Ok(outputs.with_depth(true)),
                "depth_m" => Ok(outputs.with_depth_m(true)),
                name => Err(PyValueError::new_err(format!("outputs: {name:?} is not allowed"))),
            })?;
        let source_options = SourceOptions::default()
            .with_camera(camera.map(|camera| camera.0))
            .with_tum_units_per_metre(depth_units_per_metre)
            .with_alignment(align.map(alignment_of).transpose()?)
            .with_mode(mode.map(str::parse::<StreamMode>).transpose().map_err(to_py)?)
            .with_fps(fps);
        let source = py.detach(|| source::open(source, &source_options)).map_err(to_py)?;
        let is_live = source.is_live();
        settings.outputs = Some(outputs);
        let options = StreamOptions::from_settings(settings).map_err(to_py)?.with_max_frames(frames);
        let shared = Arc::new(Shared::default());
        let sink = Handover { shared: Arc::clone(&shared), is_live };
        let work = {
            let shared = Arc::clone(&shared);
            move || {
                let tell = |event: StreamEvent<'_>| {
                    if let StreamEvent::Warning(text) = event {
                        let mut state = shared.lock();
                        // A file that is repeated may have the same fault for ever.
                        if state.warnings.len() < MOST_WARNINGS && !state.warnings.contains(&text) {
                            state.warnings.push(text);
                        }
                    }
                };
                let result = stream::run(source, &options, vec![Box::new(sink)], &shared.stop, tell);
                let mut state = shared.lock();
                state.has_ended = true;
                match result {
                    Ok(statistics) => state.statistics = Some(statistics),
                    Err(error) => state.error = Some(error),
                }
                shared.changed.notify_all();
            }
        };
        let failed = |error: std::io::Error| PyRuntimeError::new_err(format!("could not start a thread: {error}"));
        let thread = std::thread::Builder::new().name("planish-stream".into()).spawn(work).map_err(failed)?;
        Ok(Self { shared, is_live, thread: Mutex::new(Some(thread)), process: std::process::id() })
    }

    /// The next frame with its result, if there is one soon; what is to be warned of; and whether that is the end.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<(Option<Bound<'py, PyDict>>, Vec<String>, bool)> {
        self.check_process()?;
        py.check_signals()?;
        let taken = py.detach(|| self.shared.take());
        let mut state = self.shared.lock();
        let warnings = std::mem::take(&mut state.warnings);
        let has_ended = matches!(taken, Some(None));
        let delivered = taken.flatten();
        if has_ended && let Some(error) = state.error.take() {
            return Err(to_py(error));
        }
        drop(state);
        Ok((delivered.map(|delivered| delivered.into_dict(py)).transpose()?, warnings, has_ended))
    }

    /// Whether the source is a camera, or plays like one.
    fn is_live(&self) -> bool {
        self.is_live
    }

    /// What the stream came to; `None` while it runs.
    fn statistics<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let state = self.shared.lock();
        let Some(statistics) = &state.statistics else { return Ok(None) };
        let found = PyDict::new(py);
        found.set_item("frames_in", statistics.frames_in)?;
        found.set_item("frames_out", statistics.frames_out)?;
        found.set_item("dropped", statistics.dropped + statistics.dropped_by_sinks + state.replaced)?;
        found.set_item("unreadable", statistics.unreadable)?;
        found.set_item("fps", statistics.fps())?;
        let latency = statistics.latency();
        for (name, value) in [("p50", latency.p50), ("p95", latency.p95), ("p99", latency.p99)] {
            found.set_item(format!("latency_{name}_s"), value.as_secs_f64())?;
        }
        found.set_item("engine", statistics.engine.name())?;
        Ok(Some(found))
    }

    /// Ends the stream and waits for its threads.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let is_running = |thread: &Option<JoinHandle<()>>| thread.as_ref().is_some_and(|thread| !thread.is_finished());
        if self.process != std::process::id() {
            // Its threads are not there to be waited for.
            std::mem::forget(self.thread.lock().unwrap_or_else(PoisonError::into_inner).take());
            return Ok(());
        }
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
        while is_running(&self.thread.lock().unwrap_or_else(PoisonError::into_inner)) {
            py.check_signals()?;
            py.detach(|| std::thread::sleep(PATIENCE / 10));
        }
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        // A panic of the library's is in nobody's hands here.
        py.detach(|| thread.map(JoinHandle::join));
        self.shared.lock().waiting.clear();
        Ok(())
    }
}

impl PyStream {
    /// Threads do not survive a fork.
    fn check_process(&self) -> PyResult<()> {
        if self.process == std::process::id() {
            return Ok(());
        }
        Err(PyRuntimeError::new_err("this stream was opened by another process: open one here"))
    }
}

impl Drop for PyStream {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
    }
}
