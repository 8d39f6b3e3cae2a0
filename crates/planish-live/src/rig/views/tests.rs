//! Tests of facing, views and carrying points back, on simulated rigs.

use glam::DMat3;

use super::*;

const SHAPE: (usize, usize) = (80, 60);

fn camera() -> Camera {
    Camera::new(SHAPE, [66.0, 66.0], [39.5, 29.5])
}

/// Returns a camera `shift_m` to the right that sees a wall at z = 1 m and measures it `off_m` too far.
fn wall(shift_m: f64, off_m: f32) -> Measured {
    let rig_from_camera = RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::new(shift_m, 0.0, 0.0) };
    let points = camera().deproject_m(std::iter::repeat_n(1.0 + off_m, SHAPE.0 * SHAPE.1));
    let sensor = SensorModel::KINECT_V1;
    let normals = normals(&points, SHAPE, &sensor);
    Measured {
        camera: camera(),
        points,
        normals,
        sensor,
        rig_from_camera,
        points_from_camera: RigidTransform::IDENTITY,
        is_added: false,
    }
}

#[test]
fn from_where_nothing_stands_surfaces_are_the_mean_and_nothing_shows_through_their_gaps() {
    // From half the distance, the samples of the wall at 1 m are two pixels apart; another wall is 40 cm behind it.
    let closer = RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::new(0.1, 0.0, 0.5) };
    let behind = wall(0.05, 0.4);
    let all = [
        Some(wall(0.0, 0.0)),
        Some(wall(0.5, 0.004)),
        Some(behind),
        Some(Measured::nothing(camera(), SensorModel::KINECT_V1, closer)),
    ];
    let view = all[3].as_ref().unwrap().view(3, &all, 0.01);
    let depths: Vec<f32> = view.points.z().iter().copied().filter(|z| z.is_finite()).collect();
    assert!(depths.len() > SHAPE.0 * SHAPE.1 / 8);
    assert!(depths.iter().all(|&z| (0.4999..0.5041).contains(&z)), "{:?}", depths.iter().find(|z| **z > 0.51));
    // A surface that only one camera sees is left to that camera: the first wall's left edge.
    let counted = view.counted[0].as_ref().unwrap();
    assert!(counted[30 * SHAPE.0 + 29] == NOWHERE && counted[30 * SHAPE.0 + 45] != NOWHERE);
    assert!(view.counted[3].is_none());
    // The viewpoint contributes nothing to other views.
    let alone = all[0].as_ref().unwrap().view(0, &all[..3], 0.01);
    assert!(all[0].as_ref().unwrap().view(0, &all, 0.01).points.z() == alone.points.z());
}

#[test]
fn what_two_cameras_see_of_a_wall_is_their_mean_and_what_is_beyond_stays() {
    let all = [Some(wall(0.0, 0.0)), Some(wall(0.2, 0.004))];
    let view = all[0].as_ref().unwrap().view(0, &all, 0.01);
    // Both cameras see the right half; only the first sees the left edge.
    let at = |u: usize| view.points.get(30 * SHAPE.0 + u);
    assert_eq!(at(2)[2], 1.0);
    assert!((at(60)[2] - 1.002).abs() < 1e-4, "{:?}", at(60));
    // Farther apart than the registration and the noise allow: two surfaces.
    let apart = [Some(wall(0.0, 0.0)), Some(wall(0.2, 0.05))];
    let view = apart[0].as_ref().unwrap().view(0, &apart, 0.01);
    assert!(view.points.z().iter().all(|&z| z == 1.0));
    assert!(view.counted[1].as_ref().unwrap().iter().all(|&pixel| pixel == NOWHERE));
}

#[test]
fn a_surface_seen_from_behind_is_another_surface() {
    let mut behind = wall(0.0, 0.0);
    // The second camera looks back from z = 2.005 at the other side of a 5 mm board.
    behind.rig_from_camera = RigidTransform {
        rotation: DMat3::from_rotation_y(std::f64::consts::PI),
        translation: DVec3::new(0.0, 0.0, 2.005),
    };
    let all = [Some(wall(0.0, 0.0)), Some(behind)];
    let view = all[0].as_ref().unwrap().view(0, &all, 0.01);
    assert!(view.points.z().iter().all(|&z| z == 1.0));
}
