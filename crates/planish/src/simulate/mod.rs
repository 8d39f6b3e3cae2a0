//! Frames with known truth: seeded scenes, ray-cast without noise, and a model of the Kinect v1's noise on top.
//!
//! As with the real sensor, the noise is correlated between pixels, quantized, and grows with z²: on independent noise, filters
//! look far better than they are.
//!
//! ```
//! use planish::Camera;
//! use planish::simulate::{KinectNoise, KinectSimulator, Scene};
//!
//! let camera = Camera::new((160, 120), [131.0; 2], [79.5, 59.5]);
//! let (scene, pose) = Scene::tabletop(1);
//! let truth = scene.render(&camera, &pose);
//! let frame = KinectSimulator::new(KinectNoise::default(), camera, 1).frame(&truth, 0).unwrap();
//! assert_eq!(frame.raw.len(), 160 * 120);
//! ```

mod kinect;
mod random;
mod scene;
mod scenes;

/// The linear algebra of scenes and poses.
pub use glam::{DMat3, DVec3};
pub use kinect::{KinectNoise, KinectSimulator};
#[cfg(any(test, feature = "evaluate"))]
pub(crate) use random::Random;
pub use scene::{NO_OBJECT, Pose, Scene, Shape, Truth};
pub use scenes::Gauge;
