//! Measured times and their variation.

use serde::Serialize;

/// Relative difference between the medians of a measurement's halves above which the measurement is noisy.
const HALVES_DIFFER: f64 = 0.05;
/// Ratio of the 95th to the 5th percentile above which a measurement is noisy.
const WIDE_SPREAD: f64 = 1.5;
/// Minimum number of values with which a measurement can be classified as noisy.
const ENOUGH: usize = 8;

/// The spread of repeated measurements.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    pub p5: f64,
    pub median: f64,
    pub p95: f64,
    pub p99: f64,
}

impl Spread {
    /// Computes the spread of at least one value. The median of an even number of values is the mean of the middle
    /// two.
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let n = values.len();
        // The quantile is the smallest value such that at least this share of the values are not larger.
        let at = |share: f64| values[((n as f64 * share).ceil() as usize).clamp(1, n) - 1];
        Self { p5: at(0.05), median: 0.5 * (values[(n - 1) / 2] + values[n / 2]), p95: at(0.95), p99: at(0.99) }
    }
}

/// Statistics of a time that was measured repeatedly.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Timing {
    pub ms: Spread,
    /// Number of measurements.
    pub runs: usize,
    /// True if the values vary too much, as on a machine that is busy with other work or changes its clock.
    pub noisy: bool,
}

impl Timing {
    /// Summarizes at least one value, in milliseconds.
    pub fn of(values: Vec<f64>) -> Self {
        let middle = |values: &[f64]| Spread::of(values.to_vec()).median;
        let runs = values.len();
        let (first, second) = values.split_at(runs / 2);
        let drifts = runs >= ENOUGH && (middle(first) / middle(second) - 1.0).abs() > HALVES_DIFFER;
        let ms = Spread::of(values);
        Self { ms, runs, noisy: drifts || (runs >= ENOUGH && ms.p95 > WIDE_SPREAD * ms.p5) }
    }

    /// Formats the median for a table, with `~` if the measurement was noisy.
    pub fn cell(&self) -> String {
        format!("{}{}", milliseconds(self.ms.median), if self.noisy { " ~" } else { "" })
    }
}

/// Formats a time for a table, with three digits or more.
pub fn milliseconds(ms: f64) -> String {
    let digits = match ms.abs() {
        size if size < 1.0 => 3,
        size if size < 100.0 => 2,
        _ => 0,
    };
    format!("{ms:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_that_occurred_and_the_median_is_in_the_middle() {
        let spread = Spread::of((1..=100).rev().map(f64::from).collect());
        assert_eq!(spread, Spread { p5: 5.0, median: 50.5, p95: 95.0, p99: 99.0 });
        assert_eq!(Spread::of(vec![3.0]), Spread { p5: 3.0, median: 3.0, p95: 3.0, p99: 3.0 });
        assert_eq!(Spread::of(vec![6.0, 5.0]).median, 5.5);
        assert_eq!(Spread::of((1..=20).map(f64::from).collect()).p95, 19.0);
    }

    #[test]
    fn drift_and_spread_are_noise_and_one_outlier_is_not() {
        let noisy = |values: Vec<f64>| Timing::of(values).noisy;
        let steady: Vec<f64> = (0..20).map(|i| 10.0 + 0.01 * f64::from(i % 3)).collect();
        assert!(!noisy(steady.clone()));
        let mut outlier = steady.clone();
        outlier[4] = 30.0;
        assert!(!noisy(outlier));
        assert!(noisy((0..20).map(|i| if i < 10 { 10.0 } else { 11.0 }).collect()));
        assert!(noisy((0..20).map(|i| if i % 5 == 0 { 16.0 } else { 10.0 }).collect()));
        assert!(!noisy(vec![1.0, 2.0]), "two values are too few");
        assert_eq!(Timing::of(steady).cell(), "10.01");
        assert_eq!(
            (milliseconds(0.1234), milliseconds(5.0), milliseconds(1234.5)),
            ("0.123".into(), "5.00".into(), "1234".into())
        );
    }
}
