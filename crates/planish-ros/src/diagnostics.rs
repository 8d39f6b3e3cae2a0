//! `diagnostic_msgs/DiagnosticArray`: what the node does, once a second.

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

/// Counts since the start; times since the last report.
pub struct Statistics {
    /// Messages received.
    pub received: u64,
    /// Results published.
    pub published: u64,
    /// Messages replaced by newer ones before they were smoothed.
    pub dropped: u64,
    /// Messages that could not be smoothed.
    pub failed: u64,
    /// Results that subscribers were too slow for.
    pub unsent: u64,
    /// Why the last message could not be smoothed, until one can.
    pub problem: Option<String>,
    latency_us: Histogram<u64>,
}

impl Statistics {
    pub fn new() -> Result<Self> {
        // Three digits.
        let latency_us = Histogram::new(3)?;
        Ok(Self { received: 0, published: 0, dropped: 0, failed: 0, unsent: 0, problem: None, latency_us })
    }

    /// Counts a result, so long after its message arrived.
    pub fn add(&mut self, latency: Duration) {
        self.published += 1;
        self.problem = None;
        self.latency_us.saturating_record(latency.as_micros() as u64);
    }

    /// The report for the time since the last one.
    pub fn report(&mut self, header: Header, node: &str, engine: Option<&str>) -> DiagnosticArray {
        let ms = |quantile: f64| format!("{:.2}", 1e-3 * self.latency_us.value_at_quantile(quantile) as f64);
        let values = [
            ("engine", engine.unwrap_or("not open yet").to_owned()),
            ("received", self.received.to_string()),
            ("published", self.published.to_string()),
            ("dropped for newer ones", self.dropped.to_string()),
            ("failed", self.failed.to_string()),
            ("not taken by subscribers", self.unsent.to_string()),
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
