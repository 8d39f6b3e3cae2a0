//! A running stream as an iterator.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use super::{Sink, Stream, StreamEvent, StreamFrame, StreamOptions, StreamStatistics};
use crate::source::Source;
use planish_core::{EngineError, Error};

/// Maximum number of results that wait to be taken, for a source that is not live.
const MAX_WAITING: usize = 2;
/// Maximum number of warnings kept until they are taken. A repeated file may fail in the same way forever.
const MAX_WARNINGS: usize = 100;
/// Interval at which a waiting thread checks whether the stream should stop.
const PATIENCE: Duration = Duration::from_millis(50);

/// A running stream as an iterator over its frames.
///
/// The newest frame of a live source replaces a waiting one; any other source waits for the caller. Dropping the
/// iterator stops the stream.
#[derive(Debug)]
pub struct Frames {
    shared: Arc<Shared>,
    is_live: bool,
}

/// The result of [`Frames::next_within`].
#[derive(Debug)]
pub enum Waited {
    /// The next frame.
    Frame(Arc<StreamFrame>),
    /// The stream has ended.
    Ended,
    /// The timeout passed before the next frame or the end.
    TimedOut,
}

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Arc<StreamFrame>>,
    /// Number of results of a live source that a newer one replaced before they were taken.
    replaced: u64,
    warnings: Vec<String>,
    has_ended: bool,
    statistics: Option<StreamStatistics>,
    error: Option<Error>,
}

impl Frames {
    /// Starts a stream on another thread; see [`Stream::run`].
    ///
    /// # Errors
    ///
    /// If the thread cannot be started.
    pub fn start(source: Box<dyn Source>, options: StreamOptions) -> Result<Self, Error> {
        let (shared, is_live) = (Arc::new(Shared::default()), source.is_live());
        let sink = Handover { shared: Arc::clone(&shared), is_live };
        let ending = Ending(Arc::clone(&shared));
        let work = move || {
            let stream = Stream::new(source, options).with_sinks(vec![Box::new(sink)]).with_stop(&ending.0.stop);
            let result = stream
                .with_events(|event| {
                    if let StreamEvent::Warning(warning) = event {
                        ending.0.warn(warning);
                    }
                })
                .run();
            ending.end(result);
        };
        thread::Builder::new().name("planish-stream".into()).spawn(work).map_err(|error| failed(&error.to_string()))?;
        Ok(Self { shared, is_live })
    }

    /// Returns true if the source is a camera, or a recording played back in real time.
    pub fn is_live(&self) -> bool {
        self.is_live
    }

    /// Waits for the next frame, up to `timeout`.
    ///
    /// # Errors
    ///
    /// Returns the error that ended the stream, once.
    pub fn next_within(&self, timeout: Duration) -> Result<Waited, Error> {
        let mut state = self.shared.lock();
        let until = Instant::now() + timeout;
        loop {
            if let Some(frame) = state.waiting.pop_front() {
                self.shared.changed.notify_all();
                return Ok(Waited::Frame(frame));
            }
            if state.has_ended {
                return state.error.take().map_or(Ok(Waited::Ended), Err);
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(Waited::TimedOut);
            }
            state = self.shared.wait(state, left);
        }
    }

    /// Returns the distinct warnings since the last call, for example about unreadable frames or a lost GPU.
    pub fn take_warnings(&self) -> Vec<String> {
        std::mem::take(&mut self.shared.lock().warnings)
    }

    /// Returns counts, speed and latency of the whole stream; `None` until it has ended.
    pub fn statistics(&self) -> Option<StreamStatistics> {
        let state = self.shared.lock();
        let mut statistics = state.statistics.clone()?;
        statistics.dropped_by_sinks += state.replaced;
        Some(statistics)
    }

    /// Requests that the stream stop; [`has_ended`](Self::has_ended) becomes true once it has stopped. Waiting frames
    /// can still be taken.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
    }

    /// Returns true if the stream has ended and its source is closed.
    pub fn has_ended(&self) -> bool {
        self.shared.lock().has_ended
    }
}

impl Iterator for Frames {
    type Item = Result<Arc<StreamFrame>, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            match self.next_within(PATIENCE) {
                Ok(Waited::Frame(frame)) => return Some(Ok(frame)),
                Ok(Waited::Ended) => return None,
                Ok(Waited::TimedOut) => {}
                Err(error) => return Some(Err(error)),
            }
        }
    }
}

impl Drop for Frames {
    fn drop(&mut self) {
        self.stop();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, timeout: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, timeout).unwrap_or_else(PoisonError::into_inner).0
    }

    fn warn(&self, warning: String) {
        let mut state = self.lock();
        if state.warnings.len() < MAX_WARNINGS && !state.warnings.contains(&warning) {
            state.warnings.push(warning);
        }
    }
}

/// Guard that marks the end of a stream, even after a panic.
struct Ending(Arc<Shared>);

impl Ending {
    fn end(&self, result: Result<StreamStatistics, Error>) {
        let mut state = self.0.lock();
        match result {
            Ok(statistics) => state.statistics = Some(statistics),
            Err(error) => state.error = Some(error),
        }
    }
}

impl Drop for Ending {
    fn drop(&mut self) {
        let mut state = self.0.lock();
        if state.statistics.is_none() && state.error.is_none() {
            state.error = Some(failed("the stream panicked"));
        }
        state.has_ended = true;
        self.0.changed.notify_all();
    }
}

fn failed(reason: &str) -> Error {
    EngineError::Threads { threads: 1, reason: reason.to_owned() }.into()
}

/// The sink that hands results to the iterator.
struct Handover {
    shared: Arc<Shared>,
    is_live: bool,
}

impl Sink for Handover {
    fn name(&self) -> String {
        "the iterator".to_owned()
    }

    fn write(&mut self, _: &StreamFrame) -> Result<(), Error> {
        // Frames arrive through `write_shared`.
        Ok(())
    }

    fn write_shared(&mut self, frame: &Arc<StreamFrame>) -> Result<(), Error> {
        let mut state = self.shared.lock();
        if self.is_live {
            state.replaced += state.waiting.len() as u64;
            state.waiting.clear();
        }
        while state.waiting.len() >= MAX_WAITING && !self.shared.stop.load(Ordering::Relaxed) {
            state = self.shared.wait(state, PATIENCE);
        }
        state.waiting.push_back(Arc::clone(frame));
        self.shared.changed.notify_all();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::OwnedFrame;
    use planish_core::{Camera, DepthFrame, FrameParams, SmootherOptions};

    /// An endless source of small frames.
    struct Walls;

    impl Source for Walls {
        fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
            let camera = Camera::new((32, 24), [32.0; 2], [16.0, 12.0]);
            Ok(Some(OwnedFrame::Depth(DepthFrame::new(camera, vec![1000; 32 * 24])?)))
        }
    }

    fn start(options: StreamOptions) -> Frames {
        Frames::start(Box::new(Walls), options).unwrap()
    }

    fn options() -> StreamOptions {
        StreamOptions::new(FrameParams::default(), SmootherOptions::default())
    }

    #[test]
    fn every_frame_comes_in_order() {
        let mut frames = start(options().with_max_frames(Some(5)));
        assert!(!frames.is_live() && frames.statistics().is_none());
        let indices: Vec<u64> = frames.by_ref().map(|frame| frame.unwrap().index).collect();
        assert_eq!(indices, [0, 1, 2, 3, 4]);
        let statistics = frames.statistics().unwrap();
        assert_eq!((statistics.frames_out, statistics.dropped_by_sinks), (5, 0));
        assert!(frames.has_ended() && frames.next().is_none());
    }

    #[test]
    fn a_stream_that_fails_gives_its_error_once() {
        let mut params = FrameParams::default();
        params.fit.degree = 9;
        let mut frames = start(StreamOptions::new(params, SmootherOptions::default()));
        assert!(frames.next().unwrap().is_err());
        assert!(frames.next().is_none() && frames.statistics().is_none());
    }

    #[test]
    fn a_stopped_stream_ends() {
        let mut frames = start(options());
        frames.next().unwrap().unwrap();
        frames.stop();
        // Only waiting frames are left.
        assert!(frames.by_ref().count() < 20);
        assert!(frames.has_ended() && frames.statistics().is_some());
    }
}
