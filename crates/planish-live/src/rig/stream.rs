//! The loop that runs a rig: cameras, matching, smoothing and sinks.

mod warnings;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::{Duration, Instant};

use super::capture::{Arrived, Inbox, Received, Taken};
use super::{
    CameraStatistics, Clock, MatcherCounts, Moment, Rig, RigCamera, RigFrame, RigOptions, RigResults, RigSink,
    RigSmoother, RigStatistics, RigWay,
};
use crate::{
    source::{PreparedSource, Source},
    stream::{SinkThread, StreamFrame, StreamStatistics},
};
use planish_core::{
    Engine, EngineError, Error, IntoFrame, ParamError, SessionEvent,
    internal::{GpuLosses, LIVE_IN_FLIGHT, Recovery},
};

/// Maximum time that frames of one moment wait for each other, unless the frame interval is shorter.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// Interval between checks of the stop flag.
const PATIENCE: Duration = Duration::from_millis(100);

/// An event of a running rig.
#[derive(Debug)]
#[non_exhaustive]
pub enum RigEvent<'a> {
    /// A moment was smoothed.
    Moment(&'a RigStatistics),
    /// A failure that the stream survives: a failing camera, an unreadable frame, a failing sink or a lost GPU.
    Warning(String),
}

/// A stream of a rig's cameras to sinks that runs on the calling thread.
pub struct RigStream<'a> {
    rig: &'a Rig,
    sources: Vec<Box<dyn Source>>,
    options: RigOptions,
    sinks: Vec<Box<dyn RigSink>>,
    stop: Option<&'a AtomicBool>,
    tell: Box<dyn FnMut(RigEvent<'_>) + 'a>,
}

impl<'a> RigStream<'a> {
    /// Creates a stream without sinks, stop flag or event handler.
    ///
    /// `sources` are the sources of the rig's cameras, in their order. If all are live, only the newest moment is
    /// smoothed; if all are recorded, every frame is smoothed. A mixture is an error.
    pub fn new(rig: &'a Rig, sources: Vec<Box<dyn Source>>, options: RigOptions) -> Self {
        Self { rig, sources, options, sinks: Vec::new(), stop: None, tell: Box::new(|_| ()) }
    }

    /// Adds sinks for the results.
    pub fn with_sinks(mut self, sinks: Vec<Box<dyn RigSink>>) -> Self {
        self.sinks.extend(sinks);
        self
    }

    /// Sets a flag that ends the stream early.
    pub fn with_stop(self, stop: &'a AtomicBool) -> Self {
        Self { stop: Some(stop), ..self }
    }

    /// Sets a function to be called on each event.
    pub fn with_events(self, tell: impl FnMut(RigEvent<'_>) + 'a) -> Self {
        Self { tell: Box::new(tell), ..self }
    }

    /// Runs the stream until all cameras end, its limits are reached, all sinks have failed, or the stop flag is set;
    /// then waits for the sinks and closes them.
    ///
    /// A camera that fails or ends is reported and counted, and the others continue. A lost GPU is reopened once; if
    /// it is lost again, the CPU engine takes over. With several devices, the other devices take over the lost GPU's
    /// cameras instead.
    ///
    /// # Errors
    /// If the options are invalid, an engine fails permanently, or every camera failed before it delivered a frame.
    pub fn run(self) -> Result<RigStatistics, Error> {
        let never = AtomicBool::new(false);
        let Self { rig, mut sources, options, sinks, stop, tell } = self;
        let steps = options.preparation;
        if !steps.is_empty() {
            let sensors = options.params.iter().map(|params| params.sensor);
            let cameras = rig.cameras.iter().map(|camera| camera.camera);
            let prepared = |((source, sensor), camera)| {
                Box::new(PreparedSource::new(source, steps, sensor).with_camera(camera)) as Box<dyn Source>
            };
            sources = sources.into_iter().zip(sensors).zip(cameras).map(prepared).collect();
        }
        run(rig, sources, &options, sinks, stop.unwrap_or(&never), tell)
    }
}

fn run(
    rig: &Rig,
    sources: Vec<Box<dyn Source>>,
    options: &RigOptions,
    sinks: Vec<Box<dyn RigSink>>,
    stop: &AtomicBool,
    mut tell: impl FnMut(RigEvent<'_>),
) -> Result<RigStatistics, Error> {
    let is_live = check_sources(rig, &sources)?;
    options.validate()?;
    let smoother = RigSmoother::new(rig, options.way, &options.params, options.general_params, &options.smoother)?;
    let names: Vec<String> = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
    let inbox = Arc::new(Inbox::new(names, is_live, rig.tolerance_s, LONGEST_WAIT));
    let ended = Arc::new(AtomicBool::new(false));
    let capture = |(i, mut source): (usize, Box<dyn Source>)| {
        source.end_with(Arc::clone(&ended));
        let (inbox, clock, offset_s) = (Arc::clone(&inbox), rig.clock, rig.cameras[i].time_offset_s);
        let failed = |error: std::io::Error| EngineError::Threads { threads: 1, reason: error.to_string() };
        let thread = thread::Builder::new().name(format!("planish-camera-{i}"));
        thread.spawn(move || inbox.capture(i, source, clock, offset_s)).map_err(failed)
    };
    let threads: Result<Vec<_>, EngineError> = sources.into_iter().enumerate().map(capture).collect();
    let sinks: Result<Vec<_>, Error> = sinks.into_iter().map(SinkThread::start).collect();
    let result = sinks.and_then(|sinks| {
        let mut stream = Running {
            rig: Arc::new(rig.clone()),
            options,
            smoother: smoother
                .with_registration_m(options.registration_m)
                .with_voxel_m(options.voxel_m)
                .with_temporal(options.temporal, options.tracks_cameras)
                .with_devices(options.devices.clone()),
            pending: VecDeque::new(),
            is_live,
            was_open: false,
            losses: GpuLosses::default(),
            sinks,
            statistics: RigStatistics { moments: StreamStatistics::start(), complete: 0, cameras: Vec::new() },
            smoothed: vec![0; rig.cameras.len()],
            refused: vec![0; rig.cameras.len()],
            told_refusals: vec![Vec::new(); rig.cameras.len()],
            told_lost_points: vec![false; rig.cameras.len()],
            together: vec![0; rig.cameras.len()],
            at_start: None,
        };
        let result = threads
            .as_ref()
            .map_err(|error| Error::from(error.clone()))
            .and_then(|_| stream.run_until(&inbox, stop, &mut tell));
        inbox.close();
        stream.finish(&inbox, &mut tell);
        result.map(|()| stream.statistics)
    });
    inbox.close();
    // Waits for a live camera are bounded, so the cameras' threads notice this flag.
    ended.store(true, Ordering::Relaxed);
    for thread in threads.into_iter().flatten() {
        // A panic has already been reported.
        let _ = thread.join();
    }
    while let Some(warning) = inbox.warning() {
        tell(RigEvent::Warning(warning));
    }
    match inbox.first_error() {
        Some(error) if result.as_ref().is_ok_and(|statistics| statistics.moments.frames_out == 0) => Err(error),
        _ => result,
    }
}

/// Returns true if all sources are live, false if none is; refuses a mixture.
fn check_sources(rig: &Rig, sources: &[Box<dyn Source>]) -> Result<bool, ParamError> {
    if sources.len() != rig.cameras.len() {
        let value = sources.len().to_string();
        return Err(ParamError { field: "sources", value, allowed: "one per camera of the rig" });
    }
    let live = sources.iter().filter(|source| source.is_live()).count();
    if live != 0 && live != sources.len() {
        let value = format!("{live} live of {}", sources.len());
        let allowed = "sources must be all live or all recordings; to mix them, set a rate (fps) for the recordings";
        return Err(ParamError { field: "sources", value, allowed });
    }
    if rig.clock == Clock::Arrival && live == 0 {
        let allowed =
            "\"source\" for recordings, which are read as fast as possible; \"arrival\" applies to live cameras";
        return Err(ParamError { field: "clock", value: "\"arrival\"".to_owned(), allowed });
    }
    Ok(live != 0)
}

struct Running<'a> {
    rig: Arc<Rig>,
    options: &'a RigOptions,
    smoother: RigSmoother,
    /// Moments in flight, kept to be smoothed again if their device is lost.
    pending: VecDeque<Moment<Arrived>>,
    is_live: bool,
    /// Whether an engine has accepted a moment.
    was_open: bool,
    /// Record of GPU losses, from which the recovery is chosen.
    losses: GpuLosses,
    sinks: Vec<SinkThread<RigFrame>>,
    statistics: RigStatistics,
    /// Number of smoothed frames per camera.
    smoothed: Vec<u64>,
    /// Number of frames that the engine rejected, per camera.
    refused: Vec<u64>,
    /// Reported reasons for refusing each camera's frames.
    told_refusals: Vec<Vec<String>>,
    /// Whether lost points were reported, per camera.
    told_lost_points: Vec<bool>,
    /// Number of frames matched with another camera's, per camera.
    together: Vec<u64>,
    /// Number of frames per camera, and number of moments, dropped before the engine was open.
    at_start: Option<(Vec<u64>, u64)>,
}

impl Running<'_> {
    /// Runs the stream until it ends. Once `stop` is set, a moment that takes long is abandoned.
    fn run_until(
        &mut self,
        inbox: &Inbox,
        stop: &AtomicBool,
        tell: &mut impl FnMut(RigEvent<'_>),
    ) -> Result<(), Error> {
        /// Guard that ends the watcher, even if the stream panics.
        struct Done<'a>(&'a AtomicBool);
        impl Drop for Done<'_> {
            fn drop(&mut self) {
                self.0.store(true, Ordering::Relaxed);
            }
        }
        let (stopper, is_done) = (self.smoother.stopper(), AtomicBool::new(false));
        thread::scope(|scope| {
            let watch = || {
                while !is_done.load(Ordering::Relaxed) {
                    thread::park_timeout(PATIENCE);
                    if stop.load(Ordering::Relaxed) {
                        // Repeated, since a stop applies only to the moment being smoothed.
                        stopper.stop();
                    }
                }
            };
            let failed = |error: std::io::Error| EngineError::Threads { threads: 1, reason: error.to_string() };
            let watcher = thread::Builder::new().spawn_scoped(scope, watch).map_err(failed)?;
            let done = Done(&is_done);
            let result = self.run(inbox, stop, tell);
            drop(done);
            watcher.thread().unpark();
            match result {
                Err(Error::Engine(EngineError::Stopped)) if stop.load(Ordering::Relaxed) => Ok(()),
                result => result,
            }
        })
    }

    fn run(&mut self, inbox: &Inbox, stop: &AtomicBool, tell: &mut impl FnMut(RigEvent<'_>)) -> Result<(), Error> {
        let start = Instant::now();
        let mut submitted = 0;
        let most_at_once = if self.is_live { LIVE_IN_FLIGHT } else { usize::MAX };
        loop {
            let is_over = stop.load(Ordering::Relaxed)
                || self.options.max_moments.is_some_and(|most| submitted >= most)
                || self.sinks_are_gone(tell)
                || self.options.max_duration.is_some_and(|longest| start.elapsed() >= longest);
            if is_over {
                break;
            }
            // While moments are in flight, wait only for their results.
            let taken = match self.pending.len() {
                0 => inbox.take(PATIENCE),
                in_flight if in_flight < self.smoother.max_in_flight().min(most_at_once) => inbox.take(Duration::ZERO),
                _ => Taken::Nothing,
            };
            while let Some(warning) = inbox.warning() {
                tell(RigEvent::Warning(warning));
            }
            match taken {
                Taken::Moment(moment) => submitted += u64::from(self.submit(moment, tell)?),
                Taken::Nothing | Taken::End if !self.pending.is_empty() => self.receive(inbox, tell)?,
                Taken::Nothing => {}
                Taken::End => break,
            }
        }
        while !self.pending.is_empty() {
            self.receive(inbox, tell)?;
        }
        Ok(())
    }

    /// Submits a moment; returns false if none of its frames can be smoothed.
    fn submit(&mut self, mut moment: Moment<Arrived>, tell: &mut impl FnMut(RigEvent<'_>)) -> Result<bool, Error> {
        for (i, arrived) in moment.frames.iter_mut().enumerate() {
            let error = arrived.as_ref().and_then(|arrived| arrived.frame.into_frame().err());
            if let Some(error) = error {
                *arrived = None;
                self.refuse(i, &error, tell);
            }
        }
        if moment.frames.iter().all(Option::is_none) {
            return Ok(false);
        }
        if self.options.way == RigWay::Views {
            self.check_cameras(&moment)?;
        }
        self.pending.push_back(moment);
        let last = self.pending.len() - 1;
        if let Err(error) = self.submit_pending(last) {
            self.recover(error, tell)?;
        }
        Ok(true)
    }

    /// Returns an error if the intrinsics of a camera are unknown: smoothing by views needs them.
    fn check_cameras(&self, moment: &Moment<Arrived>) -> Result<(), ParamError> {
        let is_unknown = |(camera, arrived): &(&RigCamera, &Option<Arrived>)| {
            let knows_it = |arrived: &Arrived| arrived.frame.into_frame().is_ok_and(|frame| frame.camera().is_some());
            camera.camera.is_none() && arrived.as_ref().is_some_and(|arrived| !knows_it(arrived))
        };
        match self.rig.cameras.iter().zip(&moment.frames).find(is_unknown) {
            Some((camera, _)) => {
                let value = format!("views, with camera {:?}", camera.name);
                let allowed = "views need known intrinsics, from the camera's source or \"camera\" in the rig";
                Err(ParamError { field: "way", value, allowed })
            }
            None => Ok(()),
        }
    }

    fn submit_pending(&mut self, i: usize) -> Result<(), Error> {
        let started = Instant::now();
        let frames = self.pending[i].frames.iter().map(|arrived| arrived.as_ref()?.frame.into_frame().ok());
        let frames: Vec<_> = frames.collect();
        self.smoother.set_moment_time(Some(self.pending[i].time_s));
        let submitted = self.smoother.submit(&frames);
        self.statistics.moments.time_smoothing += started.elapsed();
        self.was_open |= submitted.is_ok();
        submitted
    }

    /// Receives the oldest moment in flight and passes it to the sinks.
    fn receive(&mut self, inbox: &Inbox, tell: &mut impl FnMut(RigEvent<'_>)) -> Result<(), Error> {
        let started = Instant::now();
        let received = self.smoother.receive();
        self.statistics.moments.time_smoothing += started.elapsed();
        match received {
            Ok(Some(results)) => match self.pending.pop_front() {
                Some(moment) => self.deliver(moment, results, inbox, tell),
                None => Ok(()),
            },
            Ok(None) => Ok(()),
            Err(error) => self.recover(error, tell),
        }
    }

    fn deliver(
        &mut self,
        moment: Moment<Arrived>,
        mut results: RigResults,
        inbox: &Inbox,
        tell: &mut impl FnMut(RigEvent<'_>),
    ) -> Result<(), Error> {
        self.statistics.moments.engine = self.smoother.engine();
        for i in self.smoother.take_unknown_cameras() {
            let name = &self.rig.cameras[i].name;
            tell(RigEvent::Warning(format!("camera {name}: {}", SessionEvent::CameraUnknown)));
        }
        let received = Instant::now();
        let index = self.statistics.moments.frames_out;
        let first = moment.frames.iter().flatten().map(|arrived| arrived.since).min().unwrap_or(received);
        let latency = received.saturating_duration_since(first);
        let mut cameras = Vec::with_capacity(results.len());
        for (i, (arrived, result)) in moment.frames.into_iter().zip(results.iter_mut()).enumerate() {
            let smoothed = match result.take() {
                Some(Ok(smoothed)) => Some(smoothed),
                Some(Err(error)) => {
                    self.refuse(i, &error, tell);
                    None
                }
                None => None,
            };
            cameras.push(arrived.zip(smoothed).map(|(Arrived { frame, name, since }, smoothed)| {
                self.smoothed[i] += 1;
                self.tell_lost_points(i, &frame, &smoothed, tell);
                let latency = received.saturating_duration_since(since);
                StreamFrame { index, name, source: frame, smoothed, latency, received, flicker: None }
            }));
        }
        if cameras.iter().all(Option::is_none) {
            return Ok(());
        }
        if cameras.iter().flatten().count() > 1 {
            cameras.iter().enumerate().for_each(|(i, camera)| self.together[i] += u64::from(camera.is_some()));
        }
        self.statistics.complete += u64::from(cameras.iter().all(Option::is_some));
        self.statistics.moments.add(latency);
        if self.at_start.is_none() {
            let (counts, skipped) = inbox.counts();
            self.at_start = Some((
                counts.iter().map(|(counts, received)| counts.dropped + received.dropped_by_source).collect(),
                skipped,
            ));
        }
        let (rig, outputs) = (Arc::clone(&self.rig), self.options.smoother.outputs);
        let (time_s, voxel_m) = (moment.time_s, self.options.voxel_m);
        let frame = RigFrame { index, time_s, cameras, rig, outputs, latency, voxel_m, fused: OnceLock::new() };
        let frame = Arc::new(frame);
        for sink in &mut self.sinks {
            if let Some(warning) = sink.give(&frame, self.is_live) {
                tell(RigEvent::Warning(warning));
            }
        }
        tell(RigEvent::Moment(&self.statistics));
        Ok(())
    }

    /// Recovers from a GPU error: the cameras of the failed GPU move to the other devices. If there are none, the GPU
    /// is reopened once; after a second loss, the CPU takes over. Moments in flight are submitted again.
    fn recover(&mut self, mut error: Error, tell: &mut impl FnMut(RigEvent<'_>)) -> Result<(), Error> {
        loop {
            let was_gpu = self.smoother.engine() == Engine::Gpu;
            let is_stopped = matches!(error, Error::Engine(EngineError::Stopped));
            let is_of_engine = matches!(error, Error::Engine(_)) && !is_stopped && was_gpu && self.was_open;
            if is_of_engine && !self.losses.uses_cpu() && self.smoother.leave_failed_device() {
                tell(RigEvent::Warning(format!("{error}; moving its cameras to the other devices")));
            } else {
                match self.losses.next(&error, was_gpu, self.was_open, true) {
                    Recovery::Reopen => tell(RigEvent::Warning(format!("{error}; reopening the GPU"))),
                    Recovery::UseCpu => {
                        self.smoother.close(Some(Engine::Cpu));
                        tell(RigEvent::Warning(format!("{error}; continuing with the CPU engine")));
                    }
                    _ => return Err(error),
                }
            }
            match (0..self.pending.len()).try_for_each(|i| self.submit_pending(i)) {
                Ok(()) => return Ok(()),
                Err(again) => error = again,
            }
        }
    }

    /// Waits for the sinks and completes the statistics.
    fn finish(&mut self, inbox: &Inbox, tell: &mut impl FnMut(RigEvent<'_>)) {
        for sink in self.sinks.drain(..) {
            if let Some(warning) = sink.finish(&mut self.statistics.moments) {
                tell(RigEvent::Warning(warning));
            }
        }
        self.tell_alone(inbox, tell);
        self.tell_short(inbox, tell);
        let (counts, skipped) = inbox.counts();
        let (dropped_before, skipped_before) = self.at_start.clone().unwrap_or_default();
        self.statistics.moments.dropped = skipped - skipped_before;
        self.statistics.moments.frames_in = self.statistics.moments.frames_out + self.statistics.moments.dropped;
        let of_camera = |(i, (counts, received)): (usize, (MatcherCounts, Received))| {
            let dropped = counts.dropped + received.dropped_by_source;
            CameraStatistics {
                name: self.rig.cameras[i].name.clone(),
                frames_in: counts.received,
                frames_out: self.smoothed[i],
                missing: counts.missing,
                late: counts.late,
                out_of_order: counts.out_of_order,
                jumps: counts.jumps,
                dropped: dropped.saturating_sub(dropped_before.get(i).copied().unwrap_or(0)),
                unreadable: received.unreadable + self.refused[i],
                has_ended: received.has_ended,
            }
        };
        self.statistics.cameras = counts.into_iter().enumerate().map(of_camera).collect();
        self.statistics.moments.unreadable = self.statistics.cameras.iter().map(|camera| camera.unreadable).sum();
        self.statistics.moments.end();
    }
}
