//! Synthetic clouds, shared by the tests of all engines.

use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, OrganizedCloud, Xyz};

/// A cloud and its name.
pub struct TestScene {
    /// Name in the messages of failing tests.
    pub name: &'static str,
    /// The cloud.
    pub cloud: OrganizedCloud,
}

/// Returns a camera with the Kinect's field of view and a quarter of its resolution in each direction, for quick tests.
pub fn small_camera() -> Camera {
    Camera::new((160, 120), [131.25, 131.25], [79.5, 59.5])
}

/// Returns an organized cloud whose points are computed from their column and row.
///
/// # Panics
/// If the shape is not allowed.
pub fn grid(width: usize, height: usize, point: impl Fn(usize, usize) -> [f32; 3]) -> OrganizedCloud {
    let positions: Xyz = (0..width * height).map(|i| point(i % width, i / width)).collect();
    OrganizedCloud::from_positions(width, height, positions).expect("an allowed shape")
}

/// Returns a noisy simulated frame of a room or, if `room` is false, of a table.
pub fn simulated(seed: u64, room: bool, camera: Camera) -> OrganizedCloud {
    let (scene, pose) = if room { Scene::room(seed) } else { Scene::tabletop(seed) };
    let truth = scene.render(&camera, &pose);
    let frame = DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).expect("one camera");
    frame.deproject().expect("a valid frame")
}

/// Returns a surface z(x, y) around (0, 0), seen along z, with a point every `spacing_m` metres.
pub fn height_field(side: usize, spacing_m: f64, z: impl Fn(f64, f64) -> f64) -> OrganizedCloud {
    let middle = (side - 1) as f64 / 2.0;
    grid(side, side, |u, v| {
        let (x, y) = ((u as f64 - middle) * spacing_m, (v as f64 - middle) * spacing_m);
        [x as f32, y as f32, z(x, y) as f32]
    })
}

/// Returns clouds that are difficult for engines: holes everywhere, lines, steps, extreme shapes and numbers.
pub fn nasty_scenes() -> Vec<TestScene> {
    let nan = [f32::NAN; 3];
    let wall = |u: usize, v: usize| [0.004 * u as f32, 0.004 * v as f32, 2.0];
    // Noise of 7 mm along the rays of a camera whose principal point is in the first row.
    let noisy = |u: usize, v: usize| {
        let noise = |i: f64| ((i * 12.9898).sin() * 43_758.545_3).fract();
        let i = (u + 640 * v) as f64;
        let z = (2.0 + 0.007 * (noise(i) + noise(i + 0.5))) as f32;
        [(u as f32 - 320.0) / 525.0 * z, v as f32 / 525.0 * z, z]
    };
    let scene = |name, cloud| TestScene { name, cloud };
    vec![
        scene("flat wall", grid(50, 40, wall)),
        scene("all holes", grid(33, 21, |_, _| nan)),
        scene("one pixel", grid(1, 1, wall)),
        scene("one row", grid(77, 1, wall)),
        scene("one column", grid(1, 77, wall)),
        scene("one noisy row, on a plane through the sensor", grid(640, 1, noisy)),
        scene("one noisy row", grid(640, 1, |u, _| noisy(u, 40))),
        scene("one noisy column", grid(1, 480, |_, v| noisy(360, v))),
        scene("two noisy rows", grid(640, 2, noisy)),
        scene("smaller than the window", grid(5, 3, wall)),
        scene("checkerboard of holes", grid(41, 37, |u, v| if (u + v) % 2 == 0 { nan } else { wall(u, v) })),
        scene("lonely points", grid(60, 60, |u, v| if u % 9 == 0 && v % 9 == 0 { wall(u, v) } else { nan })),
        scene("every point the same", grid(20, 20, |_, _| [0.1, 0.2, 1.0])),
        scene(
            "a step",
            grid(50, 40, |u, v| if u < 25 { wall(u, v) } else { [0.002 * u as f32, 0.002 * v as f32, 1.0] }),
        ),
        scene(
            "infinities",
            grid(40, 30, |u, v| match (u * 31 + v * 17) % 13 {
                0 => [f32::INFINITY, 0.0, 1.0],
                1 => [0.0, f32::NEG_INFINITY, f32::NAN],
                _ => wall(u, v),
            }),
        ),
        scene(
            "huge coordinates",
            grid(40, 30, |u, v| match (u * 31 + v * 17) % 13 {
                0 => [1e30, -1e30, 1e30],
                1 => [3e38, 3e38, 3e38],
                _ => wall(u, v),
            }),
        ),
        scene("denormal coordinates", grid(40, 30, |u, v| [1e-40 * u as f32, 1e-40 * v as f32, 1e-39])),
        scene("behind the sensor", grid(40, 30, |u, v| [0.004 * u as f32, 0.004 * v as f32, -2.0])),
        scene(
            "points at the sensor",
            grid(40, 30, |u, v| match (u * 31 + v * 17) % 13 {
                0 => [0.0; 3],
                1 => [1e-25, 0.0, 1e-25],
                2 => [0.0, 0.0, 1e-38],
                _ => wall(u, v),
            }),
        ),
        scene("zeros as holes", grid(40, 30, |u, v| if v % 3 == 0 { [0.0; 3] } else { wall(u, v) })),
    ]
}
