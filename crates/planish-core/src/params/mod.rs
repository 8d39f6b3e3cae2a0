//! The parameters of the method: a struct for frames on a grid, one for unorganized clouds, and one shared by both.
//!
//! A parameter without effect on a kind of input is not a field of that kind's struct. Each default is defined once, in
//! the constructors of [`FrameParams`] and [`CloudParams`].

mod cloud;
mod engine;
mod fit;
mod frame;
mod kind;
mod strength;
mod window;

pub use cloud::{CloudParams, CloudRadius};
pub(crate) use engine::{EngineParams, Radius};
pub use fit::{Edges, Fit, Project};
pub use frame::{FrameParams, FrameRadius};
pub use kind::Params;
pub use strength::Strength;
pub use window::{Window, WindowSize};
