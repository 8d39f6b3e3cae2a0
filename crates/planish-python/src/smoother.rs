//! The Python class that wraps a session.

use std::sync::{Mutex, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use planish::{
    Camera, Error, Frame, Outputs, SensorPose, Session, Settings, Smoothed, SmoothedMut, SmoothedView, Status,
};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{Buffers, Input, Slices};
use crate::camera::PyCamera;
use crate::errors::to_py;
use crate::settings::from_dict;

/// Number of batch frames between two checks for Python's signals.
const FRAMES_AT_ONCE: usize = 256;
/// Interval between checks for Python's signals while an unorganized cloud is smoothed.
const PATIENCE: Duration = Duration::from_millis(50);
/// Maximum number of results that wait to be copied; each keeps its memory on the device.
const VIEWS_WAITING: usize = 2;

struct State {
    session: Session,
    status: Vec<Status>,
}

#[pyclass(frozen, name = "Engine", module = "planish._planish")]
pub struct PySmoother(Mutex<State>);

/// Camera, sensor pose and origin of a frame, and the camera's pose in the world, if known.
type Place<'py> = (Option<PyRef<'py, PyCamera>>, Option<[f64; 7]>, Option<[f64; 3]>, Option<[f64; 7]>);

/// The choices for a cloud (neighbours, edges, passes and noise in metres), and height and width of its rebuilt grid.
type ChosenForCloud = (Option<(u32, &'static str, u32, Option<f32>)>, Option<(usize, usize)>);

/// An input array, and the camera, poses and origin that turn it into a frame.
struct Given<'py> {
    input: Input<'py>,
    camera: Option<Camera>,
    pose: Option<[f64; 7]>,
    origin_m: Option<[f64; 3]>,
    camera_pose: Option<[f64; 7]>,
}

impl<'py> Given<'py> {
    fn new(array: &Bound<'py, PyAny>, is_depth: bool, place: Place<'py>) -> PyResult<Self> {
        let (camera, pose, origin_m, camera_pose) = place;
        let camera = camera.map(|camera| camera.0);
        Ok(Self { input: Input::new(array, is_depth)?, camera, pose, origin_m, camera_pose })
    }

    /// Sets the pose of the camera in the world for the session's next frame.
    fn set_camera_pose(&self, session: &mut Session) -> PyResult<()> {
        session.set_camera_pose(self.camera_pose.map(SensorPose::from_viewpoint)).map_err(to_py)
    }

    fn frame(&self) -> PyResult<Frame<'_>> {
        self.input.frame(self.camera.as_ref(), self.pose, self.origin_m)
    }
}

impl State {
    /// Smooths a frame; returns the faults that the session reports, as text.
    fn smooth(
        &mut self,
        py: Python<'_>,
        frame: Frame<'_>,
        outputs: Outputs,
        out: &mut Slices<'_>,
    ) -> PyResult<Vec<String>> {
        self.session.set_outputs(outputs);
        let mut status = std::mem::take(&mut self.status);
        let result = {
            let (session, out) = (&mut self.session, out.smoothed_mut(&mut status));
            // A frame on a grid is finished before signals would be checked.
            if frame.grid().is_some() {
                py.detach(|| session.smooth_into(frame, out))
            } else {
                let (result, interrupted) = py.detach(|| interruptible(session, frame, out));
                if let Some(interrupted) = interrupted {
                    return Err(interrupted);
                }
                result
            }
        };
        result.map_err(to_py)?;
        out.store_status(status.iter().copied());
        self.status = status;
        Ok(self.take_faults())
    }

    /// Removes the session's events and returns the faults among them, which Python reports as warnings.
    fn take_faults(&mut self) -> Vec<String> {
        self.session.take_events().iter().filter(|event| event.is_fault()).map(ToString::to_string).collect()
    }

    /// Returns an error if frames are in flight.
    fn check_idle(&self) -> PyResult<()> {
        match self.session.in_flight() {
            0 => Ok(()),
            in_flight => Err(PyRuntimeError::new_err(format!("{in_flight} frames are in flight; receive them first"))),
        }
    }
}

/// Smooths on another thread, while this one checks for Python's signals. An exception raised by a signal stops the
/// work and is returned with its result.
fn interruptible(session: &mut Session, frame: Frame<'_>, out: SmoothedMut<'_>) -> (Result<(), Error>, Option<PyErr>) {
    let (this, watch) = (thread::current(), session.watch());
    thread::scope(|scope| {
        let work = scope.spawn(move || {
            let result = session.smooth_into(frame, out);
            this.unpark();
            result
        });
        let mut interrupted = None;
        while !work.is_finished() {
            thread::park_timeout(PATIENCE);
            if !work.is_finished() && interrupted.is_none() {
                interrupted = Python::attach(|py| py.check_signals()).err();
                interrupted.iter().for_each(|_| watch.stop());
            }
        }
        (work.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)), interrupted)
    })
}

#[pymethods]
impl PySmoother {
    #[new]
    fn new(settings: &Bound<'_, PyDict>, is_single: bool) -> PyResult<Self> {
        let session = Session::new(from_dict(settings)?).map_err(to_py)?.with_single_frame(is_single);
        Ok(Self(Mutex::new(State { session, status: Vec::new() })))
    }

    fn restart_video(&self) -> PyResult<()> {
        self.lock()?.session.restart_video();
        Ok(())
    }

    /// Returns the pose of the camera at the last frame, relative to its pose at the frame before: x, y, z, qw, qx, qy,
    /// qz. `None` if the motion is unknown.
    fn camera_motion(&self) -> PyResult<Option<[f64; 7]>> {
        let motion = self.lock()?.session.camera_motion();
        Ok(motion.map(|motion| motion.previous_from_current.viewpoint()))
    }

    /// Returns the names of the given settings that have no effect on points without a grid.
    fn unused_by_clouds(&self) -> PyResult<Vec<&'static str>> {
        Ok(self.lock()?.session.settings().map(Settings::unused_by_clouds).unwrap_or_default())
    }

    /// Smooths a frame into arrays; returns warnings.
    fn smooth<'py>(
        &self,
        py: Python<'py>,
        array: &Bound<'py, PyAny>,
        is_depth: bool,
        place: Place<'py>,
        out: &Bound<'_, PyDict>,
    ) -> PyResult<Vec<String>> {
        let mut buffers = Buffers::new(out)?;
        let outputs = buffers.outputs();
        let given = Given::new(array, is_depth, place)?;
        let frame = given.frame()?;
        let mut slices = buffers.slices()?;
        let mut state = self.lock()?;
        state.check_idle()?;
        given.set_camera_pose(&mut state.session)?;
        state.smooth(py, frame, outputs, &mut slices)
    }

    /// Submits a frame, whose result is received later. `outputs` has an array of any size for each requested output.
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
        let session = &mut state.session;
        session.set_outputs(outputs);
        given.set_camera_pose(session)?;
        py.detach(|| session.submit_in_place(frame)).map_err(to_py)
    }

    /// Waits for the oldest frame in flight and writes its result into arrays; returns false if no frame is in
    /// flight.
    fn receive(&self, py: Python<'_>, out: &Bound<'_, PyDict>) -> PyResult<bool> {
        let mut buffers = Buffers::new(out)?;
        let mut slices = buffers.slices()?;
        let mut state = self.lock()?;
        let session = &mut state.session;
        let received = py.detach(|| match session.receive()? {
            Some(view) => copy(&view, &mut slices).map(|()| true),
            None => Ok(false),
        });
        if received.is_err() {
            state.session.close();
        }
        received.map_err(to_py)
    }

    /// Returns the number of frames in flight, and its maximum.
    fn in_flight(&self) -> PyResult<(usize, usize)> {
        let state = self.lock()?;
        Ok((state.session.in_flight(), state.session.max_in_flight()))
    }

    /// Smooths frames of one kind, each into its own arrays, with several frames in flight if the engine supports
    /// this. Returns warnings.
    fn smooth_batch(
        &self,
        py: Python<'_>,
        arrays: Vec<Bound<'_, PyAny>>,
        is_depth: bool,
        camera: Option<PyRef<'_, PyCamera>>,
        outs: Vec<Bound<'_, PyDict>>,
    ) -> PyResult<Vec<String>> {
        if arrays.len() != outs.len() {
            return Err(PyValueError::new_err(
                "the number of outputs differs from the number of frames; expected one output per frame",
            ));
        }
        let camera: Option<Camera> = camera.map(|camera| camera.0);
        let mut state = self.lock()?;
        state.session.set_camera_pose(None).map_err(to_py)?;
        state.check_idle()?;
        let mut warnings = Vec::new();
        for (arrays, outs) in arrays.chunks(FRAMES_AT_ONCE).zip(outs.chunks(FRAMES_AT_ONCE)) {
            py.check_signals()?;
            let inputs = arrays.iter().map(|array| Input::new(array, is_depth)).collect::<PyResult<Vec<_>>>()?;
            let frames =
                inputs.iter().map(|input| input.frame(camera.as_ref(), None, None)).collect::<PyResult<Vec<_>>>()?;
            let mut buffers = outs.iter().map(Buffers::new).collect::<PyResult<Vec<_>>>()?;
            let outputs = buffers.first().map_or(Outputs::POINTS, Buffers::outputs);
            let mut slices = buffers.iter_mut().map(Buffers::slices).collect::<PyResult<Vec<_>>>()?;
            let Some(&first) = frames.first() else { return Ok(warnings) };
            state.session.set_outputs(outputs);
            state.session.prepare(first).map_err(to_py)?;
            let is_pipelined = state.session.engine().is_some_and(|engine| engine.capabilities().pipelined);
            let is_finished = |frame: &Frame<'_>| state.session.can_submit_in_place(*frame).is_ok_and(|can| can);
            let is_pipelined = is_pipelined && frames.iter().all(is_finished);
            // planish chooses the number of neighbours for each unorganized cloud, so clouds are smoothed one by one.
            if !is_pipelined || first.grid().is_none() {
                for (frame, slices) in frames.iter().zip(&mut slices) {
                    py.check_signals()?;
                    warnings.extend(state.smooth(py, *frame, outputs, slices)?);
                }
                continue;
            }
            let session = &mut state.session;
            let result = py.detach(|| pipelined(session, &frames, &mut slices));
            if result.is_err() {
                state.session.close();
            }
            result.map_err(to_py)?;
            warnings.extend(state.take_faults());
        }
        // The frames of a batch mostly cause the same warnings.
        warnings.sort_unstable();
        warnings.dedup();
        Ok(warnings)
    }

    /// Returns the times in milliseconds of repeated direct calls to the library, into internal buffers, for comparison
    /// with the Python call.
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
        let session = &mut state.session;
        session.set_outputs(outputs);
        let times = py.detach(|| {
            let mut smoothed = Smoothed::default();
            session.smooth(frame, &mut smoothed)?;
            let run = |_| {
                let start = Instant::now();
                session.smooth(frame, &mut smoothed)?;
                Ok(1e3 * start.elapsed().as_secs_f64())
            };
            (0..runs).map(run).collect::<Result<Vec<_>, Error>>()
        });
        times.map_err(to_py)
    }

    /// Returns the open engine, its GPU, and the reason for the choice.
    fn opened(&self) -> PyResult<(Option<&'static str>, Option<String>, Option<String>)> {
        let state = self.lock()?;
        let session = &state.session;
        let because = session.chosen_because().map(ToString::to_string);
        Ok((session.engine().map(planish::Engine::name), session.gpu_name().map(str::to_owned), because))
    }

    /// Returns the parameters that planish chose for the last unorganized cloud, and the height and width of its
    /// rebuilt grid. `None` stands for parameters that were not chosen or a grid that was not rebuilt.
    fn chosen_for_cloud(&self) -> PyResult<ChosenForCloud> {
        let state = self.lock()?;
        let choice = state.session.cloud_choice();
        let choice = choice.map(|choice| (choice.neighbours, choice.edges.name(), choice.passes, choice.noise_m));
        Ok((choice, state.session.rebuilt_grid().map(|(width, height)| (height, width))))
    }

    /// Closes the engine and frees its memory.
    fn close(&self) -> PyResult<()> {
        self.lock()?.session.close();
        Ok(())
    }
}

impl PySmoother {
    fn lock(&self) -> PyResult<std::sync::MutexGuard<'_, State>> {
        // Waiting could deadlock: the other thread may be waiting for the interpreter.
        self.0.try_lock().map_err(|_| {
            PyRuntimeError::new_err("this Smoother is in use by another thread; open one Smoother per thread")
        })
    }
}

/// Smooths frames with several in flight; results have the order of the frames. A separate thread copies results
/// while the calling thread submits frames.
fn pipelined(session: &mut Session, frames: &[Frame<'_>], slices: &mut [Slices<'_>]) -> Result<(), Error> {
    thread::scope(|scope| {
        let (sender, receiver) = mpsc::sync_channel::<(SmoothedView, &mut Slices<'_>)>(VIEWS_WAITING);
        let copier = scope.spawn(move || receiver.into_iter().try_for_each(|(view, out)| copy(&view, out)));
        let mut outs = slices.iter_mut();
        let mut receive = |session: &mut Session| -> Result<(), Error> {
            if let (Some(view), Some(out)) = (session.receive()?, outs.next()) {
                // Sending fails only if the copier has ended with an error, which is returned below.
                let _ = sender.send((view, out));
            }
            Ok(())
        };
        let handed_over = frames.iter().try_for_each(|&frame| {
            if session.in_flight() == session.max_in_flight() {
                receive(session)?;
            }
            session.submit_in_place(frame)
        });
        let received = handed_over.and_then(|()| {
            while session.in_flight() > 0 {
                receive(session)?;
            }
            Ok(())
        });
        drop(sender);
        let copied = copier.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        received.and(copied)
    })
}

/// Copies a result into the caller's arrays.
fn copy(view: &SmoothedView, out: &mut Slices<'_>) -> Result<(), Error> {
    for (from, to) in [(view.points(), &mut out.points), (view.normals(), &mut out.normals)] {
        if let (Some([x, y, z]), Some(to)) = (from, to) {
            check_len(to.len(), x.len())?;
            to.iter_mut().zip(x.iter().zip(y).zip(z)).for_each(|(to, ((&x, &y), &z))| *to = [x, y, z]);
        }
    }
    let channels = [
        (view.curvature(), &mut out.curvature),
        (view.depth_m(), &mut out.depth_m),
        (view.frames(), &mut out.frames),
        (view.sigma(), &mut out.sigma),
    ];
    for (from, to) in channels {
        if let (Some(from), Some(to)) = (from, to) {
            check_len(to.len(), from.len())?;
            to.copy_from_slice(from);
        }
    }
    let (width, height) = view.shape();
    if let (Some(rows), Some(to)) = (view.depth_rows(), &mut out.depth) {
        check_len(to.len(), width * height)?;
        to.chunks_exact_mut(width).zip(rows).for_each(|(to, row)| to.copy_from_slice(row));
    }
    if let (Some(status), Some(to)) = (view.status(), &out.status) {
        check_len(to.len(), width * height)?;
        out.store_status(status);
    }
    if let (Some(neighbours), Some(to)) = (view.neighbours(), &mut out.neighbours) {
        check_len(to.len(), width * height)?;
        to.iter_mut().zip(neighbours).for_each(|(to, count)| *to = count);
    }
    Ok(())
}

fn check_len(len: usize, expected: usize) -> Result<(), Error> {
    match len {
        len if len == expected => Ok(()),
        len => Err(planish::FrameError::LengthMismatch { what: "an output array".to_owned(), len, expected }.into()),
    }
}
