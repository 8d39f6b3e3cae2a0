//! Streams from a source through a smoother to sinks. Frames are smoothed as they arrive.
//!
//! A capture thread moves frames from the source into a mailbox. From a live source, the mailbox keeps only the
//! newest frame and counts the frames that it drops; from other sources, it keeps every frame, in order. The calling
//! thread smooths the frames, with several in flight on a GPU. Each sink has a thread and a short queue, so that no
//! sink blocks the source or another sink.

#[cfg(feature = "mcap")]
mod bag;
mod capture;
mod flicker;
mod frames;
mod mailbox;
mod options;
#[cfg(feature = "rerun")]
mod rerun;
mod sinks;
mod statistics;

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::source::{OwnedFrame, PreparedSource, Source, unreadable_warning};
use capture::capture;
use mailbox::{Arrived, Mailbox, Policy};
use planish_core::{EngineError, Error, FrameError, IntoFrame, Outputs, ParamError, Session, Smoothed, SmoothedView};

#[cfg(feature = "rerun")]
pub(crate) use self::rerun::Recording;
#[cfg(feature = "rerun")]
pub use self::rerun::RerunSink;
#[cfg(feature = "mcap")]
pub use bag::BagSink;
pub use flicker::Flicker;
use flicker::FlickerMeter;
pub use frames::{Frames, Waited};
pub(crate) use mailbox::TimeSpent;
pub use options::{StreamOptions, StreamParams};
pub(crate) use sinks::{ALL_SINKS_FAILED, Consumer, SinkThread};
pub use sinks::{FolderSink, Sink, SinkFormat};
pub use statistics::{Latency, StreamStatistics};

/// Number of consecutive unreadable or rejected frames after which a stream ends: a source that repeats a rejected
/// frame would never end by itself.
const MOST_LEFT_OUT: u64 = 1000;

/// Number of frames read ahead from a source that is not live.
const READ_AHEAD: usize = 4;

/// A frame and its result, as passed to sinks.
#[non_exhaustive]
pub struct StreamFrame {
    /// Index among the smoothed frames, from 0.
    pub index: u64,
    /// Name of the frame, if its source provides one: the file name without extension.
    pub name: Option<String>,
    /// The frame as the source delivered it.
    pub source: OwnedFrame,
    /// The result of smoothing the frame.
    pub smoothed: Smoothed,
    /// Time from the frame's arrival until its result was available.
    pub latency: Duration,
    /// The time at which the result was available.
    pub received: Instant,
    /// Difference from the previous frame, if frames are smoothed over time.
    pub flicker: Option<Flicker>,
}

impl std::fmt::Debug for StreamFrame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let shape = (self.smoothed.width, self.smoothed.height);
        let mut debug = f.debug_struct("StreamFrame");
        debug.field("index", &self.index).field("name", &self.name).field("shape", &shape);
        debug.field("latency", &self.latency).finish_non_exhaustive()
    }
}

/// An event of a running stream.
#[derive(Debug)]
#[non_exhaustive]
pub enum StreamEvent<'a> {
    /// A frame was smoothed.
    Frame(&'a StreamStatistics),
    /// A failure that the stream survives: an unreadable frame, a failing sink or a lost GPU.
    Warning(String),
}

/// A stream from a source to sinks that runs on the calling thread. [`Frames`] provides a stream's results as an
/// iterator.
///
/// ```
/// use planish::source::SyntheticSource;
/// use planish::stream::{Stream, StreamOptions};
/// use planish::{Camera, Engine, FrameParams, Outputs, SmootherOptions};
///
/// let source = SyntheticSource::of_frames(1, Camera::new((80, 60), [65.6; 2], [39.5, 29.5]), 2)?;
/// let smoother = SmootherOptions::new(Engine::Cpu, Outputs::POINTS);
/// let options = StreamOptions::new(FrameParams::default(), smoother).with_max_frames(Some(2));
/// let statistics = Stream::new(Box::new(source), options).run()?;
/// assert_eq!(statistics.frames_out, 2);
/// # Ok::<(), planish::Error>(())
/// ```
pub struct Stream<'a> {
    source: Box<dyn Source>,
    options: StreamOptions,
    sinks: Vec<Box<dyn Sink>>,
    stop: Option<&'a AtomicBool>,
    tell: Box<dyn FnMut(StreamEvent<'_>) + 'a>,
}

impl<'a> Stream<'a> {
    /// Creates a stream without sinks, stop flag or event handler.
    pub fn new(source: Box<dyn Source>, options: StreamOptions) -> Self {
        Self { source, options, sinks: Vec::new(), stop: None, tell: Box::new(|_| ()) }
    }

    /// Adds sinks for the results.
    pub fn with_sinks(mut self, sinks: Vec<Box<dyn Sink>>) -> Self {
        self.sinks.extend(sinks);
        self
    }

    /// Sets a flag that ends the stream early.
    pub fn with_stop(self, stop: &'a AtomicBool) -> Self {
        Self { stop: Some(stop), ..self }
    }

    /// Sets a function to be called on each event.
    pub fn with_events(self, tell: impl FnMut(StreamEvent<'_>) + 'a) -> Self {
        Self { tell: Box::new(tell), ..self }
    }

    /// Runs the stream until its source ends, its limits are reached, all sinks have failed, or the stop flag is set;
    /// then waits for the sinks and closes them.
    ///
    /// A frame of a different shape reopens the smoother. A lost GPU is reopened once; if it is lost again, the CPU
    /// engine takes over. With several devices, the other devices continue instead. Frames keep their order. A frame or
    /// sink that fails is reported and counted, and the stream continues.
    ///
    /// # Errors
    /// If the settings are invalid, or an engine or the source fails permanently. If no frame could be smoothed,
    /// returns the error of the first frame that failed.
    pub fn run(self) -> Result<StreamStatistics, Error> {
        let never = AtomicBool::new(false);
        let Self { mut source, options, sinks, stop, tell } = self;
        if let Some((steps, sensor)) = options.preparation() {
            source = Box::new(PreparedSource::new(source, steps, sensor));
        }
        run(source, &options, sinks, stop.unwrap_or(&never), tell)
    }
}

fn run(
    mut source: Box<dyn Source>,
    options: &StreamOptions,
    sinks: Vec<Box<dyn Sink>>,
    stop: &AtomicBool,
    mut tell: impl FnMut(StreamEvent<'_>),
) -> Result<StreamStatistics, Error> {
    let live = source.is_live();
    if live && options.poses.as_ref().is_some_and(|poses| !poses.has_times()) {
        let allowed = "poses need timestamps for a live source, which drops frames";
        return Err(ParamError { field: "poses", value: "one per frame".into(), allowed }.into());
    }
    let mailbox = Arc::new(Mailbox::new(if live { Policy::NewestWins } else { Policy::Every(READ_AHEAD) }));
    let ended = Arc::new(AtomicBool::new(false));
    source.end_with(Arc::clone(&ended));
    let capture = {
        let mailbox = Arc::clone(&mailbox);
        let failed = |error: std::io::Error| EngineError::Threads { threads: 1, reason: error.to_string() };
        thread::Builder::new()
            .name("planish-capture".into())
            .spawn(move || capture(source, &mailbox))
            .map_err(failed)?
    };
    let sinks = sinks.into_iter().map(SinkThread::start).collect::<Result<Vec<_>, _>>();
    let result = sinks.and_then(|sinks| {
        let mut session = options.session(live)?;
        let outputs = session.outputs();
        if options.is_over_time() {
            session.set_outputs(FlickerMeter::outputs(outputs));
        }
        let mut stream = Running {
            options,
            live,
            session,
            flicker: FlickerMeter::default(),
            outputs,
            told_lost_points: false,
            pending: VecDeque::new(),
            sinks,
            statistics: StreamStatistics::start(),
            smooth_time: TimeSpent::default(),
            number: 0,
            first_error: None,
            left_out: 0,
            left_out_in_a_row: 0,
        };
        let mut result = stream.run(&mailbox, stop, &mut tell);
        if let (0, Some(error), Ok(())) = (stream.statistics.frames_out, stream.first_error.take(), &result) {
            result = Err(error);
        }
        // Frames that arrive after the end do not count as dropped.
        mailbox.close();
        let Running { sinks, mut statistics, smooth_time, session, .. } = stream;
        statistics.time_smoothing = smooth_time.total();
        statistics.gaps = session.gaps_in_time();
        for sink in sinks {
            if let Some(warning) = sink.finish(&mut statistics) {
                tell(StreamEvent::Warning(warning));
            }
        }
        result.map(|()| statistics)
    });
    mailbox.close();
    // Waits for a live source are bounded, so the capture thread notices this flag.
    ended.store(true, Ordering::Relaxed);
    if capture.join().is_err() {
        tell(StreamEvent::Warning("the source panicked".to_owned()));
    }
    result.map(|mut statistics| {
        let (frames_in, dropped, unreadable) = mailbox.counts();
        (statistics.frames_in, statistics.dropped) = (frames_in, dropped);
        statistics.unreadable += unreadable;
        statistics.time_capturing = mailbox.capture_time.total();
        statistics.end();
        statistics
    })
}

struct Running<'a> {
    options: &'a StreamOptions,
    live: bool,
    session: Session,
    /// The meter for the flicker between frames.
    flicker: FlickerMeter,
    /// The requested outputs; the session may compute further ones.
    outputs: Outputs,
    told_lost_points: bool,
    /// Frames in flight.
    pending: VecDeque<InFlight>,
    sinks: Vec<SinkThread<StreamFrame>>,
    statistics: StreamStatistics,
    smooth_time: TimeSpent,
    /// Index of the source's next frame; unreadable frames count.
    number: u64,
    /// Error of the first skipped frame.
    first_error: Option<Error>,
    /// Number of skipped frames: unreadable, or rejected by the engine.
    left_out: u64,
    /// Number of frames skipped since the last smoothed frame.
    left_out_in_a_row: u64,
}

/// A submitted frame.
struct InFlight {
    frame: Arc<OwnedFrame>,
    name: Option<String>,
    since: Instant,
}

impl Running<'_> {
    fn run(
        &mut self,
        mailbox: &Mailbox,
        stop: &AtomicBool,
        tell: &mut impl FnMut(StreamEvent<'_>),
    ) -> Result<(), Error> {
        let start = Instant::now();
        let mut submitted = 0;
        loop {
            let is_over = stop.load(Ordering::Relaxed)
                || self.options.max_frames.is_some_and(|most| submitted >= most)
                || self.sinks_are_gone(tell)
                || self.options.max_duration.is_some_and(|longest| start.elapsed() >= longest);
            if is_over {
                break;
            }
            if self.left_out_in_a_row >= MOST_LEFT_OUT {
                tell(StreamEvent::Warning(format!(
                    "the stream stops after {MOST_LEFT_OUT} consecutive unreadable or refused frames"
                )));
                break;
            }
            let in_flight = self.pending.len();
            let most = self.session.max_in_flight();
            // While frames are in flight, wait only for their results.
            let next = match in_flight {
                0 => mailbox.take(Some(Duration::from_millis(100))),
                _ if in_flight < most => mailbox.take(Some(Duration::ZERO)),
                _ => mailbox::Taken::Nothing,
            };
            match next {
                mailbox::Taken::Item(item) => match *item {
                    Ok(Arrived { frame, name, since }) => {
                        self.submit(InFlight { frame: Arc::new(frame), name, since }, tell)?;
                        submitted += 1;
                        // The engine is open: from now on the stream keeps up with a live source.
                        mailbox.set_ready();
                    }
                    Err((error, true)) => {
                        // Frames that arrived before the source failed are still smoothed.
                        while !self.pending.is_empty() {
                            self.receive(tell)?;
                        }
                        return Err(error);
                    }
                    Err((error, false)) => {
                        // Unreadable frames are numbered, too.
                        self.number += 1;
                        self.tell_unreadable(error, tell);
                    }
                },
                mailbox::Taken::Nothing if in_flight > 0 => self.receive(tell)?,
                mailbox::Taken::Nothing => {}
                mailbox::Taken::End if in_flight > 0 => self.receive(tell)?,
                mailbox::Taken::End => break,
            }
        }
        while !self.pending.is_empty() {
            self.receive(tell)?;
        }
        Ok(())
    }

    /// Returns true and emits a warning if all sinks have failed.
    fn sinks_are_gone(&self, tell: &mut impl FnMut(StreamEvent<'_>)) -> bool {
        let are_gone = SinkThread::all_failed(&self.sinks);
        if are_gone {
            tell(StreamEvent::Warning(ALL_SINKS_FAILED.to_owned()));
        }
        are_gone
    }

    fn submit(&mut self, in_flight: InFlight, tell: &mut impl FnMut(StreamEvent<'_>)) -> Result<(), Error> {
        let frame = Arc::clone(&in_flight.frame);
        let timestamp_s = frame.timestamp_s();
        self.session.set_frame_time(timestamp_s);
        if let Some(poses) = &self.options.poses {
            let pose = poses.pose(self.number, timestamp_s, in_flight.name.as_deref());
            self.statistics.without_pose += u64::from(pose.is_none());
            self.session.set_camera_pose(pose)?;
        }
        self.number += 1;
        let submitted = self.smooth_time.on(|| self.session.submit(frame, Smoothed::default()));
        self.tell_events(tell);
        match submitted {
            Ok(()) => self.pending.push_back(in_flight),
            // Only this frame failed: the stream continues.
            Err(Error::Frame(error)) => self.refuse(error, tell),
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Reports the session's events as warnings, and records the engine in use.
    fn tell_events(&mut self, tell: &mut impl FnMut(StreamEvent<'_>)) {
        for event in self.session.take_events() {
            tell(StreamEvent::Warning(event.to_string()));
        }
        self.statistics.engine = self.session.engine().unwrap_or(self.statistics.engine);
    }

    /// Skips a frame that the engine rejected: counts and reports it.
    fn refuse(&mut self, error: FrameError, tell: &mut impl FnMut(StreamEvent<'_>)) {
        self.statistics.unreadable += 1;
        self.tell_unreadable(error.into(), tell);
    }

    /// Counts a skipped frame, and reports it unless too many were reported before.
    fn tell_unreadable(&mut self, error: Error, tell: &mut impl FnMut(StreamEvent<'_>)) {
        self.left_out += 1;
        self.left_out_in_a_row += 1;
        if let Some(warning) = unreadable_warning(&error, self.left_out) {
            tell(StreamEvent::Warning(warning));
        }
        self.first_error.get_or_insert(error);
    }

    /// Receives the oldest result and passes it to the sinks.
    fn receive(&mut self, tell: &mut impl FnMut(StreamEvent<'_>)) -> Result<(), Error> {
        let received = self.smooth_time.on(|| self.session.receive());
        self.tell_events(tell);
        match received {
            Ok(Some(view)) => self.deliver(view, tell),
            Ok(None) => {
                self.pending.pop_front();
            }
            Err(Error::Frame(error)) => {
                self.pending.pop_front();
                self.refuse(error, tell);
            }
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Passes the result of the oldest frame in flight to the sinks.
    fn deliver(&mut self, view: SmoothedView, tell: &mut impl FnMut(StreamEvent<'_>)) {
        let Some(InFlight { frame, name, since }) = self.pending.pop_front() else { return };
        // The engines no longer use the frame, so it can usually be moved instead of copied.
        let frame = Arc::try_unwrap(frame).unwrap_or_else(|frame| OwnedFrame::clone(&frame));
        self.left_out_in_a_row = 0;
        let received = Instant::now();
        let latency = received.duration_since(since);
        self.statistics.add(latency);
        let index = self.statistics.frames_out - 1;
        let mut smoothed = view.into_smoothed();
        let flicker = self.flicker_of(&frame, &mut smoothed);
        self.tell_lost_points(&frame, &smoothed, tell);
        let frame = Arc::new(StreamFrame { index, name, source: frame, smoothed, latency, received, flicker });
        for sink in &mut self.sinks {
            if let Some(warning) = sink.give(&frame, self.live) {
                tell(StreamEvent::Warning(warning));
            }
        }
        tell(StreamEvent::Frame(&self.statistics));
    }

    /// Measures the flicker since the previous frame, then drops outputs that were not requested.
    fn flicker_of(&mut self, frame: &OwnedFrame, smoothed: &mut Smoothed) -> Option<Flicker> {
        if !self.options.is_over_time() {
            return None;
        }
        let flicker = self.flicker.add(frame, smoothed);
        self.statistics.add_flicker(flicker);
        smoothed.status = smoothed.status.take().filter(|_| self.outputs.status);
        smoothed.frames = smoothed.frames.take().filter(|_| self.outputs.frames);
        flicker
    }

    /// Warns once if a frame lost more than 1 % of its points.
    fn tell_lost_points(&mut self, frame: &OwnedFrame, smoothed: &Smoothed, tell: &mut impl FnMut(StreamEvent<'_>)) {
        let Some(frame) = frame.into_frame().ok().filter(|_| !self.told_lost_points) else { return };
        if let Some(warning) = smoothed.lost_points_warning(frame) {
            self.told_lost_points = true;
            tell(StreamEvent::Warning(warning));
        }
    }
}
