//! The status line of a running stream.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use planish::stream::{Latency, StreamEvent, StreamStatistics};
use planish_bench::errln;

/// A line that is updated in place on a terminal, and printed every 5 s elsewhere.
pub struct StatusLine {
    bar: ProgressBar,
    last: std::cell::Cell<Instant>,
}

impl StatusLine {
    const PLAIN_EVERY: Duration = Duration::from_secs(5);

    pub fn new() -> Self {
        let bar = ProgressBar::new_spinner().with_style(ProgressStyle::default_spinner());
        Self { bar, last: std::cell::Cell::new(Instant::now()) }
    }

    pub fn tell(&self, event: StreamEvent<'_>) {
        match event {
            StreamEvent::Warning(warning) => self.warn(&warning),
            StreamEvent::Frame(statistics) => self.show("frames", statistics),
            _ => {}
        }
    }

    pub fn warn(&self, warning: &str) {
        self.bar.suspend(|| errln!("warning: {warning}"));
    }

    /// Shows the stream's progress, at most every 0.2 s on a terminal and every 5 s elsewhere.
    pub fn show(&self, what: &str, statistics: &StreamStatistics) {
        let every = if self.bar.is_hidden() { Self::PLAIN_EVERY } else { Duration::from_millis(200) };
        if self.last.get().elapsed() < every {
            return;
        }
        self.last.set(Instant::now());
        let Latency { p50, p99, .. } = statistics.latency();
        let flicker = statistics.flicker.map_or_else(String::new, |flicker| {
            format!(", jitter {:.2} -> {:.2} mm", 1e3 * flicker.measured_m, 1e3 * flicker.smoothed_m)
        });
        let text = format!(
            "{} {what}, {:.1} per second, {:.1} ms (p99 {:.1}), {}{flicker}",
            statistics.frames_out,
            statistics.fps(),
            ms(p50),
            ms(p99),
            statistics.engine.name()
        );
        if self.bar.is_hidden() {
            errln!("{text}");
        } else {
            self.bar.set_message(text);
            self.bar.tick();
        }
    }

    pub fn end(&self) {
        self.bar.finish_and_clear();
    }
}

pub fn ms(duration: Duration) -> f64 {
    1e3 * duration.as_secs_f64()
}
