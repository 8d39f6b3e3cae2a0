//! A simulated camera moving through a scene.

use std::f64::consts::TAU;

use super::{OwnedFrame, Source};
use planish_core::{Camera, DepthFrame, Error};
use planish_eval::simulate::{DepthNoise, DepthSimulator, Pose, Scene, Truth};

/// Number of frames per round of the camera, 2 s at 30 frames/s.
const ROUND: u64 = 60;

/// A simulated Kinect v1 that circles endlessly in front of a table, with timestamps at 30 frames/s.
///
/// The first round is rendered when the source is opened, since rendering takes longer than smoothing; later rounds
/// repeat it.
pub struct SyntheticSource {
    scene: Scene,
    start: Pose,
    camera: Camera,
    round: Vec<DepthFrame>,
    next: u64,
}

impl SyntheticSource {
    /// Frame rate of the timestamps, in frames per second.
    pub const FPS: f64 = 30.0;

    /// Renders a round of the scene with this seed.
    pub fn new(seed: u64, camera: Camera) -> Result<Self, Error> {
        Self::of_frames(seed, camera, ROUND)
    }

    /// Renders only the first `frames` frames, at most one round; later frames repeat them.
    pub fn of_frames(seed: u64, camera: Camera, frames: u64) -> Result<Self, Error> {
        camera.validate()?;
        let (scene, start) = Scene::tabletop(seed);
        let mut source = Self { scene, start, camera, round: Vec::new(), next: 0 };
        let simulator = DepthSimulator::new(DepthNoise::default(), camera, seed);
        source.round =
            (0..frames.clamp(1, ROUND)).map(|i| simulator.frame(&source.truth(i), i)).collect::<Result<_, _>>()?;
        Ok(source)
    }

    /// Returns the noise-free frame at `index` of a full round.
    pub fn truth(&self, index: u64) -> Truth {
        let turn = TAU * (index % ROUND) as f64 / ROUND as f64;
        let pose = self.start.moved([0.08 * turn.sin(), 0.03 * turn.cos(), 0.0]);
        self.scene.render(&self.camera, &pose)
    }
}

impl Source for SyntheticSource {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let mut frame = self.round[(self.next % self.round.len() as u64) as usize].clone();
        frame.timestamp_s = Some(self.next as f64 / Self::FPS);
        self.next += 1;
        Ok(Some(OwnedFrame::Depth(frame)))
    }
}
