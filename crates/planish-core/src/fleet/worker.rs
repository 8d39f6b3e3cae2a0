//! Worker threads, one per device, and the state that the threads of a fleet share.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use super::dealing::{self, Pace};
use super::member::{FleetMember, SharedFrame};
use crate::engines::Engine;
use crate::error::{EngineError, Error};
use crate::params::WindowSize;
use crate::smoothed::Smoothed;
use crate::smoother::Smoother;
use crate::view::SmoothedView;

/// A submitted frame.
pub(super) struct Job {
    number: u64,
    frame: Arc<dyn SharedFrame>,
    /// True if the result is copied out. Stored separately, because a lost device takes the buffer with it.
    is_copied: bool,
    buffer: Option<Smoothed>,
    /// The window size, if it depends on the resolution and a frame has determined it.
    size: Option<WindowSize>,
    since: Instant,
}

impl Job {
    pub(super) fn new(
        number: u64,
        frame: Arc<dyn SharedFrame>,
        buffer: Option<Smoothed>,
        size: Option<WindowSize>,
    ) -> Self {
        Self { number, frame, is_copied: buffer.is_some(), buffer, size, since: Instant::now() }
    }
}

pub(super) struct Shared {
    state: Mutex<State>,
    /// One condition variable per device, which signals that a frame is waiting for the device, or that its thread must
    /// end.
    given: Vec<Condvar>,
    /// Signals that a result is available.
    done: Condvar,
    /// Maximum number of frames in flight.
    window: usize,
}

struct State {
    devices: Vec<Device>,
    results: BTreeMap<u64, Result<SmoothedView, Error>>,
    is_closed: bool,
}

struct Device {
    name: String,
    engine: Engine,
    /// Frames queued for the device, oldest first.
    waiting: VecDeque<Job>,
    /// Frames that the device's thread has taken, oldest first.
    taken: VecDeque<Job>,
    pace: Pace,
    frames: u64,
    lost: Option<EngineError>,
}

impl Shared {
    pub(super) fn new(smoothers: &[Smoother], window: usize) -> Self {
        let device = |smoother: &Smoother| Device {
            name: smoother.gpu_name().unwrap_or(smoother.engine().name()).to_owned(),
            engine: smoother.engine(),
            waiting: VecDeque::new(),
            taken: VecDeque::new(),
            pace: Pace::default(),
            frames: 0,
            lost: None,
        };
        let devices = smoothers.iter().map(device).collect();
        let state = State { devices, results: BTreeMap::new(), is_closed: false };
        Self {
            state: Mutex::new(state),
            given: smoothers.iter().map(|_| Condvar::new()).collect(),
            done: Condvar::new(),
            window,
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Poisoning is ignored, because the state is always consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Assigns a frame to a device.
    pub(super) fn deal(&self, job: Job) -> Result<(), EngineError> {
        self.give(&mut self.lock(), job)
    }

    fn give(&self, state: &mut State, job: Job) -> Result<(), EngineError> {
        let working = state.devices.iter().enumerate().filter(|(_, device)| device.lost.is_none());
        let loads = working.map(|(i, device)| (i, device.pace, device.waiting.len() + device.taken.len()));
        let Some(chosen) = dealing::choose(loads, self.window, Instant::now()) else {
            let unknown = || EngineError::Unavailable { engine: "fleet", reason: "all devices have failed".to_owned() };
            return Err(state.last_loss().unwrap_or_else(unknown));
        };
        let waiting = &mut state.devices[chosen].waiting;
        // A frame of a lost device may be older than the frames waiting here.
        let at = waiting.partition_point(|other| other.number < job.number);
        waiting.insert(at, job);
        self.given[chosen].notify_one();
        Ok(())
    }

    /// Waits for the result of a submitted frame.
    pub(super) fn wait_for(&self, number: u64) -> Result<SmoothedView, Error> {
        let mut state = self.lock();
        loop {
            if let Some(result) = state.results.remove(&number) {
                return result;
            }
            state = self.done.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Removes a device and passes its frames to other devices. If no device is left, each of these frames gets an
    /// error.
    pub(super) fn lose(&self, device: usize, error: &EngineError) {
        let mut state = self.lock();
        let lost = &mut state.devices[device];
        if lost.lost.is_some() {
            return;
        }
        lost.lost = Some(error.clone());
        let jobs: Vec<Job> = lost.taken.drain(..).chain(lost.waiting.drain(..)).collect();
        for job in jobs {
            let number = job.number;
            if let Err(error) = self.give(&mut state, job) {
                state.results.insert(number, Err(error.into()));
            }
        }
        self.done.notify_all();
        // The device's thread may be waiting for frames.
        self.given[device].notify_one();
    }

    /// Returns true if at least one device works.
    pub(super) fn works(&self) -> bool {
        self.lock().devices.iter().any(|device| device.lost.is_none())
    }

    pub(super) fn last_loss(&self) -> Option<EngineError> {
        self.lock().last_loss()
    }

    pub(super) fn members(&self) -> Vec<FleetMember> {
        let member = |device: &Device| {
            let Device { name, engine, frames, lost, .. } = device;
            FleetMember { name: name.clone(), engine: *engine, frames: *frames, lost: lost.clone() }
        };
        self.lock().devices.iter().map(member).collect()
    }

    /// Ends all threads, and discards the frames in flight.
    pub(super) fn close(&self) {
        self.lock().is_closed = true;
        self.given.iter().for_each(Condvar::notify_all);
    }

    /// Takes the next frame waiting for a device, to submit it. If no frame is waiting and `may_wait` is set, waits
    /// for one.
    fn take(&self, device: usize, may_wait: bool) -> Next {
        let mut state = self.lock();
        loop {
            if state.is_closed || state.devices[device].lost.is_some() {
                return Next::End;
            }
            let Device { waiting, taken, .. } = &mut state.devices[device];
            if let Some(mut job) = waiting.pop_front() {
                let frame = Arc::clone(&job.frame);
                let buffer = job.is_copied.then(|| job.buffer.take().unwrap_or_default());
                let size = job.size;
                taken.push_back(job);
                return Next::Frame(frame, buffer, size);
            }
            if !may_wait {
                return Next::Nothing;
            }
            state = self.given[device].wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Stores the result of a frame that a device has taken: the newest frame if `is_newest` is set, as after a
    /// failed submission, otherwise the oldest.
    fn put(&self, device: usize, result: Result<SmoothedView, Error>, is_newest: bool) {
        let mut state = self.lock();
        let Device { taken, pace, frames, .. } = &mut state.devices[device];
        let job = if is_newest { taken.pop_back() } else { taken.pop_front() };
        // If the device was removed in the meantime, another device has the frame.
        let Some(job) = job else { return };
        if result.is_ok() {
            *frames += 1;
            pace.add(job.since, Instant::now());
        }
        let number = job.number;
        // The job is dropped first, so that the receiver of the result can be the only owner of the frame.
        drop(job);
        state.results.insert(number, result);
        self.done.notify_all();
    }
}

impl State {
    fn last_loss(&self) -> Option<EngineError> {
        self.devices.iter().rev().find_map(|device| device.lost.clone())
    }
}

#[expect(clippy::large_enum_variant, reason = "moved once per frame")]
enum Next {
    Frame(Arc<dyn SharedFrame>, Option<Smoothed>, Option<WindowSize>),
    Nothing,
    End,
}

/// The thread of a device.
pub(super) struct Worker(Option<JoinHandle<()>>);

impl Worker {
    pub(super) fn start(shared: Arc<Shared>, device: usize, smoother: Smoother) -> Result<Self, EngineError> {
        let failed = |error: std::io::Error| EngineError::Threads { threads: 1, reason: error.to_string() };
        let thread = thread::Builder::new().name(format!("planish-fleet-{device}"));
        let work = move || {
            let mut end = EndOf { shared: &shared, device, error: None };
            end.error = work(&shared, device, smoother).err();
        };
        Ok(Self(Some(thread.spawn(work).map_err(failed)?)))
    }

    /// Waits until the thread has ended. The fleet must be closed.
    pub(super) fn join(&mut self) {
        // A panic has already printed its message.
        let _ = self.0.take().map(JoinHandle::join);
    }
}

/// Removes a device from the fleet if its thread ends with an error or a panic.
struct EndOf<'a> {
    shared: &'a Shared,
    device: usize,
    error: Option<Error>,
}

impl Drop for EndOf<'_> {
    fn drop(&mut self) {
        let error = match self.error.take() {
            Some(Error::Engine(error)) => error,
            Some(error) => EngineError::Unavailable { engine: "fleet", reason: error.to_string() },
            None if thread::panicking() => {
                EngineError::Unavailable { engine: "fleet", reason: "the thread of a device panicked".to_owned() }
            }
            // The fleet was closed.
            None => return,
        };
        self.shared.lose(self.device, &error);
    }
}

/// Smooths the frames of a device until the fleet is closed or the device fails.
fn work(shared: &Shared, device: usize, mut smoother: Smoother) -> Result<(), Error> {
    // Engines that are not pipelined compute during submission, so their result is available immediately.
    let most = if smoother.capabilities().pipelined { smoother.max_in_flight() } else { 1 };
    loop {
        while smoother.in_flight() < most {
            let (frame, buffer, size) = match shared.take(device, smoother.in_flight() == 0) {
                Next::Frame(frame, buffer, size) => (frame, buffer, size),
                Next::Nothing => break,
                Next::End => return Ok(()),
            };
            if let Some(size) = size {
                smoother.set_size(size)?;
            }
            let submitted = frame.frame().map_err(Error::from).and_then(|frame| match buffer {
                Some(buffer) => smoother.submit(frame, buffer),
                None => smoother.submit_in_place(frame),
            });
            drop(frame);
            match submitted {
                Ok(()) => {}
                Err(error) if is_of_frame(&error) => shared.put(device, Err(error), true),
                Err(error) => return Err(error),
            }
        }
        match smoother.receive() {
            Ok(Some(view)) => shared.put(device, Ok(view), false),
            Ok(None) => {}
            Err(error) if is_of_frame(&error) => shared.put(device, Err(error), false),
            Err(error) => return Err(error),
        }
    }
}

/// Returns true if only this frame fails, because it is malformed or too large, and the device can continue.
fn is_of_frame(error: &Error) -> bool {
    match error {
        Error::Frame(_) => true,
        Error::Engine(error) => error.is_too_large(),
        _ => false,
    }
}
