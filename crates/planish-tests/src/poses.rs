//! Clouds in coordinate frames other than their sensor's.

use planish::{OrganizedCloud, SensorPose};

/// Pose of a camera that looks forward from a height of 0.6 m, in a robot's base frame (x forward, y left, z up).
pub const BASE: SensorPose = SensorPose { position_m: [0.1, 0.0, 0.6], orientation: [0.5, -0.5, 0.5, -0.5] };

/// Returns the rotation matrix of a unit quaternion (w, x, y, z), row by row.
fn rotation([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Rotates a direction from the sensor's frame into the cloud's.
pub fn rotate(pose: &SensorPose, v: [f64; 3]) -> [f64; 3] {
    rotation(pose.orientation).map(|row| (0..3).map(|k| row[k] * v[k]).sum())
}

/// Transforms a point from the sensor's frame into the cloud's.
pub fn transform(pose: &SensorPose, p: [f64; 3]) -> [f64; 3] {
    let turned = rotate(pose, p);
    [0, 1, 2].map(|k| turned[k] + pose.position_m[k])
}

/// Returns a camera's cloud in the coordinate frame in which the camera has the given pose, rounded to f32 and
/// without intrinsics.
///
/// # Panics
/// If the cloud is not well formed.
pub fn moved(cloud: &OrganizedCloud, pose: SensorPose) -> OrganizedCloud {
    let point = |p: [f32; 3]| transform(&pose, p.map(f64::from)).map(|value| value as f32);
    let positions = cloud.positions().iter().map(point).collect();
    let mut moved = OrganizedCloud::from_positions(cloud.width(), cloud.height(), positions).expect("an allowed shape");
    moved.points.pose = pose;
    moved
}
