//! The threads that read a rig's cameras, and the inbox that they put frames into.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::{Clock, Matcher, MatcherCounts, Moment};
use crate::source::{OwnedFrame, Source, unreadable_warning};
use planish_core::{Error, ParamError};

/// Maximum absolute timestamp in seconds, about 30,000 years.
const LARGEST_TIMESTAMP_S: f64 = 1e12;

/// Number of consecutive failures after which a live source counts as gone.
const MOST_FAILURES: u32 = 100;

/// Assumed frame rate of a recording without timestamps, in frames per second.
const FRAMES_PER_SECOND: f64 = 30.0;

/// Number of moments since the last match in which each of two cameras must be alone for their clocks to count as
/// unrelated.
const UNMATCHED_ARE_TOLD: u32 = 10;

/// A frame that has arrived from a camera.
pub(super) struct Arrived {
    pub(super) frame: OwnedFrame,
    pub(super) name: Option<String>,
    pub(super) since: Instant,
}

/// Result of taking a moment from the inbox.
pub(super) enum Taken {
    Moment(Moment<Arrived>),
    /// No moment yet.
    Nothing,
    /// All cameras have ended.
    End,
}

/// A queue that collects frames from the cameras' threads, and from which the stream takes moments.
pub(super) struct Inbox {
    names: Vec<String>,
    is_live: bool,
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    matcher: Matcher<Arrived>,
    cameras: Vec<Received>,
    /// Warnings that were not reported yet.
    warnings: VecDeque<String>,
    first_error: Option<Error>,
    /// Number of moments that newer ones replaced.
    skipped: u64,
    /// Number of moments in which each camera was alone, since two cameras last matched.
    alone: Vec<u32>,
    has_told_unmatched: bool,
    is_closed: bool,
    started: Instant,
}

/// Counts and state of a camera's thread.
#[derive(Clone, Copy, Default)]
pub(super) struct Received {
    pub(super) unreadable: u64,
    pub(super) dropped_by_source: u64,
    pub(super) has_ended: bool,
    /// Whether the camera ended with a reported error.
    pub(super) has_failed: bool,
    /// The camera's latest timestamp in seconds, including the time offset.
    pub(super) last_s: Option<f64>,
}

impl Inbox {
    pub(super) fn new(names: Vec<String>, is_live: bool, tolerance_s: f64, patience: Duration) -> Self {
        let state = State {
            matcher: Matcher::new(names.len(), tolerance_s, is_live.then_some(patience)),
            cameras: vec![Received::default(); names.len()],
            warnings: VecDeque::new(),
            first_error: None,
            skipped: 0,
            alone: vec![0; names.len()],
            has_told_unmatched: false,
            is_closed: false,
            started: Instant::now(),
        };
        Self { names, is_live, state: Mutex::new(state), changed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // The state is consistent even after a panic.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads a camera until it ends or the inbox is closed.
    pub(super) fn capture(&self, camera: usize, mut source: Box<dyn Source>, clock: Clock, time_offset_s: f64) {
        let _end = EndOf { inbox: self, camera };
        let (mut failures, mut number) = (0, 0u64);
        while !self.lock().is_closed {
            let frame = source.next_frame();
            match if clock == Clock::Source { frame.and_then(checked) } else { frame } {
                Ok(Some(frame)) => {
                    failures = 0;
                    let arrived = Arrived { frame, name: source.frame_name(), since: Instant::now() };
                    self.put(camera, arrived, (clock, time_offset_s, number, source.is_live()), source.dropped());
                    number += 1;
                }
                Ok(None) => break,
                Err(error) => {
                    failures += 1;
                    let is_over = matches!(error, Error::Device(_)) || (source.is_live() && failures >= MOST_FAILURES);
                    self.failed(camera, error, is_over);
                    if is_over {
                        break;
                    }
                }
            }
        }
    }

    /// Adds a frame, waiting for room if no frame may be dropped.
    fn put(
        &self,
        camera: usize,
        arrived: Arrived,
        (clock, time_offset_s, number, is_live): (Clock, f64, u64, bool),
        dropped: u64,
    ) {
        let mut state = self.lock();
        while !state.is_closed && !state.matcher.has_room(camera) {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        let after_start_s = arrived.since.saturating_duration_since(state.started).as_secs_f64();
        let stamp_s = match (clock, arrived.frame.timestamp_s()) {
            (Clock::Source, Some(stamp_s)) => stamp_s,
            (Clock::Source, None) if !is_live => number as f64 / FRAMES_PER_SECOND,
            (Clock::Source, None) | (Clock::Arrival, _) => after_start_s,
        };
        state.cameras[camera].dropped_by_source = dropped;
        let since = arrived.since;
        let time_s = stamp_s + time_offset_s;
        let last_s = &mut state.cameras[camera].last_s;
        *last_s = Some(last_s.map_or(time_s, |last_s| last_s.max(time_s)));
        state.matcher.put(camera, time_s, since, arrived);
        self.changed.notify_all();
    }

    fn failed(&self, camera: usize, error: Error, is_over: bool) {
        let mut state = self.lock();
        state.cameras[camera].unreadable += 1;
        let (name, unreadable) = (&self.names[camera], state.cameras[camera].unreadable);
        if is_over {
            state.warnings.push_back(format!("camera {name}: {error}; the other cameras continue"));
        } else if let Some(warning) = unreadable_warning(&error, unreadable) {
            state.warnings.push_back(format!("camera {name}: {warning}"));
        }
        if is_over {
            state.cameras[camera].has_failed = true;
            state.first_error.get_or_insert(error);
        }
        self.changed.notify_all();
    }

    /// Takes the next moment (for live cameras, the newest one), waiting at most `patience`.
    pub(super) fn take(&self, patience: Duration) -> Taken {
        let deadline = Instant::now() + patience;
        let mut state = self.lock();
        loop {
            let now = Instant::now();
            if let Some(moment) = state.next(now, self.is_live) {
                self.changed.notify_all();
                return Taken::Moment(moment);
            }
            if state.matcher.is_over() {
                return Taken::End;
            }
            if now >= deadline {
                return Taken::Nothing;
            }
            let until = state.matcher.due().map_or(deadline, |due| due.min(deadline));
            let left = until.saturating_duration_since(now).max(Duration::from_micros(100));
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Returns the next warning that was not reported yet.
    pub(super) fn warning(&self) -> Option<String> {
        self.lock().warnings.pop_front()
    }

    /// Closes the inbox, which ends the cameras' threads.
    pub(super) fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// Returns true if a warning about unmatched frames was issued.
    pub(super) fn has_told_unmatched(&self) -> bool {
        self.lock().has_told_unmatched
    }

    /// Takes the first error that made a camera fail.
    pub(super) fn first_error(&self) -> Option<Error> {
        self.lock().first_error.take()
    }

    /// Returns statistics of each camera's frames, and the number of moments that newer ones replaced.
    pub(super) fn counts(&self) -> (Vec<(MatcherCounts, Received)>, u64) {
        let state = self.lock();
        (state.matcher.counts().into_iter().zip(state.cameras.iter().copied()).collect(), state.skipped)
    }
}

impl State {
    fn next(&mut self, now: Instant, is_live: bool) -> Option<Moment<Arrived>> {
        let mut moment = self.matcher.take(now)?;
        // Recordings are checked at the end (`tell_alone`).
        if is_live {
            self.look_for_unmatched(&moment);
        }
        while is_live && let Some(newer) = self.matcher.take(now) {
            self.look_for_unmatched(&newer);
            self.skipped += 1;
            moment = newer;
        }
        Some(moment)
    }

    /// Warns once if several cameras deliver frames that never match.
    fn look_for_unmatched(&mut self, moment: &Moment<Arrived>) {
        let are_together = moment.frames.iter().flatten().count() > 1;
        for (alone, frame) in self.alone.iter_mut().zip(&moment.frames) {
            *alone = if are_together { 0 } else { *alone + u32::from(frame.is_some()) };
        }
        // If only one camera delivers frames, the others are missing, not unmatched.
        let unmatched = self.alone.iter().filter(|alone| **alone >= UNMATCHED_ARE_TOLD).count();
        if unmatched > 1 && !self.has_told_unmatched {
            self.has_told_unmatched = true;
            self.warnings.push_back(
                "no timestamps of different cameras are within the tolerance; set time offsets (time_offset_s) or a \
                 larger tolerance (tolerance_ms), or \"clock\": \"arrival\" for live cameras with different clocks"
                    .to_owned(),
            );
        }
    }
}

/// Refuses a frame whose timestamp is NaN or too large to compare with others.
fn checked(frame: Option<OwnedFrame>) -> Result<Option<OwnedFrame>, Error> {
    match frame.as_ref().and_then(OwnedFrame::timestamp_s) {
        Some(seconds) if seconds.is_nan() || seconds.abs() > LARGEST_TIMESTAMP_S => {
            let allowed = "-1e12 to 1e12 s";
            Err(ParamError { field: "timestamp", value: format!("{seconds:e}"), allowed }.into())
        }
        _ => Ok(frame),
    }
}

/// Guard that marks a camera as ended when it is dropped, even by a panic.
struct EndOf<'a> {
    inbox: &'a Inbox,
    camera: usize,
}

impl Drop for EndOf<'_> {
    fn drop(&mut self) {
        let mut state = self.inbox.lock();
        state.matcher.end(self.camera);
        // A camera that was stopped has not ended.
        state.cameras[self.camera].has_ended = !state.is_closed;
        if std::thread::panicking() {
            state.warnings.push_back(format!(
                "camera {}: its source panicked (please report this bug)",
                self.inbox.names[self.camera]
            ));
        }
        self.inbox.changed.notify_all();
    }
}
