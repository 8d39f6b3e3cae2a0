//! `diagnostic_msgs/DiagnosticArray`: the node's activity, once a second.

use std::time::Duration;

use anyhow::Result;
use hdrhistogram::Histogram;
use planish::ros::Header;
use serde::Serialize;

/// `diagnostic_msgs/DiagnosticArray`.
#[derive(Debug, Serialize)]
pub struct DiagnosticArray {
    pub header: Header,
    pub status: Vec<DiagnosticStatus>,
}

/// `diagnostic_msgs/DiagnosticStatus`; level 0 is OK, 1 a warning.
#[derive(Debug, Serialize)]
pub struct DiagnosticStatus {
    pub level: u8,
    pub name: String,
    pub message: String,
    pub hardware_id: String,
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/KeyValue`.
#[derive(Debug, Serialize)]
pub struct KeyValue {
    pub key: String,
    pub value: String,
}

/// Counts since the start, and latencies.
pub struct Statistics {
    /// Number of messages received.
    pub received: u64,
    /// Number of results published.
    pub published: u64,
    /// Number of messages replaced by newer ones before they were smoothed.
    pub dropped: u64,
    /// Number of messages that could not be smoothed.
    pub failed: u64,
    /// Number of results that could not be published, mostly because subscribers were too slow.
    pub unsent: u64,
    /// Number of messages without a pose, if a source of poses was named.
    pub without_pose: u64,
    /// The last warning, until the next message is smoothed.
    pub problem: Option<String>,
    /// Times from arrival to publication in microseconds, since the last report.
    latency_us: Histogram<u64>,
    /// Times from the stamp of a message to publication in microseconds, since the start.
    since_stamp_us: Histogram<u64>,
}

/// Maximum latency. A longer time since a stamp means that the stamp comes from another clock.
const LONGEST: Duration = Duration::from_secs(60);

impl Statistics {
    pub fn new() -> Result<Self> {
        // Three significant digits; longer times count as the longest.
        let histogram = || Histogram::new_with_bounds(1, LONGEST.as_micros() as u64, 3);
        let (latency_us, since_stamp_us) = (histogram()?, histogram()?);
        let [received, published, dropped, failed, unsent, without_pose] = [0; 6];
        Ok(Self {
            received,
            published,
            dropped,
            failed,
            unsent,
            without_pose,
            problem: None,
            latency_us,
            since_stamp_us,
        })
    }

    /// Counts a result with its time since arrival, and its time since the stamp if that is not in the future.
    pub fn add(&mut self, latency: Duration, since_stamp: Option<Duration>) {
        self.published += 1;
        self.problem = None;
        self.latency_us.saturating_record(latency.as_micros() as u64);
        if let Some(since_stamp) = since_stamp.filter(|since| *since < LONGEST) {
            self.since_stamp_us.saturating_record(since_stamp.as_micros() as u64);
        }
    }

    /// Returns the totals since the start in one line.
    pub fn summary(&self) -> String {
        let Self { received, published, dropped, failed, unsent, since_stamp_us, .. } = self;
        let ms = |quantile: f64| 1e-3 * since_stamp_us.value_at_quantile(quantile) as f64;
        let latency = match since_stamp_us.len() {
            0 => String::new(),
            _ => format!("; from stamp to publication 50 % within {:.1} ms, 99 % within {:.1} ms", ms(0.5), ms(0.99)),
        };
        format!(
            "{received} messages received, {published} smoothed and published, {dropped} replaced by newer ones, \
             {failed} failed, {unsent} not accepted by subscribers{latency}"
        )
    }

    /// Returns a report with the counts since the start, and the rate and latencies since the last report.
    pub fn report(&mut self, header: Header, node: &str, engine: Option<&str>) -> DiagnosticArray {
        let ms = |quantile: f64| format!("{:.2}", 1e-3 * self.latency_us.value_at_quantile(quantile) as f64);
        let values = [
            ("engine", engine.unwrap_or("not open yet").to_owned()),
            ("received", self.received.to_string()),
            ("published", self.published.to_string()),
            ("replaced by newer ones", self.dropped.to_string()),
            ("failed", self.failed.to_string()),
            ("not accepted by subscribers", self.unsent.to_string()),
            ("without a pose", self.without_pose.to_string()),
            ("rate", self.latency_us.len().to_string()),
            ("latency p50 ms", ms(0.5)),
            ("latency p99 ms", ms(0.99)),
        ];
        self.latency_us.reset();
        let values = values.map(|(key, value)| KeyValue { key: key.into(), value }).into();
        let (level, message) = match &self.problem {
            Some(problem) => (1, problem.clone()),
            None if self.published == 0 => (0, "waiting for frames".into()),
            None => (0, "smoothing".into()),
        };
        let status =
            DiagnosticStatus { level, name: format!("{node}: smoothing"), message, hardware_id: String::new(), values };
        DiagnosticArray { header, status: vec![status] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latencies_are_reported_as_they_were() {
        let mut statistics = Statistics::new().unwrap();
        for ms in 1..=100 {
            statistics.add(Duration::from_millis(ms), Some(Duration::from_millis(2 * ms)));
        }
        // The stamp comes from another clock.
        statistics.add(Duration::from_millis(50), Some(Duration::from_secs(1_000_000)));
        let summary = statistics.summary();
        assert!(
            summary.contains("101 smoothed") && summary.contains("50 % within 100.0 ms, 99 % within 198."),
            "{summary}"
        );
        let report = statistics.report(Header::default(), "/planish", Some("cpu"));
        let value = |key: &str| {
            let found = report.status[0].values.iter().find(|value| value.key == key);
            found.unwrap().value.parse::<f64>().unwrap()
        };
        assert!((value("latency p50 ms") - 50.0).abs() < 0.1 && (value("latency p99 ms") - 99.0).abs() < 1.1);
        assert_eq!(value("rate"), 101.0);
    }
}
