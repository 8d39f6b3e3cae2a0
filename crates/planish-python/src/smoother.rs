//! An open engine, as Python holds it: opened with the first frame, and again where frames change.

use std::sync::{Mutex, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use planish::{
    Camera, Engine, Error, Frame, OrganizedCloud, Outputs, Progress, SensorPose, SmoothParams, Smoothed, SmoothedMut,
    SmoothedView, Smoother, Status,
};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{Buffers, Input, Slices};
use crate::camera::PyCamera;
use crate::errors::{frame, to_py};
use crate::settings::Settings;

/// Frames of a batch between two looks at Python's signals.
const FRAMES_AT_ONCE: usize = 256;
/// Between two looks at Python's signals while a large cloud is smoothed.
const PATIENCE: Duration = Duration::from_millis(50);
/// Results that wait to be copied; each keeps its memory on the device.
const VIEWS_WAITING: usize = 2;

/// What the open engine is for.
#[derive(Clone, Copy, PartialEq)]
struct Opened {
    grid: Option<(usize, usize)>,
    outputs: Outputs,
    params: SmoothParams,
    engine: Engine,
}

/// What frames of one source have in common.
#[derive(Clone, Copy, PartialEq)]
struct Source {
    grid: Option<(usize, usize)>,
    camera: Option<Camera>,
    pose: Option<SensorPose>,
}

impl Source {
    fn of(frame: Frame<'_>) -> Self {
        let pose = match frame {
            Frame::Points(points) => Some(points.pose()),
            _ => None,
        };
        Self { grid: frame.grid(), camera: frame.camera().copied(), pose }
    }
}

struct State {
    settings: Settings,
    open: Option<(Opened, Smoother)>,
    /// The parameters of the frames before, and what those were: grid, camera and sensor's pose.
    adapted: Option<(Source, SmoothParams)>,
    /// The engine in place of the one asked for, where that has failed with a cloud.
    instead: Option<Engine>,
    status: Vec<Status>,
    /// The process that has opened the engine: threads do not survive a fork.
    process: u32,
}

#[pyclass(frozen, name = "Engine", module = "planish._planish")]
pub struct PySmoother(Mutex<State>);

/// The camera, the sensor's pose and the origin of coordinates of a frame, as far as they are known.
type Place<'py> = (Option<PyRef<'py, PyCamera>>, Option<[f64; 7]>, Option<[f64; 3]>);

/// What makes a frame.
struct Given<'py> {
    input: Input<'py>,
    camera: Option<Camera>,
    pose: Option<[f64; 7]>,
    origin_m: Option<[f64; 3]>,
}

impl<'py> Given<'py> {
    fn new(array: &Bound<'py, PyAny>, is_depth: bool, (camera, pose, origin_m): Place<'py>) -> PyResult<Self> {
        let camera = camera.map(|camera| camera.0);
        Ok(Self { input: Input::new(array, is_depth)?, camera, pose, origin_m })
    }

    fn frame(&self) -> PyResult<Frame<'_>> {
        self.input.frame(self.camera.as_ref(), self.pose, self.origin_m)
    }
}

impl State {
    /// Refuses what would mix with frames in flight.
    fn check_idle(&self) -> PyResult<()> {
        match &self.open {
            Some((_, smoother)) if smoother.in_flight() > 0 => {
                let text = format!("{} frames are in flight: receive them first", smoother.in_flight());
                Err(PyRuntimeError::new_err(text))
            }
            _ => Ok(()),
        }
    }

    /// The parameters for a frame. A camera keeps its resolution; a sensor is estimated from every frame.
    fn params(&mut self, frame: Frame<'_>) -> PyResult<SmoothParams> {
        let source = Source::of(frame);
        if self.settings.needs_estimate() {
            return self.settings.params_for(frame, organized(frame)?.as_ref());
        }
        // Of points without a camera it has to be measured.
        if frame.grid().is_some() && source.camera.is_none() {
            return self.settings.params_for(frame, None);
        }
        match self.adapted {
            Some((adapted, params)) if adapted == source => Ok(params),
            _ => {
                let params = self.settings.params_for(frame, None)?;
                self.adapted = Some((source, params));
                Ok(params)
            }
        }
    }

    /// The smoother for a frame; opens one if the last was for others.
    fn smoother(&mut self, frame: Frame<'_>, outputs: Outputs) -> PyResult<&mut Smoother> {
        if self.process != std::process::id() {
            // Its threads are not there to be waited for.
            std::mem::forget(self.open.take());
            self.process = std::process::id();
        }
        let params = self.params(frame)?;
        let engine = self.instead.filter(|_| frame.grid().is_none()).unwrap_or(self.settings.engine());
        let wanted = Opened { grid: frame.grid(), outputs, params, engine };
        if self.open.as_ref().is_none_or(|(opened, _)| *opened != wanted) {
            self.check_idle()?;
            self.open = None;
            let options = self.settings.options(outputs).with_engine(engine);
            let smoother = Smoother::open_with(params, &options, wanted.grid).map_err(to_py)?;
            self.open = Some((wanted, smoother));
        }
        match &mut self.open {
            Some((_, smoother)) => Ok(smoother),
            None => Err(PyRuntimeError::new_err("no engine is open")),
        }
    }

    /// Smooths a frame; where `auto` chose a GPU that a general cloud is too large for, on the CPU, and says why.
    fn smooth(
        &mut self,
        py: Python<'_>,
        frame: Frame<'_>,
        outputs: Outputs,
        out: &mut Slices<'_>,
    ) -> PyResult<Option<String>> {
        let mut status = std::mem::take(&mut self.status);
        let mut said = None;
        loop {
            let smoother = self.smoother(frame, outputs)?;
            let out = out.smoothed_mut(&mut status);
            let result = match smoother.progress().filter(|_| frame.grid().is_none()) {
                None => py.detach(|| smoother.smooth_into(frame, out)),
                Some(progress) => {
                    let (result, interrupted) = py.detach(|| interruptible(smoother, frame, out, &progress));
                    if let Some(interrupted) = interrupted {
                        return Err(interrupted);
                    }
                    result
                }
            };
            match result {
                Err(Error::Engine(error))
                    if error.is_too_large()
                        && self.settings.engine() == Engine::Auto
                        && self.instead.is_none()
                        && frame.grid().is_none() =>
                {
                    (self.instead, said) = (Some(Engine::Cpu), Some(error.to_string()));
                }
                Err(error) => {
                    // An engine that failed is no use for the next frame.
                    self.open = None;
                    return Err(to_py(error));
                }
                Ok(()) => break,
            }
        }
        out.store_status(&status);
        self.status = status;
        Ok(said)
    }
}

/// Smooths on another thread, and looks at Python's signals meanwhile: an exception that one of them raises stops the work, and comes
/// with its result.
fn interruptible(
    smoother: &mut Smoother,
    frame: Frame<'_>,
    out: SmoothedMut<'_>,
    progress: &Progress,
) -> (Result<(), Error>, Option<PyErr>) {
    let this = thread::current();
    thread::scope(|scope| {
        let work = scope.spawn(move || {
            let result = smoother.smooth_into(frame, out);
            this.unpark();
            result
        });
        let mut interrupted = None;
        while !work.is_finished() {
            thread::park_timeout(PATIENCE);
            if !work.is_finished() && interrupted.is_none() {
                interrupted = Python::attach(|py| py.check_signals()).err();
                interrupted.iter().for_each(|_| progress.stop());
            }
        }
        (work.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)), interrupted)
    })
}

/// What a sensor is estimated from.
fn organized(of: Frame<'_>) -> PyResult<Option<OrganizedCloud>> {
    match of {
        Frame::Depth(depth) => depth.deproject().map(Some).map_err(frame),
        Frame::Points(points) => {
            let Some((width, height)) = points.grid() else { return Ok(None) };
            let positions = (0..points.len()).map(|i| points.get(i).map(|value| value as f32)).collect();
            OrganizedCloud::from_positions(width, height, positions).map(Some).map_err(frame)
        }
        _ => Ok(None),
    }
}

#[pymethods]
impl PySmoother {
    #[new]
    fn new(settings: &Bound<'_, PyDict>) -> PyResult<Self> {
        let settings = Settings::from_dict(settings)?;
        Ok(Self(Mutex::new(State {
            settings,
            open: None,
            adapted: None,
            instead: None,
            status: Vec::new(),
            process: std::process::id(),
        })))
    }

    /// Smooths a frame into arrays; returns what is to be said of it.
    fn smooth<'py>(
        &self,
        py: Python<'py>,
        array: &Bound<'py, PyAny>,
        is_depth: bool,
        place: Place<'py>,
        out: &Bound<'_, PyDict>,
    ) -> PyResult<Option<String>> {
        let mut buffers = Buffers::new(out)?;
        let outputs = buffers.outputs();
        let given = Given::new(array, is_depth, place)?;
        let frame = given.frame()?;
        let mut slices = buffers.slices()?;
        let mut state = self.lock()?;
        state.check_idle()?;
        state.smooth(py, frame, outputs, &mut slices)
    }

    /// Hands a frame over; its result is received later. `outputs` has arrays of any size for the outputs that are wanted.
    fn submit<'py>(
        &self,
        py: Python<'py>,
        array: &Bound<'py, PyAny>,
        is_depth: bool,
        place: Place<'py>,
        outputs: &Bound<'_, PyDict>,
    ) -> PyResult<()> {
        let outputs = Buffers::new(outputs)?.outputs();
        let given = Given::new(array, is_depth, place)?;
        let frame = given.frame()?;
        let mut state = self.lock()?;
        let smoother = state.smoother(frame, outputs)?;
        py.detach(|| smoother.submit_in_place(frame)).map_err(to_py)
    }

    /// Waits for the first frame in flight, and writes its result into arrays; false if none is in flight.
    fn receive(&self, py: Python<'_>, out: &Bound<'_, PyDict>) -> PyResult<bool> {
        let mut buffers = Buffers::new(out)?;
        let mut slices = buffers.slices()?;
        let mut state = self.lock()?;
        let Some((_, smoother)) = &mut state.open else { return Ok(false) };
        let received = py.detach(|| match smoother.receive()? {
            Some(view) => copy(view, &mut slices).map(|()| true),
            None => Ok(false),
        });
        if received.is_err() {
            state.open = None;
        }
        received.map_err(to_py)
    }

    /// How many frames are in flight, and how many may be.
    fn in_flight(&self) -> PyResult<(usize, usize)> {
        let state = self.lock()?;
        Ok(state.open.as_ref().map_or((0, 1), |(_, smoother)| (smoother.in_flight(), smoother.max_in_flight())))
    }

    /// Smooths frames of one kind, each into arrays of its own, as many at once as the engine takes.
    fn smooth_batch(
        &self,
        py: Python<'_>,
        arrays: Vec<Bound<'_, PyAny>>,
        is_depth: bool,
        camera: Option<PyRef<'_, PyCamera>>,
        outs: Vec<Bound<'_, PyDict>>,
    ) -> PyResult<()> {
        if arrays.len() != outs.len() {
            return Err(PyValueError::new_err("as many outputs as frames are expected"));
        }
        let camera: Option<Camera> = camera.map(|camera| camera.0);
        let mut state = self.lock()?;
        state.check_idle()?;
        for (arrays, outs) in arrays.chunks(FRAMES_AT_ONCE).zip(outs.chunks(FRAMES_AT_ONCE)) {
            py.check_signals()?;
            let inputs = arrays.iter().map(|array| Input::new(array, is_depth)).collect::<PyResult<Vec<_>>>()?;
            let frames =
                inputs.iter().map(|input| input.frame(camera.as_ref(), None, None)).collect::<PyResult<Vec<_>>>()?;
            let mut buffers = outs.iter().map(Buffers::new).collect::<PyResult<Vec<_>>>()?;
            let outputs = buffers.first().map_or(Outputs::POINTS, Buffers::outputs);
            let mut slices = buffers.iter_mut().map(Buffers::slices).collect::<PyResult<Vec<_>>>()?;
            let Some(&first) = frames.first() else { return Ok(()) };
            let smoother = state.smoother(first, outputs)?;
            if !smoother.capabilities().pipelined {
                for (frame, slices) in frames.iter().zip(&mut slices) {
                    py.check_signals()?;
                    state.smooth(py, *frame, outputs, slices)?;
                }
                continue;
            }
            let result = py.detach(|| pipelined(smoother, &frames, &mut slices));
            if result.is_err() {
                state.open = None;
            }
            result.map_err(to_py)?;
        }
        Ok(())
    }

    /// Milliseconds of so many runs of the library's own call on a frame, into buffers of its own: what Python's is held against.
    fn time_library<'py>(
        &self,
        py: Python<'py>,
        array: &Bound<'py, PyAny>,
        is_depth: bool,
        place: Place<'py>,
        outputs: &Bound<'_, PyDict>,
        runs: usize,
    ) -> PyResult<Vec<f64>> {
        let outputs = Buffers::new(outputs)?.outputs();
        let given = Given::new(array, is_depth, place)?;
        let frame = given.frame()?;
        let mut state = self.lock()?;
        state.check_idle()?;
        let smoother = state.smoother(frame, outputs)?;
        let times = py.detach(|| {
            let mut smoothed = Smoothed::default();
            smoother.smooth(frame, &mut smoothed)?;
            let run = |_| {
                let start = Instant::now();
                smoother.smooth(frame, &mut smoothed)?;
                Ok(1e3 * start.elapsed().as_secs_f64())
            };
            (0..runs).map(run).collect::<Result<Vec<_>, Error>>()
        });
        times.map_err(to_py)
    }

    /// The engine that is open, its GPU, and why it was chosen.
    fn opened(&self) -> PyResult<(Option<&'static str>, Option<String>, Option<String>)> {
        let state = self.lock()?;
        let Some((_, smoother)) = &state.open else { return Ok((None, None, None)) };
        let because = smoother.chosen_because().map(ToString::to_string);
        Ok((Some(smoother.engine().name()), smoother.gpu_name().map(str::to_owned), because))
    }

    /// Closes the engine and gives its memory back.
    fn close(&self) -> PyResult<()> {
        self.lock()?.open = None;
        Ok(())
    }
}

impl PySmoother {
    fn lock(&self) -> PyResult<std::sync::MutexGuard<'_, State>> {
        // Waiting could be for ever: the other thread may be waiting for Python's lock.
        self.0.try_lock().map_err(|_| {
            PyRuntimeError::new_err("this Smoother is in use by another thread: open one Smoother for each thread")
        })
    }
}

/// Frames in flight, results in the order of the frames. A thread of its own copies them, while this one hands frames over.
fn pipelined(smoother: &mut Smoother, frames: &[Frame<'_>], slices: &mut [Slices<'_>]) -> Result<(), Error> {
    thread::scope(|scope| {
        let (sender, receiver) = mpsc::sync_channel::<(SmoothedView, &mut Slices<'_>)>(VIEWS_WAITING);
        let copier = scope.spawn(move || receiver.into_iter().try_for_each(|(view, out)| copy(view, out)));
        let mut outs = slices.iter_mut();
        let mut receive = |smoother: &mut Smoother| -> Result<(), Error> {
            if let (Some(view), Some(out)) = (smoother.receive()?, outs.next()) {
                // It fails only if the copier has ended with an error, which comes below.
                let _ = sender.send((view, out));
            }
            Ok(())
        };
        let handed_over = frames.iter().try_for_each(|&frame| {
            if smoother.in_flight() == smoother.max_in_flight() {
                receive(smoother)?;
            }
            smoother.submit_in_place(frame)
        });
        let received = handed_over.and_then(|()| {
            while smoother.in_flight() > 0 {
                receive(smoother)?;
            }
            Ok(())
        });
        drop(sender);
        let copied = copier.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        received.and(copied)
    })
}

/// Copies a result into the caller's arrays.
fn copy(view: SmoothedView, out: &mut Slices<'_>) -> Result<(), Error> {
    for (from, to) in [(view.points(), &mut out.points), (view.normals(), &mut out.normals)] {
        if let (Some([x, y, z]), Some(to)) = (from, to) {
            check_len(to.len(), x.len())?;
            to.iter_mut().zip(x.iter().zip(y).zip(z)).for_each(|(to, ((&x, &y), &z))| *to = [x, y, z]);
        }
    }
    for (from, to) in [(view.curvature(), &mut out.curvature), (view.depth_m(), &mut out.depth_m)] {
        if let (Some(from), Some(to)) = (from, to) {
            check_len(to.len(), from.len())?;
            to.copy_from_slice(from);
        }
    }
    if let (Some(rows), Some(to)) = (view.depth_rows(), &mut out.depth) {
        let (width, height) = view.shape();
        check_len(to.len(), width * height)?;
        to.chunks_exact_mut(width).zip(rows).for_each(|(to, row)| to.copy_from_slice(row));
    }
    if let (Some(status), Some(to)) = (view.status(), &out.status) {
        check_len(to.len(), status.len())?;
        out.store_status(&status);
    }
    if let Some(to) = &mut out.neighbours {
        // Not part of results in place.
        let neighbours = view.into_smoothed().neighbours.unwrap_or_default();
        check_len(to.len(), neighbours.len())?;
        to.copy_from_slice(&neighbours);
    }
    Ok(())
}

fn check_len(len: usize, expected: usize) -> Result<(), Error> {
    match len {
        len if len == expected => Ok(()),
        len => Err(planish::FrameError::LengthMismatch { what: "an output array".to_owned(), len, expected }.into()),
    }
}
