//! The commands, one file each.

pub mod bench;
pub mod demo;
pub mod devices;
pub mod evaluate;
pub mod info;
pub mod record;
pub mod render;
pub mod smooth;
pub mod stream;

use std::path::Path;
use std::time::Instant;

use anyhow::{Result, bail};
use planish::OrganizedCloud;
use planish::io::Contents;
use planish::{DepthFrame, DepthView, Error};

use crate::args::CameraArgs;

/// Milliseconds since `start`.
fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

/// The organized cloud that a file holds, deprojecting depth with the camera given.
fn organized(contents: Contents, camera: &CameraArgs, file: &Path) -> Result<OrganizedCloud> {
    let shape = contents.shape();
    match contents {
        Contents::Organized(mut cloud) => {
            cloud.camera = camera.camera(shape)?;
            Ok(cloud)
        }
        Contents::Depth(image) => {
            let frame = DepthFrame::from_image(camera.required(shape, file)?, image).map_err(Error::from)?;
            Ok(frame.deproject().map_err(Error::from)?)
        }
        Contents::DepthMetres { depth_m, .. } => {
            let camera = camera.required(shape, file)?;
            let view = DepthView::from_metres(&depth_m, &camera).map_err(Error::from)?;
            Ok(view.deproject().map_err(Error::from)?)
        }
        Contents::General(cloud) => bail!(
            "{}: a general cloud of {} points (its height is 1); an organized cloud or a depth image is needed",
            file.display(),
            cloud.len()
        ),
        _ => bail!("{}: not a frame of a kind that is known here", file.display()),
    }
}
