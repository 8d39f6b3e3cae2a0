//! The agreement that every engine owes the f64 reference (docs/method.md, section 9), each figure with its cause.

use planish::{OrganizedCloud, Smoothed};

/// Share of pixels whose status must be equal. The others lie within rounding of a threshold: the gate, the degenerate
/// ratio, a point that moves by just the radius.
pub const EQUAL_STATUS: f64 = 0.9999;

/// Most positions: f32 rounding of coordinates up to 5 m (half an ulp is 2.4e-7 m) and of the sums over a window.
pub const POSITION_999_M: f64 = 5e-6;

/// Nearly all positions: a neighbour within rounding of the gate, or a pivot within rounding of being dropped.
pub const POSITION_9999_M: f64 = 2e-5;

/// How far one result is from the reference's.
#[derive(Debug, Clone, Copy)]
pub struct Agreement {
    /// Share of pixels with equal status.
    pub equal_status: f64,
    /// 99.9th percentile of the distance of positions with equal status, in metres.
    pub position_999_m: f64,
    /// 99.99th percentile.
    pub position_9999_m: f64,
    /// Largest distance.
    pub position_max_m: f64,
}

/// Compares a result with the reference's; both need the status.
///
/// # Panics
/// If either has no status.
pub fn agreement(result: &Smoothed, reference: &Smoothed) -> Agreement {
    let (status, expected) = (result.status.as_ref().expect("status"), reference.status.as_ref().expect("status"));
    assert_eq!(status.len(), expected.len());
    let mut distances = Vec::new();
    let mut equal = 0usize;
    for i in (0..status.len()).filter(|&i| status[i] == expected[i]) {
        equal += 1;
        if expected[i].has_point() {
            let (a, b) = (result.points.get(i), reference.points.get(i));
            let square: f64 = (0..3).map(|k| (f64::from(a[k]) - f64::from(b[k])).powi(2)).sum();
            // A NaN would vanish in a sort by partial order; count it as infinitely far.
            distances.push(if square.is_nan() { f64::INFINITY } else { square.sqrt() });
        }
    }
    distances.sort_by(f64::total_cmp);
    let at = |share: f64| {
        let last = distances.len().checked_sub(1);
        last.map_or(0.0, |last| distances[((distances.len() as f64 * share) as usize).min(last)])
    };
    Agreement {
        equal_status: equal as f64 / status.len() as f64,
        position_999_m: at(0.999),
        position_9999_m: at(0.9999),
        position_max_m: at(1.0),
    }
}

/// The rules every result keeps whatever the engine: nothing appears in holes, points stay within the radius, normals are
/// unit vectors towards the sensor, and outputs agree with the status.
///
/// # Panics
/// If a rule is broken. Needs all outputs.
pub fn assert_invariants(input: &OrganizedCloud, result: &Smoothed, radius_m: impl Fn(f64) -> f64, what: &str) {
    let status = result.status.as_ref().expect("status");
    let normals = result.normals.as_ref().expect("normals");
    let curvature = result.curvature.as_ref().expect("curvature");
    let neighbours = result.neighbours.as_ref().expect("neighbours");
    for i in 0..status.len() {
        let at = || format!("{what}, pixel {i}: {:?} -> {:?}", input.positions().get(i), result.points.get(i));
        let (valid_in, valid_out) = (input.positions().is_finite(i), result.points.is_finite(i));
        assert_eq!(status[i] == planish::Status::Hole, !valid_in, "{}", at());
        assert_eq!(status[i].has_point(), valid_out, "{}", at());
        assert_eq!(valid_in && neighbours[i] >= 3, valid_out, "{}", at());
        assert_eq!(status[i].has_normal(), normals.is_finite(i), "{}", at());
        assert_eq!(status[i].has_normal(), curvature[i].is_finite(), "{}", at());
        if !valid_out {
            continue;
        }
        let (p, q) = (input.positions().get(i).map(f64::from), result.points.get(i).map(f64::from));
        let moved = (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>().sqrt();
        // The output is rounded to f32, at 5 m to 2.4e-7 m a coordinate.
        assert!(moved <= radius_m(p[2]) + 1e-6 * (1.0 + p[2].abs()), "{}", at());
        if status[i].has_normal() {
            let n = normals.get(i).map(f64::from);
            let length = n.iter().map(|c| c * c).sum::<f64>().sqrt();
            assert!((length - 1.0).abs() < 1e-5, "{}: normal {n:?}", at());
            let towards = (0..3).map(|k| n[k] * p[k]).sum::<f64>();
            assert!(towards <= 1e-5 * (1.0 + p[2].abs()), "{}: normal {n:?}", at());
            assert!((0.0..=0.334).contains(&curvature[i]), "{}: curvature {}", at(), curvature[i]);
        }
    }
}
