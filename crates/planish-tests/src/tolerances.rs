//! The invariants of every result. The tolerances against the reference are in [`planish::agreement`].

use planish::agreement::sensor_position_m;
use planish::{OrganizedCloud, Smoothed};

/// Checks the invariants of every result, whatever the engine: nothing appears in holes, points stay within the
/// radius, normals are unit vectors towards the sensor, and outputs agree with the status.
///
/// # Panics
/// If an invariant is violated, or an output is missing.
pub fn assert_invariants(input: &OrganizedCloud, result: &Smoothed, radii_m: &[f64], what: &str) {
    let sensor_m = sensor_position_m(input);
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
        // The output is rounded to f32: at 5 m, to 2.4e-7 m per coordinate.
        let largest = p.into_iter().map(f64::abs).fold(0.0, f64::max);
        assert!(moved <= radii_m[i] + 1e-6 * (1.0 + largest), "{}", at());
        if status[i].has_normal() {
            let n = normals.get(i).map(f64::from);
            let length = n.iter().map(|c| c * c).sum::<f64>().sqrt();
            assert!((length - 1.0).abs() < 1e-5, "{}: normal {n:?}", at());
            let towards = (0..3).map(|k| n[k] * (p[k] - sensor_m[k])).sum::<f64>();
            assert!(towards <= 1e-5 * (1.0 + largest), "{}: normal {n:?}", at());
            assert!((0.0..=0.334).contains(&curvature[i]), "{}: curvature {}", at(), curvature[i]);
        }
    }
}
