//! Counts and timings of a stream.

use std::time::{Duration, Instant};

use hdrhistogram::Histogram;

use super::flicker::Flicker;
use planish_core::Engine;

/// Counts and timings of a stream.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct StreamStatistics {
    /// Frames that the source delivered.
    pub frames_in: u64,
    /// Frames smoothed.
    pub frames_out: u64,
    /// Frames of a live source that a newer one replaced.
    pub dropped: u64,
    /// Frames that could not be read, or that the engine refused.
    pub unreadable: u64,
    /// Results dropped because a sink was too slow.
    pub dropped_by_sinks: u64,
    /// Sinks that failed.
    pub failed_sinks: u64,
    /// Frames without a pose, if poses were given.
    pub without_pose: u64,
    /// Gaps in the timestamps after which smoothing over time restarted. Set at the end of the stream.
    pub gaps: u64,
    /// Time spent in the source, including the wait for a live frame. Set at the end of the stream.
    pub time_capturing: Duration,
    /// Time spent handing frames to the engine and waiting for results. Set at the end of the stream.
    pub time_smoothing: Duration,
    /// Time spent in the sinks, summed over them. Set at the end of the stream.
    pub time_in_sinks: Duration,
    /// The engine that smoothed the last frame.
    pub engine: Engine,
    /// Mean difference between consecutive frames, if they are smoothed over time.
    pub flicker: Option<Flicker>,
    /// Number of frames averaged in `flicker`.
    flickering: u32,
    started: Instant,
    first: Option<Instant>,
    last: Option<Instant>,
    duration: Option<Duration>,
    /// Latencies in microseconds, up to 100 s with 3 digits. Never `None`, since the bounds are constants.
    latency: Option<Histogram<u64>>,
}

/// Latency, the time from a frame's arrival until its result is available.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Latency {
    /// Median.
    pub p50: Duration,
    /// 95th percentile.
    pub p95: Duration,
    /// 99th percentile.
    pub p99: Duration,
    /// Maximum.
    pub max: Duration,
}

impl StreamStatistics {
    pub(crate) fn start() -> Self {
        Self {
            frames_in: 0,
            frames_out: 0,
            dropped: 0,
            unreadable: 0,
            dropped_by_sinks: 0,
            failed_sinks: 0,
            without_pose: 0,
            gaps: 0,
            time_capturing: Duration::ZERO,
            time_smoothing: Duration::ZERO,
            time_in_sinks: Duration::ZERO,
            engine: Engine::Auto,
            flicker: None,
            flickering: 0,
            started: Instant::now(),
            first: None,
            last: None,
            duration: None,
            latency: Histogram::new_with_bounds(1, 100_000_000, 3).ok(),
        }
    }

    pub(crate) fn add(&mut self, latency: Duration) {
        let now = Instant::now();
        self.frames_out += 1;
        self.first.get_or_insert(now);
        self.last = Some(now);
        // Latencies beyond the histogram's range are recorded as its upper limit.
        if let Some(histogram) = &mut self.latency {
            histogram.saturating_record(latency.as_micros().min(u128::from(u64::MAX)) as u64);
        }
    }

    pub(super) fn add_flicker(&mut self, flicker: Option<Flicker>) {
        let Some(flicker) = flicker else { return };
        let mean = self.flicker.map(|mean| mean.mean_with(self.flickering.into(), flicker));
        self.flicker = mean.or(Some(flicker));
        self.flickering += 1;
    }

    pub(crate) fn end(&mut self) {
        self.duration = Some(self.started.elapsed());
    }

    /// Returns the time from the start to the end of the stream, or until now while it runs.
    pub fn duration(&self) -> Duration {
        self.duration.unwrap_or_else(|| self.started.elapsed())
    }

    /// Returns the number of results per second, from the first result to the last.
    pub fn fps(&self) -> f64 {
        match (self.first, self.last) {
            (Some(first), Some(last)) if last > first => (self.frames_out - 1) as f64 / (last - first).as_secs_f64(),
            _ => 0.0,
        }
    }

    /// Returns the latency's percentiles.
    pub fn latency(&self) -> Latency {
        let at = |share| {
            Duration::from_micros(self.latency.as_ref().map_or(0, |histogram| histogram.value_at_quantile(share)))
        };
        Latency { p50: at(0.5), p95: at(0.95), p99: at(0.99), max: at(1.0) }
    }
}
