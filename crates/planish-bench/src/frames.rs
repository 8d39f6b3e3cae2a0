//! The frames that the experiments run on: depth as a camera delivers it, or an organized cloud.

use anyhow::Result;
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthFrame, Error, Frame, IntoFrame, OrganizedCloud};

/// A frame with a name.
pub struct Input {
    /// Index among the inputs, since two frames may have the same name.
    pub(crate) index: usize,
    name: String,
    /// The depth image; `None` for an organized cloud.
    depth: Option<DepthFrame>,
    /// The organized cloud, or the points of the depth image.
    pub(crate) cloud: OrganizedCloud,
}

impl Input {
    /// Creates an input from a depth frame; `index` is its position among the inputs.
    ///
    /// # Errors
    /// If the frame is malformed.
    pub fn of_depth(index: usize, name: String, depth: DepthFrame) -> Result<Self> {
        let cloud = depth.deproject().map_err(Error::from)?;
        Ok(Self { index, name, depth: Some(depth), cloud })
    }

    /// Creates an input from an organized cloud; `index` is its position among the inputs.
    pub fn of_cloud(index: usize, name: String, cloud: OrganizedCloud) -> Self {
        Self { index, name, depth: None, cloud }
    }

    /// Returns the frame that engines smooth.
    pub(crate) fn frame(&self) -> Result<Frame<'_>> {
        let frame = self.depth.as_ref().map_or_else(|| (&self.cloud).into_frame(), |depth| depth.into_frame());
        Ok(frame.map_err(Error::from)?)
    }

    pub(crate) fn shape(&self) -> (usize, usize) {
        (self.cloud.width(), self.cloud.height())
    }

    /// Returns the name, shape and kind of the frame.
    pub(crate) fn describe(&self) -> String {
        let (width, height) = self.shape();
        let kind = if self.depth.is_some() { "16-bit depth" } else { "points" };
        format!("{}, {width}x{height} as {kind}", self.name)
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }
}

/// Returns the default frames of the experiments: a simulated room and a simulated table.
///
/// # Errors
/// If the simulator fails.
pub fn simulated_inputs() -> Result<Vec<Input>> {
    simulated_by(Camera::kinect_v1())
}

pub(crate) fn simulated_by(camera: Camera) -> Result<Vec<Input>> {
    let of_scene = |(index, (name, (scene, pose))): (usize, (&str, (Scene, _)))| {
        let truth = scene.render(&camera, &pose);
        let depth = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).map_err(Error::from)?;
        Input::of_depth(index, name.to_owned(), depth)
    };
    let scenes = [("simulated room", Scene::room(1)), ("simulated table", Scene::tabletop(1))];
    scenes.into_iter().enumerate().map(of_scene).collect()
}
