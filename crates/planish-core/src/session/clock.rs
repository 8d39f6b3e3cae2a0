//! Assignment of frames to videos, by timestamp.

/// Maximum time between consecutive frames of one video in seconds, unless [`MOST_INTERVALS`] allows more.
const LONGEST_INTERVAL_S: f64 = 1.0;
/// Maximum ratio of the time between consecutive frames of one video to the previous interval, unless
/// [`LONGEST_INTERVAL_S`] allows more.
const MOST_INTERVALS: f64 = 5.0;

/// Numbers videos; a gap in timestamps begins a new video.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct VideoClock {
    /// Number of the video that the next frame belongs to.
    video: u64,
    /// Number of videos begun because of timestamps.
    gaps: u64,
    /// Timestamp of the last frame in seconds.
    last_time_s: Option<f64>,
    /// Interval between the last two frames in seconds.
    last_interval_s: Option<f64>,
}

impl VideoClock {
    /// Returns the number of the video that the next frame belongs to.
    pub(super) fn video(&self) -> u64 {
        self.video
    }

    pub(super) fn set_video(&mut self, video: u64) {
        self.video = video;
    }

    /// Returns the number of videos begun because of timestamps.
    pub(super) fn gaps(&self) -> u64 {
        self.gaps
    }

    /// Begins a new video with the next frame.
    pub(super) fn restart(&mut self) {
        self.video += 1;
        (self.last_time_s, self.last_interval_s) = (None, None);
    }

    /// Sets the timestamp of the next frame in seconds, if it has one.
    pub(super) fn set_time(&mut self, timestamp_s: Option<f64>) {
        let Some(now_s) = timestamp_s.filter(|time_s| time_s.is_finite()) else { return };
        if let Some(last_s) = self.last_time_s {
            let interval_s = now_s - last_s;
            let usual_s = self.last_interval_s.unwrap_or(0.0);
            if interval_s < 0.0 || interval_s > f64::max(LONGEST_INTERVAL_S, MOST_INTERVALS * usual_s) {
                self.restart();
                self.gaps += 1;
            }
            self.last_interval_s = Some(interval_s.max(0.0));
        }
        self.last_time_s = Some(now_s);
    }
}
