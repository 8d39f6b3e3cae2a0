//! Chooses the device for each frame: the one that is expected to finish the frame first.

use std::time::{Duration, Instant};

/// Weight of the last frame's time in the estimate for the next frame.
const NEWEST_SHARE: f64 = 0.2;

/// Time without results after which a device's pace is forgotten and the device is tried again: the cause of a slow
/// pace may be gone.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(1);

/// Maximum time per frame of a device, as a share of the time in which the fastest device computes all frames in
/// flight. Results are in order, so a slower device would make the others wait; it is therefore tried only
/// occasionally.
const SLOWEST_SHARE: f64 = 0.5;

/// The pace of a device, estimated from its last frames.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Pace {
    /// Number of seconds between results while the device is busy.
    seconds_a_frame: Option<f64>,
    last_result: Option<Instant>,
}

impl Pace {
    /// Updates the pace with a result received at `now`, of a frame submitted at `since`.
    pub(super) fn add(&mut self, since: Instant, now: Instant) {
        // Frames overlap, so only the time since the previous result counts for this frame.
        let began = self.last_result.map_or(since, |last| last.max(since));
        let seconds = now.saturating_duration_since(began).as_secs_f64();
        let before = self.known(now).unwrap_or(seconds);
        self.seconds_a_frame = Some(before + NEWEST_SHARE * (seconds - before));
        self.last_result = Some(now);
    }

    /// Returns the estimated seconds per frame; `None` without a recent result.
    fn known(&self, now: Instant) -> Option<f64> {
        let is_recent = |last: Instant| now.saturating_duration_since(last) < FORGOTTEN_AFTER;
        self.seconds_a_frame.filter(|_| self.last_result.is_some_and(is_recent))
    }
}

/// Chooses the device for the next frame among the working devices, given the index, the pace and the number of
/// frames of each device. `window` is the maximum number of frames in flight.
pub(super) fn choose(
    devices: impl Iterator<Item = (usize, Pace, usize)> + Clone,
    window: usize,
    now: Instant,
) -> Option<usize> {
    let fastest = devices.clone().filter_map(|(_, pace, _)| pace.known(now)).fold(f64::INFINITY, f64::min);
    let slowest = SLOWEST_SHARE * window as f64 * fastest;
    // A device of unknown pace gets one frame. If other paces are known, it gets no more until that frame is done.
    let expected = |(device, pace, frames): (usize, Pace, usize)| {
        let seconds = match (pace.known(now), frames) {
            (Some(seconds), _) if seconds > fastest.max(slowest) => f64::INFINITY,
            (Some(seconds), frames) => seconds * (frames + 1) as f64,
            (None, 0) => 0.0,
            (None, _) => f64::INFINITY,
        };
        (seconds, frames, device)
    };
    let first = devices.map(expected).min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    first.map(|(.., device)| device)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pace(milliseconds: u64, now: Instant) -> Pace {
        let mut pace = Pace::default();
        pace.add(now - Duration::from_millis(milliseconds), now);
        pace
    }

    #[test]
    fn frames_go_where_they_are_done_first() {
        let now = Instant::now();
        let (fast, slow) = (pace(1, now), pace(10, now));
        let among = |devices: &[(Pace, usize)], window| {
            super::choose(devices.iter().enumerate().map(|(i, &(pace, frames))| (i, pace, frames)), window, now)
        };
        let choose = |devices: &[(Pace, usize)]| among(devices, 24);
        assert_eq!(choose(&[(slow, 0), (fast, 0)]), Some(1));
        assert_eq!(choose(&[(slow, 0), (fast, 8)]), Some(1));
        assert_eq!(choose(&[(slow, 0), (fast, 10)]), Some(0));
        assert_eq!(choose(&[(fast, 2), (fast, 1)]), Some(1));
        // Devices of unknown pace are tried with one frame each, in turn.
        let unknown = Pace::default();
        assert_eq!(choose(&[(fast, 0), (unknown, 0)]), Some(1));
        assert_eq!(choose(&[(fast, 5), (unknown, 1)]), Some(0));
        assert_eq!(choose(&[(unknown, 2), (unknown, 1)]), Some(1));
        assert_eq!(choose(&[]), None);
        // The fast device finishes 12 frames in flight in 12 ms, so 10 ms for one frame is too long.
        assert_eq!(among(&[(slow, 0), (fast, 11)], 12), Some(1));
        assert_eq!(among(&[(slow, 3)], 12), Some(0));
    }

    #[test]
    fn a_pace_is_of_overlapping_frames_and_is_forgotten() {
        let start = Instant::now();
        let at = |milliseconds| start + Duration::from_millis(milliseconds);
        let mut pace = Pace::default();
        // Submitted at 0 ms, received at 10, 12, 14 ms and so on: 2 ms per frame.
        for back in 0..40 {
            pace.add(start, at(10 + 2 * back));
        }
        let known = pace.known(at(90)).unwrap();
        assert!((known - 0.002).abs() < 1e-4, "{known}");
        assert!(pace.known(at(10_000)).is_none());
    }
}
