//! Simulated videos of a table, in which an object or the camera moves, or the noise changes.

use std::str::FromStr;

use glam::{DMat3, DVec3};

use super::random::Random;
use super::scene::{Pose, Scene, Shape, Truth};
use super::sensor::{DepthNoise, DepthSimulator};
use planish_core::{Camera, DepthFrame, FrameError, ParamError};

const STREAM_HOLES: u64 = 1 << 40;

/// An event in a simulated video: the motion of an object or the camera, or a property of the noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// No motion.
    Still,
    /// No motion; a fixed pattern makes up 70 % of the noise's variance.
    FixedPattern,
    /// No motion; in each frame, a random 30 % of the blocks of 8x8 pixels are holes.
    Holes,
    /// A box approaches the camera by 2 mm per frame.
    SlowObject,
    /// A ball crosses the picture at 25 mm per frame.
    FastObject,
    /// A pole 12 mm thick, about six pixels wide, moves sideways by 10 mm per frame.
    ThinPole,
    /// A box is alternately absent and present, for 12 frames each.
    Appearing,
    /// A handheld camera moves by about 8 mm and turns by about 0.3° per frame.
    MovingCamera,
}

impl Event {
    /// All events.
    pub const ALL: [Self; 8] = [
        Self::Still,
        Self::FixedPattern,
        Self::Holes,
        Self::SlowObject,
        Self::FastObject,
        Self::ThinPole,
        Self::Appearing,
        Self::MovingCamera,
    ];

    /// Returns the name of the event.
    pub fn name(self) -> &'static str {
        match self {
            Self::Still => "still",
            Self::FixedPattern => "fixed-pattern",
            Self::Holes => "flickering-holes",
            Self::SlowObject => "slow-object",
            Self::FastObject => "fast-object",
            Self::ThinPole => "thin-pole",
            Self::Appearing => "appearing-object",
            Self::MovingCamera => "moving-camera",
        }
    }
}

impl FromStr for Event {
    type Err = ParamError;

    /// Parses the [`name`](Self::name) of an event.
    fn from_str(text: &str) -> Result<Self, ParamError> {
        let allowed = "still, fixed-pattern, flickering-holes, slow-object, fast-object, thin-pole, appearing-object or \
                       moving-camera";
        let found = Self::ALL.into_iter().find(|event| event.name() == text);
        found.ok_or_else(|| ParamError { field: "sequence", value: text.to_owned(), allowed })
    }
}

/// A frame of a simulated video.
#[derive(Debug)]
pub struct SequenceFrame<'a> {
    /// The noise-free frame.
    pub truth: &'a Truth,
    /// The noisy frame.
    pub frame: DepthFrame,
    /// The camera's pose in the world.
    pub pose: Pose,
    /// Index of the moving object in the scene; `None` if it is absent.
    pub object: Option<u16>,
}

/// A simulated video, frame by frame.
pub struct Sequence {
    event: Event,
    camera: Camera,
    seed: u64,
    scene: Scene,
    pose: Pose,
    simulator: DepthSimulator,
    /// Scene, pose and noise-free image of the last frame.
    rendered: Option<(Scene, Pose, Truth)>,
}

impl Sequence {
    /// Creates a video of a table (0.6 to 1.5 m away) in front of a wall (2.2 to 2.8 m away).
    pub fn new(event: Event, camera: Camera, noise: DepthNoise, seed: u64) -> Self {
        let (scene, pose) = Scene::tabletop(seed);
        // If the noise of pixels were independent, smoothing in space would leave almost no flicker, unlike in real
        // videos.
        let noise = DepthNoise { temporal_correlation_px: noise.fixed_pattern_correlation_px, ..noise };
        let noise = match event {
            Event::FixedPattern => {
                let variance = noise.fixed_pattern_rms.powi(2) + noise.temporal_rms.powi(2);
                let (fixed_pattern_rms, temporal_rms) = ((0.7 * variance).sqrt(), (0.3 * variance).sqrt());
                DepthNoise { fixed_pattern_rms, temporal_rms, ..noise }
            }
            _ => noise,
        };
        let simulator = DepthSimulator::new(noise, camera, seed);
        Self { event, camera, seed, scene, pose, simulator, rendered: None }
    }

    /// Renders a frame.
    ///
    /// # Errors
    /// If the camera is invalid.
    pub fn frame(&mut self, number: u64) -> Result<SequenceFrame<'_>, FrameError> {
        let pose = self.pose_at(number);
        let mut scene = self.scene.clone();
        let object = self.object_at(number).map(|shape| {
            scene.objects.push(shape);
            (scene.objects.len() - 1) as u16
        });
        let (camera, before) = (self.camera, self.rendered.take());
        let same = before.filter(|(before, seen_from, _)| *before == scene && *seen_from == pose);
        let (_, _, truth) = self.rendered.insert(same.unwrap_or_else(|| {
            let truth = scene.render(&camera, &pose);
            (scene, pose, truth)
        }));
        let mut frame = self.simulator.frame(truth, number)?;
        if self.event == Event::Holes {
            let mut random = Random::new(self.seed, STREAM_HOLES + number);
            let across = camera.width.div_ceil(8);
            let lost: Vec<bool> = (0..across * camera.height.div_ceil(8)).map(|_| random.uniform() < 0.3).collect();
            for (i, raw) in frame.raw.iter_mut().enumerate() {
                if lost[i / camera.width / 8 * across + i % camera.width / 8] {
                    *raw = 0;
                }
            }
        }
        Ok(SequenceFrame { truth, frame, pose, object })
    }

    fn pose_at(&self, number: u64) -> Pose {
        if self.event != Event::MovingCamera {
            return self.pose;
        }
        // The camera moves by about 8 mm and turns by about 0.3° per frame at any time.
        let phase = number as f64 / 12.0;
        let offset = [0.096 * phase.sin(), 0.06 * (1.3 * phase).cos(), 0.05 * (0.7 * phase).sin()];
        let turn = DMat3::from_rotation_y(0.08 * (0.9 * phase).sin()) * DMat3::from_rotation_x(0.05 * phase.cos());
        let moved = self.pose.moved(offset);
        Pose { world_from_camera: moved.world_from_camera * turn, ..moved }
    }

    /// Returns the moving object, placed in front of the camera; `None` if there is none in this frame.
    fn object_at(&self, number: u64) -> Option<Shape> {
        let t = number as f64;
        let place = |x, y, z| self.pose.to_world([x, y, z]);
        // Moves back and forth between -1 and 1, by `step` per frame.
        let to_and_fro = |step: f64| 1.0 - ((step * t).rem_euclid(4.0) - 2.0).abs();
        let box_at = |centre_m, half_m| Shape::Cuboid {
            centre_m,
            half_extent_m: [half_m; 3],
            axes: (self.pose.world_from_camera * DMat3::from_rotation_y(0.2)).to_cols_array_2d(),
        };
        match self.event {
            Event::SlowObject => Some(box_at(place(-0.12, 0.02, 0.88 - 0.002 * t), 0.08)),
            Event::FastObject => {
                let centre_m = place(0.3 * to_and_fro(0.025 / 0.3), 0.0, 0.75);
                Some(Shape::Sphere { centre_m, radius_m: 0.08 })
            }
            Event::ThinPole => {
                let centre_m = place(0.3 * to_and_fro(0.01 / 0.3), 0.0, 0.9);
                let axis = (self.pose.world_from_camera * DVec3::Y).to_array();
                Some(Shape::Cylinder { centre_m, axis, radius_m: 0.006, half_height_m: 0.15 })
            }
            Event::Appearing => (number / 12 % 2 == 1).then(|| box_at(place(0.1, 0.0, 0.8), 0.08)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_and_cameras_move_as_stated() {
        let camera = Camera::new((160, 120), [131.0; 2], [79.5, 59.5]);
        for event in Event::ALL {
            let mut sequence = Sequence::new(event, camera, DepthNoise::default(), 1);
            let (mut moved_m, mut turned_deg, mut last) = (0.0, 0.0, None);
            for number in 0..36 {
                let seen = sequence.frame(number).unwrap();
                let shown = seen.object.map_or(0, |id| seen.truth.objects.iter().filter(|&&other| other == id).count());
                match event {
                    Event::SlowObject | Event::FastObject | Event::ThinPole => assert!(shown > 20, "{event:?} {shown}"),
                    Event::Appearing => assert_eq!(shown > 50, number / 12 == 1),
                    _ => assert_eq!(seen.object, None),
                }
                let holes = seen.frame.raw.iter().filter(|&&raw| raw == 0).count() as f64 / (160.0 * 120.0);
                assert_eq!(holes > 0.25, event == Event::Holes, "{event:?}: {holes}");
                let pose = seen.pose;
                if let Some(Pose { position, world_from_camera }) = last.replace(pose) {
                    moved_m += (pose.position - position).length() / 35.0;
                    let turn: DMat3 = world_from_camera.transpose() * pose.world_from_camera;
                    turned_deg +=
                        (0.5 * (turn.col(0).x + turn.col(1).y + turn.col(2).z) - 0.5).acos().to_degrees() / 35.0;
                }
            }
            let is_carried = event == Event::MovingCamera;
            assert_eq!((0.006..0.01).contains(&moved_m), is_carried, "{event:?}: {moved_m}");
            assert_eq!((0.2..0.4).contains(&turned_deg), is_carried, "{event:?}: {turned_deg}");
        }
    }

    #[test]
    fn frames_can_be_rendered_again() {
        let camera = Camera::new((160, 120), [131.0; 2], [79.5, 59.5]);
        let sequence = || Sequence::new(Event::MovingCamera, camera, DepthNoise::default(), 3);
        let (mut one, mut other) = (sequence(), sequence());
        one.frame(0).unwrap();
        assert_eq!(one.frame(5).unwrap().frame, other.frame(5).unwrap().frame);
    }
}
