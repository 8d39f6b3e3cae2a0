//! The frames on which methods are evaluated: seeded scenes with the noise of a Kinect v1, and the scores for each.

use crate::simulate::{CURVES_RANGES_M, Curve, DepthNoise, DepthSimulator, Gauge, Scene, Truth};
use planish_core::{Camera, DepthFrame, FrameError};

/// Six frames per seed: a table, a room, shapes of known size, and curved surfaces at three ranges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Suite {
    /// The camera; it has the field of view of a Kinect v1 at any resolution.
    pub camera: Camera,
    /// The sensor's noise.
    pub noise: DepthNoise,
}

impl Default for Suite {
    fn default() -> Self {
        Self { camera: Camera::kinect_v1(), noise: DepthNoise::default() }
    }
}

/// The scores that are computed on a frame.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Gauges {
    /// Surfaces and edges, by range and angle.
    Surfaces,
    /// Sizes and angles of known shapes.
    Shapes(Gauge),
    /// Curved surfaces, with their range in metres.
    Curves(Vec<Curve>, f64),
}

/// A simulated frame with its ground truth.
#[derive(Debug, Clone)]
pub struct Case {
    /// A name for use in file names: scene and seed.
    pub name: String,
    /// The noise-free frame.
    pub truth: Truth,
    /// The simulated frame.
    pub frame: DepthFrame,
    /// The noise of the frame.
    pub noise: DepthNoise,
    /// The scores that are computed on the frame.
    pub gauges: Gauges,
}

impl Suite {
    /// Returns the cases generated from a seed.
    pub fn cases(&self, seed: u64) -> Result<Vec<Case>, FrameError> {
        let (table, room, shapes) = (Scene::tabletop(seed), Scene::room(seed), Scene::gauges(seed));
        let gauge = shapes.2;
        let mut scenes = vec![
            ("table".to_owned(), (table.0, table.1), Gauges::Surfaces),
            ("room".to_owned(), (room.0, room.1), Gauges::Surfaces),
            ("shapes".to_owned(), (shapes.0, shapes.1), Gauges::Shapes(gauge)),
        ];
        for range_m in CURVES_RANGES_M {
            let (scene, pose, curves) = Scene::curves(seed, range_m);
            scenes.push((format!("curves-{range_m}m"), (scene, pose), Gauges::Curves(curves, range_m)));
        }
        let simulator = DepthSimulator::new(self.noise, self.camera, seed);
        let case = |(name, (scene, pose), gauges): (String, (Scene, _), _)| {
            let truth = scene.render(&self.camera, &pose);
            let frame = simulator.frame(&truth, 0)?;
            Ok(Case { name: format!("{name}-{seed}"), truth, frame, noise: self.noise, gauges })
        };
        scenes.into_iter().map(case).collect()
    }

    /// Returns frames from a static camera in front of a table, and their ground truth.
    pub fn still(&self, seed: u64, frames: u64) -> Result<(Truth, Vec<DepthFrame>), FrameError> {
        let (scene, pose) = Scene::tabletop(seed);
        let truth = scene.render(&self.camera, &pose);
        let simulator = DepthSimulator::new(self.noise, self.camera, seed);
        let frames = (0..frames).map(|index| simulator.frame(&truth, index)).collect::<Result<_, _>>()?;
        Ok((truth, frames))
    }
}
