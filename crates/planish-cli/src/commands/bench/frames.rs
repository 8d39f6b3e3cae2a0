//! The frames that the experiments run on: depth as a camera gives it, or an organized cloud.

use std::path::PathBuf;

use anyhow::Result;
use planish::io::{self, Contents};
use planish::simulate::{KinectNoise, KinectSimulator, Scene};
use planish::{Camera, DepthFrame, Error, Frame, OrganizedCloud};

use crate::args::ExperimentArgs;
use crate::commands::organized;

/// A frame under a name.
pub struct Input {
    /// Its place among the others: two may have one name.
    pub index: usize,
    name: String,
    /// Where the frame is depth.
    depth: Option<DepthFrame>,
    /// The frame, or what its depth is as points.
    pub cloud: OrganizedCloud,
}

impl Input {
    fn of_depth(index: usize, name: String, depth: DepthFrame) -> Result<Self> {
        let cloud = depth.deproject().map_err(Error::from)?;
        Ok(Self { index, name, depth: Some(depth), cloud })
    }

    /// What the engines are given.
    pub fn frame(&self) -> Frame<'_> {
        self.depth.as_ref().map_or(Frame::from(&self.cloud), Frame::from)
    }

    pub fn shape(&self) -> (usize, usize) {
        (self.cloud.width(), self.cloud.height())
    }

    /// Its name, shape and kind.
    pub fn describe(&self) -> String {
        let (width, height) = self.shape();
        let kind = if self.depth.is_some() { "16-bit depth" } else { "points" };
        format!("{}, {width}x{height} as {kind}", self.name)
    }

    pub fn name(&self) -> &str {
        &self.name
    }
}

/// The frames that the user gave, or a simulated room and a simulated table.
pub fn inputs(args: &ExperimentArgs) -> Result<Vec<Input>> {
    let of_file = |(index, file): (usize, &PathBuf)| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match io::read(file)?.1 {
            Contents::Depth(image) => {
                let camera = args.camera.required((image.width, image.height), file)?;
                Input::of_depth(index, name, DepthFrame::new(camera, image).map_err(Error::from)?)
            }
            contents => Ok(Input { index, name, depth: None, cloud: organized(contents, &args.camera, file)? }),
        }
    };
    if !args.input.is_empty() {
        return args.input.iter().enumerate().map(of_file).collect();
    }
    let camera = Camera::kinect_v1();
    let of_scene = |(index, (name, (scene, pose))): (usize, (&str, (Scene, _)))| {
        let truth = scene.render(&camera, &pose);
        let depth = KinectSimulator::new(KinectNoise::default(), camera, 1).frame(&truth, 0).map_err(Error::from)?;
        Input::of_depth(index, name.to_owned(), depth)
    };
    let scenes = [("simulated room", Scene::room(1)), ("simulated table", Scene::tabletop(1))];
    scenes.into_iter().enumerate().map(of_scene).collect()
}
