//! Groups frames of several cameras into moments by their timestamps.
//!
//! Frames of each camera wait in a queue. The earliest waiting frame opens a moment. The first waiting frame of every
//! other camera belongs to the moment if its timestamp is within the tolerance, and not closer to the next frame of the
//! camera that opened the moment. The moment waits for a frame of a recording until that frame arrives or the recording
//! ends. It waits for a frame of a live camera at most a given time after the moment's first frame, and not at all once
//! that camera has been missing for several moments.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Step between timestamps, in seconds, beyond which a clock is assumed to have been reset. A smaller step backwards
/// means that a frame is out of order.
const CLOCK_JUMP_S: f64 = 0.5;

/// Number of consecutive moments without a live camera after which moments no longer wait for that camera.
const MISSING_IS_GONE: u32 = 15;

/// Maximum number of waiting frames per camera.
const MOST_WAITING: usize = 8;

/// Assumed time in seconds between frames of a camera that has delivered only one.
const USUAL_INTERVAL_S: f64 = 1.0 / 30.0;

/// Frames of one moment, at most one per camera.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Moment<T> {
    /// The earliest timestamp of the frames, in seconds.
    pub time_s: f64,
    /// The frame of each camera; `None` for a camera without one.
    pub frames: Vec<Option<T>>,
}

/// Statistics of a camera's frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct MatcherCounts {
    /// Frames received.
    pub received: u64,
    /// Frames that arrived after their moment was taken.
    pub late: u64,
    /// Frames with the timestamp of the previous frame, or an earlier one.
    pub out_of_order: u64,
    /// Number of jumps of the camera's clock. After a jump, timestamps are shifted to continue the earlier ones.
    pub jumps: u64,
    /// Frames of a live camera that were dropped because its queue was full.
    pub dropped: u64,
    /// Moments without a frame of this camera.
    pub missing: u64,
}

/// A matcher that groups frames of several cameras into moments by their timestamps.
#[derive(Debug)]
pub struct Matcher<T> {
    cameras: Vec<Queue<T>>,
    tolerance_s: f64,
    /// Maximum time a frame waits for frames of other cameras; `None` for no limit.
    patience: Option<Duration>,
    /// Timestamp of the last moment, in seconds.
    last_s: f64,
}

#[derive(Debug)]
struct Queue<T> {
    waiting: VecDeque<Waiting<T>>,
    has_ended: bool,
    /// Correction added to timestamps after clock jumps, in seconds.
    offset_s: f64,
    /// The last corrected timestamp in seconds, and the time of its arrival.
    last: Option<(f64, Instant)>,
    interval_s: f64,
    /// Number of consecutive moments without this camera.
    missing_in_a_row: u32,
    counts: MatcherCounts,
}

#[derive(Debug)]
struct Waiting<T> {
    time_s: f64,
    since: Instant,
    frame: T,
}

impl<T> Matcher<T> {
    /// Creates a matcher for this number of cameras. Timestamps within one moment differ by at most `tolerance_s`
    /// seconds. Frames of one moment wait for each other at most `patience` or one frame interval, whichever is
    /// shorter; a `patience` of `None` is for recordings, whose frames are never dropped.
    pub fn new(cameras: usize, tolerance_s: f64, patience: Option<Duration>) -> Self {
        Self { cameras: (0..cameras).map(|_| Queue::new()).collect(), tolerance_s, patience, last_s: f64::NEG_INFINITY }
    }

    /// Returns true if the camera may deliver another frame: only a few are read ahead from recordings.
    pub fn has_room(&self, camera: usize) -> bool {
        self.patience.is_some() || self.cameras.get(camera).is_some_and(|queue| queue.waiting.len() < MOST_WAITING)
    }

    /// Adds a frame of a camera, with its timestamp in seconds.
    pub fn put(&mut self, camera: usize, time_s: f64, now: Instant, frame: T) {
        let (is_live, last_s, tolerance_s) = (self.patience.is_some(), self.last_s, self.tolerance_s);
        let Some(queue) = self.cameras.get_mut(camera) else { return };
        queue.counts.received += 1;
        // A frame without a finite timestamp gets the time of the last moment.
        let time_s = if time_s.is_finite() { time_s } else { last_s.max(0.0) };
        let Some(time_s) = queue.corrected(time_s, now, is_live) else {
            queue.counts.out_of_order += 1;
            return;
        };
        // A frame is late if the last moment was taken without it. A frame far earlier than that moment is from
        // another clock.
        let would_have_been = time_s <= last_s + tolerance_s && queue.missing_in_a_row > 0;
        let is_late = (would_have_been || time_s < last_s - tolerance_s) && time_s > last_s - CLOCK_JUMP_S;
        if is_late && is_live {
            queue.counts.late += 1;
            return;
        }
        if is_live && queue.waiting.len() >= MOST_WAITING {
            queue.waiting.pop_front();
            queue.counts.dropped += 1;
        }
        queue.waiting.push_back(Waiting { time_s, since: now, frame });
    }

    /// Records that this camera delivers no more frames.
    pub fn end(&mut self, camera: usize) {
        if let Some(queue) = self.cameras.get_mut(camera) {
            queue.has_ended = true;
        }
    }

    /// Returns true if all cameras have ended and no frame is waiting.
    pub fn is_over(&self) -> bool {
        self.cameras.iter().all(|queue| queue.has_ended && queue.waiting.is_empty())
    }

    /// Takes the next moment, if it is complete or has waited long enough.
    pub fn take(&mut self, now: Instant) -> Option<Moment<T>> {
        let (first, time_s) = self.opener()?;
        if self.is_worth_waiting(first, now) {
            return None;
        }
        let heads = self.cameras.iter().map(|queue| queue.waiting.front().map(|frame| frame.time_s));
        let next_s = self.cameras[first].waiting.get(1).map(|frame| frame.time_s);
        let belongs = |head_s: f64| {
            let apart_s = head_s - time_s;
            apart_s <= self.tolerance_s && next_s.is_none_or(|next_s| apart_s <= (next_s - head_s).abs())
        };
        let belongs: Vec<bool> = heads.map(|head| head.is_some_and(belongs)).collect();
        self.last_s = time_s;
        let frames = self.cameras.iter_mut().zip(belongs).map(|(queue, belongs)| queue.give(belongs)).collect();
        Some(Moment { time_s, frames })
    }

    /// Returns true if a camera without a frame may still deliver one for the moment that camera `first` opens.
    fn is_worth_waiting(&self, first: usize, now: Instant) -> bool {
        let is_awaited = |queue: &Queue<T>| {
            let is_gone = self.patience.is_some() && queue.missing_in_a_row >= MISSING_IS_GONE;
            queue.waiting.is_empty() && !queue.has_ended && !is_gone
        };
        self.cameras.iter().any(is_awaited) && self.due_of(first).is_none_or(|due| now < due)
    }

    /// Returns the camera with the earliest waiting frame, and that frame's time in seconds.
    fn opener(&self) -> Option<(usize, f64)> {
        let head = |(i, queue): (usize, &Queue<T>)| queue.waiting.front().map(|frame| (i, frame.time_s));
        self.cameras.iter().enumerate().filter_map(head).min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Returns the time until which the first frame of a camera waits for other cameras' frames.
    fn due_of(&self, camera: usize) -> Option<Instant> {
        let queue = self.cameras.get(camera)?;
        let a_frame = Duration::try_from_secs_f64(queue.interval_s).unwrap_or(Duration::MAX);
        queue.waiting.front()?.since.checked_add(self.patience?.min(a_frame))
    }

    /// Returns the time from which [`take`](Self::take) returns the next moment even if it is incomplete.
    pub fn due(&self) -> Option<Instant> {
        self.due_of(self.opener()?.0)
    }

    /// Returns statistics of the frames of each camera.
    pub fn counts(&self) -> Vec<MatcherCounts> {
        self.cameras.iter().map(|queue| queue.counts).collect()
    }
}

impl<T> Queue<T> {
    fn new() -> Self {
        Self {
            waiting: VecDeque::new(),
            has_ended: false,
            offset_s: 0.0,
            last: None,
            interval_s: USUAL_INTERVAL_S,
            missing_in_a_row: 0,
            counts: MatcherCounts::default(),
        }
    }

    /// Returns a frame's timestamp, corrected for earlier jumps of this camera's clock; `None` for a frame out of
    /// order.
    fn corrected(&mut self, stamp_s: f64, now: Instant, is_live: bool) -> Option<f64> {
        let time_s = stamp_s + self.offset_s;
        let Some((last_s, came)) = self.last else {
            self.last = Some((time_s, now));
            return Some(time_s);
        };
        let step_s = time_s - last_s;
        let arrived_after_s = now.saturating_duration_since(came).as_secs_f64();
        let is_behind = step_s < -CLOCK_JUMP_S;
        // In a recording, a step ahead is a gap. A live clock that advances by more than the elapsed time has jumped.
        let is_ahead = is_live && step_s - arrived_after_s > CLOCK_JUMP_S;
        let time_s = if is_behind || is_ahead {
            self.counts.jumps += 1;
            let step_s = if is_live { arrived_after_s.max(1e-6) } else { self.interval_s };
            self.offset_s += last_s + step_s - time_s;
            last_s + step_s
        } else if step_s <= 0.0 {
            return None;
        } else {
            self.interval_s = step_s;
            time_s
        };
        self.last = Some((time_s, now));
        Some(time_s)
    }

    fn give(&mut self, belongs: bool) -> Option<T> {
        if belongs {
            self.missing_in_a_row = 0;
            return self.waiting.pop_front().map(|waiting| waiting.frame);
        }
        self.missing_in_a_row = self.missing_in_a_row.saturating_add(1);
        self.counts.missing += 1;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOLERANCE_S: f64 = 0.016;

    /// Returns the time of frame `i` at 30 frames per second, `offset_s` later.
    fn time_s(i: u32, offset_s: f64) -> f64 {
        f64::from(i) / 30.0 + offset_s
    }

    fn all<T>(matcher: &mut Matcher<T>, now: Instant) -> Vec<Vec<Option<T>>> {
        std::iter::from_fn(|| matcher.take(now)).map(|moment| moment.frames).collect()
    }

    #[test]
    fn frames_of_one_moment_come_together_whoever_is_ahead() {
        for offset_s in [0.0, 0.004, -0.012, 0.0155] {
            let now = Instant::now();
            let mut matcher = Matcher::new(2, TOLERANCE_S, None);
            for i in 0..4 {
                matcher.put(0, time_s(i, 0.0), now, i);
                matcher.put(1, time_s(i, offset_s), now, i);
            }
            [0, 1].into_iter().for_each(|camera| matcher.end(camera));
            let expected: Vec<_> = (0..4).map(|i| vec![Some(i), Some(i)]).collect();
            assert_eq!(all(&mut matcher, now), expected, "{offset_s}");
            assert!(matcher.is_over());
        }
    }

    #[test]
    fn a_frame_that_is_lost_is_missing_from_its_own_moment_only() {
        let now = Instant::now();
        let mut matcher = Matcher::new(2, TOLERANCE_S, None);
        for i in 0..4 {
            matcher.put(0, time_s(i, 0.0), now, i);
            if i != 1 {
                matcher.put(1, time_s(i, 0.01), now, i);
            }
        }
        [0, 1].into_iter().for_each(|camera| matcher.end(camera));
        let found = all(&mut matcher, now);
        assert_eq!(found[1], [Some(1), None]);
        assert_eq!((found.len(), &found[2]), (4, &vec![Some(2), Some(2)]));
        assert_eq!(matcher.counts()[1].missing, 1);
    }

    #[test]
    fn a_slower_camera_takes_part_in_the_nearest_moments_of_a_faster_one() {
        let now = Instant::now();
        let mut matcher = Matcher::new(2, 0.012, None);
        (0..7).for_each(|i| matcher.put(0, f64::from(i) / 60.0, now, i));
        (0..4).for_each(|i| matcher.put(1, time_s(i, 0.0) - 0.001 * f64::from(i), now, 10 + i));
        [0, 1].into_iter().for_each(|camera| matcher.end(camera));
        let pairs: Vec<_> = all(&mut matcher, now).into_iter().filter(|frames| frames[1].is_some()).collect();
        assert_eq!(pairs, (0..4).map(|i| vec![Some(2 * i), Some(10 + i)]).collect::<Vec<_>>());
    }

    #[test]
    fn recordings_wait_for_each_other_and_one_that_ends_holds_nobody_up() {
        let now = Instant::now();
        let mut matcher = Matcher::new(2, TOLERANCE_S, None);
        (0..MOST_WAITING as u32).for_each(|i| matcher.put(0, time_s(i, 0.0), now, i));
        assert!(!matcher.has_room(0) && matcher.has_room(1));
        assert_eq!(matcher.take(now + Duration::from_secs(60)), None);
        assert_eq!(matcher.due(), None);
        matcher.put(1, time_s(0, 0.0), now, 0);
        assert_eq!(all(&mut matcher, now), [[Some(0), Some(0)]]);
        matcher.end(1);
        assert_eq!(all(&mut matcher, now).len(), MOST_WAITING - 1);
    }

    #[test]
    fn a_live_camera_is_waited_for_no_longer_than_allowed_and_its_late_frame_is_counted() {
        let (start, patience) = (Instant::now(), Duration::from_millis(33));
        let mut matcher = Matcher::new(2, TOLERANCE_S, Some(patience));
        matcher.put(0, 0.0, start, 'a');
        assert_eq!(matcher.take(start + patience / 2), None);
        assert_eq!(matcher.due(), Some(start + patience));
        assert_eq!(matcher.take(start + patience).unwrap().frames, [Some('a'), None]);
        matcher.put(1, 0.002, start + patience, 'b');
        assert_eq!((matcher.counts()[1].late, matcher.counts()[1].missing), (1, 1));
        // The next moment has frames of both cameras again.
        matcher.put(0, 0.033, start + patience, 'c');
        matcher.put(1, 0.035, start + patience, 'd');
        assert_eq!(matcher.take(start + patience).unwrap().frames, [Some('c'), Some('d')]);
    }

    #[test]
    fn a_live_camera_that_is_gone_is_not_waited_for_and_takes_part_again_when_it_is_back() {
        let (start, patience) = (Instant::now(), Duration::from_millis(33));
        let mut matcher = Matcher::new(2, TOLERANCE_S, Some(patience));
        let at = |i: u32| start + Duration::from_secs(i.into()) / 30;
        for i in 0..MISSING_IS_GONE {
            matcher.put(0, time_s(i, 0.0), at(i), i);
            assert!(matcher.take(at(i)).is_none(), "{i}");
            assert!(matcher.take(at(i) + patience).is_some(), "{i}");
        }
        let i = MISSING_IS_GONE;
        matcher.put(0, time_s(i, 0.0), at(i), i);
        assert!(matcher.take(at(i)).is_some());
        matcher.put(1, time_s(i + 1, 0.0), at(i + 1), i + 1);
        matcher.put(0, time_s(i + 1, 0.0), at(i + 1), i + 1);
        assert_eq!(matcher.take(at(i + 1)).unwrap().frames, [Some(i + 1), Some(i + 1)]);
        matcher.put(0, time_s(i + 2, 0.0), at(i + 2), i + 2);
        assert!(matcher.take(at(i + 2)).is_none(), "it is waited for again");
    }

    #[test]
    fn time_stamps_that_repeat_are_left_out_and_clocks_that_jump_go_on() {
        for patience in [None, Some(Duration::from_millis(33))] {
            let start = Instant::now();
            let at = |i: u32| start + Duration::from_secs(i.into()) / 30;
            let mut matcher = Matcher::new(2, TOLERANCE_S, patience);
            let mut found = Vec::new();
            for i in 0..8 {
                matcher.put(0, time_s(i, 0.0), at(i), i);
                // The clock is set back by an hour after frame 3.
                matcher.put(1, time_s(i, if i > 3 { -3600.0 } else { 0.0 }), at(i), i);
                if i == 2 {
                    matcher.put(1, time_s(i, 0.0), at(i), 100);
                    matcher.put(1, time_s(i, -0.01), at(i), 101);
                }
                found.extend(matcher.take(at(i)).map(|moment| moment.frames));
            }
            assert_eq!(found, (0..8).map(|i| vec![Some(i), Some(i)]).collect::<Vec<_>>(), "{patience:?}");
            assert_eq!((matcher.counts()[1].out_of_order, matcher.counts()[1].jumps), (2, 1));
        }
    }

    #[test]
    fn a_live_clock_that_jumps_ahead_goes_on_and_a_gap_in_a_recording_stays_a_gap() {
        let start = Instant::now();
        let at = |i: u32| start + Duration::from_secs(i.into()) / 30;
        for (patience, jumps) in [(None, 0), (Some(Duration::from_millis(33)), 1)] {
            let mut matcher = Matcher::new(1, TOLERANCE_S, patience);
            let mut times = Vec::new();
            for i in 0..4 {
                matcher.put(0, time_s(i, if i > 1 { 3600.0 } else { 0.0 }), at(i), i);
                times.extend(matcher.take(at(i)).map(|moment| moment.time_s));
            }
            assert_eq!((times.len(), matcher.counts()[0].jumps), (4, jumps));
            assert_eq!(times[3] > 3600.0, jumps == 0, "{times:?}");
        }
    }

    #[test]
    fn live_cameras_whose_clocks_are_far_apart_keep_each_other_from_nothing() {
        let start = Instant::now();
        let at = |i: u32| start + Duration::from_secs(i.into()) / 30;
        let mut matcher = Matcher::new(2, TOLERANCE_S, Some(Duration::from_millis(33)));
        let mut found = [0, 0];
        for i in 0..60 {
            matcher.put(0, time_s(i, 3600.0), at(i), i);
            matcher.put(1, time_s(i, 0.0), at(i), i);
            while let Some(moment) = matcher.take(at(i)) {
                (0..2).for_each(|camera| found[camera] += u32::from(moment.frames[camera].is_some()));
            }
        }
        assert!(found[1] >= 55 && matcher.counts()[1].late == 0, "{found:?} {:?}", matcher.counts());
    }

    #[test]
    fn a_live_camera_that_nobody_takes_from_loses_its_oldest_frames() {
        let now = Instant::now();
        let mut matcher = Matcher::new(1, TOLERANCE_S, Some(Duration::ZERO));
        (0..20).for_each(|i| matcher.put(0, time_s(i, 0.0), now, i));
        assert_eq!(matcher.counts()[0].dropped, 20 - MOST_WAITING as u64);
        assert_eq!(matcher.take(now).unwrap().frames, [Some(20 - MOST_WAITING as u32)]);
    }
}
