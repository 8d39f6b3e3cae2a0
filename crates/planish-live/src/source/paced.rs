//! A source slowed down to a camera's pace.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use super::{OwnedFrame, Source};
use planish_core::{Error, ParamError};

/// A source that delivers the frames of another at a fixed rate, as a live camera would: a late caller gets the next
/// frame.
pub struct Paced {
    source: Box<dyn Source>,
    interval: Duration,
    next: Option<Instant>,
    /// Set when no more frames are wanted.
    ended: Arc<AtomicBool>,
}

/// Interval at which a wait checks whether a frame is still wanted.
const PATIENCE: Duration = Duration::from_millis(50);

impl Paced {
    /// Paces a source to `fps` frames per second, 0.1 to 100,000.
    pub fn new(source: Box<dyn Source>, fps: f64) -> Result<Self, ParamError> {
        if !(0.1..=1e5).contains(&fps) {
            return Err(ParamError { field: "fps", value: fps.to_string(), allowed: "0.1 to 100000" });
        }
        Ok(Self { source, interval: Duration::from_secs_f64(1.0 / fps), next: None, ended: Arc::default() })
    }
}

impl Source for Paced {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let frame = self.source.next_frame()?;
        let now = Instant::now();
        let due = self.next.unwrap_or(now);
        while !self.ended.load(Ordering::Relaxed) {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            thread::sleep(left.min(PATIENCE));
        }
        // Intervals count from the due time, not from the arrival, so delays do not add up. Intervals missed during a
        // longer delay are skipped.
        let missed = now.saturating_duration_since(due).as_nanos() / self.interval.as_nanos().max(1);
        let missed = u32::try_from(missed).unwrap_or(u32::MAX);
        self.next =
            due.checked_add(self.interval.saturating_mul(missed.saturating_add(1))).or(Some(now + self.interval));
        Ok(frame)
    }

    fn frame_name(&self) -> Option<String> {
        self.source.frame_name()
    }

    fn description(&self) -> Option<String> {
        self.source.description()
    }

    fn is_live(&self) -> bool {
        true
    }

    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.source.end_with(Arc::clone(&ended));
        self.ended = ended;
    }
}
