//! Surface normals that face the camera, estimated from unsmoothed samples.

use glam::DVec3;
use rayon::prelude::*;

use planish_core::{SensorModel, Xyz};

/// Number of pixels per task.
pub(super) const PIXELS_OF_A_TASK: usize = 4096;

/// Half the distance in pixels over which the orientation of a surface is estimated.
const NORMAL_PX: usize = 6;

/// Maximum distance between the midpoint of two pixels and the surface between them, in standard deviations of the
/// noise; allows for the bulge of a curved surface.
const MIDDLE_DEVIATIONS: f64 = 4.0;

/// Computes normals that face the camera, from differences between pixels some distance apart; NaN next to holes and
/// steps.
pub(super) fn normals(points: &Xyz, (width, height): (usize, usize), sensor: &SensorModel) -> Xyz {
    let at = |u: usize, v: usize| points.vector(v * width + u);
    let normal = |i: usize| {
        let (u, v) = (i % width, i / width);
        let (left, right) = (u.saturating_sub(NORMAL_PX), (u + NORMAL_PX).min(width - 1));
        let (above, below) = (v.saturating_sub(NORMAL_PX), (v + NORMAL_PX).min(height - 1));
        let p = at(u, v);
        let ends = [at(left, v), at(right, v), at(u, above), at(u, below)];
        // The midpoint of two ends is on the surface, whatever its slope, unless there is a step.
        let noise_m = MIDDLE_DEVIATIONS * sensor.sigma_m(p.z);
        let is_middle = |[a, b]: [DVec3; 2]| ((a.z + b.z) / 2.0 - p.z).abs() <= noise_m;
        if !is_middle([ends[0], ends[1]]) || !is_middle([ends[2], ends[3]]) {
            return [f32::NAN; 3];
        }
        let normal = (ends[1] - ends[0]).cross(ends[3] - ends[2]).normalize();
        let facing = if normal.dot(p) > 0.0 { -normal } else { normal };
        facing.as_vec3().to_array()
    };
    let all: Vec<[f32; 3]> = (0..width * height).into_par_iter().with_min_len(PIXELS_OF_A_TASK).map(normal).collect();
    all.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_core::Camera;

    const SHAPE: (usize, usize) = (80, 60);

    #[test]
    fn the_side_beside_a_step_is_not_told() {
        let step = |i: usize| if i % SHAPE.0 < 40 { 1.0 } else { 1.5 };
        let points = Camera::new(SHAPE, [66.0, 66.0], [39.5, 29.5]).deproject_m((0..SHAPE.0 * SHAPE.1).map(step));
        let found = normals(&points, SHAPE, &SensorModel::KINECT_V1);
        let at = |u: usize| found.get(30 * SHAPE.0 + u);
        assert!(at(38)[2].is_nan() && at(42)[2].is_nan());
        assert!((at(10)[2] + 1.0).abs() < 1e-6 && (at(70)[2] + 1.0).abs() < 1e-6);
    }
}
