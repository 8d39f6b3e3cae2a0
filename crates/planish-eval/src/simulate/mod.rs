//! Simulated frames with known ground truth: seeded scenes, ray-cast without noise, to which a noise model of a sensor
//! is applied (a Kinect v1, a stereo or a time-of-flight camera).
//!
//! As with real sensors, the noise is correlated between pixels, quantized, and grows with range. On noise that is
//! independent between pixels, filters look far better than they are.
//!
//! ```
//! use planish_core::Camera;
//! use planish_eval::simulate::{DepthNoise, DepthSimulator, Scene};
//!
//! let camera = Camera::new((160, 120), [131.0; 2], [79.5, 59.5]);
//! let (scene, pose) = Scene::tabletop(1);
//! let truth = scene.render(&camera, &pose);
//! let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).unwrap();
//! assert_eq!(frame.raw.len(), 160 * 120);
//! ```

mod random;
mod rig;
mod scene;
mod scenes;
mod sensor;
mod sequence;

#[doc(hidden)]
pub use planish_core::Camera;
#[doc(hidden)]
pub use random::Random;
pub use rig::{PoseErrors, RigScene};
pub use scene::{NO_OBJECT, Pose, Scene, Shape, Truth};
pub use scenes::{CURVES_RANGES_M, Curve, Gauge};
pub use sensor::{DepthNoise, DepthSimulator, ErrorUnit};
pub use sequence::{Event, Sequence, SequenceFrame};
