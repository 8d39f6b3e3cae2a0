//! The commands, one file each.

pub mod bench;
mod checks;
pub mod clean;
pub mod demo;
pub mod devices;
pub mod evaluate;
pub mod info;
pub mod manual;
pub mod record;
pub mod render;
pub mod rig;
pub mod smooth;
mod sources;
mod status_line;
pub mod stream;

use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::OrganizedCloud;
use planish::io::Contents;
use planish::{Camera, DepthFrame, DepthView, Error, PointsView, RangeRule};

use crate::args::{CameraArgs, StreamArgs};
use crate::exit::ExitCode;

/// Streams a source, or a rig.
pub fn stream(args: &StreamArgs) -> Result<ExitCode> {
    if args.format.is_some() && args.save.is_none() && args.save_cameras.is_none() {
        bail!("--format needs --save");
    }
    match &args.rig {
        Some(rig) => rig::stream(args, rig),
        None => stream::run(args),
    }
}

/// Milliseconds since `start`.
fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

/// Returns the organized cloud that a file holds, deprojecting depth with the camera given.
fn organized(contents: Contents, camera: &CameraArgs, file: &Path) -> Result<OrganizedCloud> {
    let shape = contents.shape();
    match contents {
        Contents::Organized(mut cloud) => {
            if let Some(camera) = camera.camera(shape)? {
                check_camera(&cloud, &camera).with_context(|| file.display().to_string())?;
                cloud.camera = Some(camera);
            }
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
            "{}: an unorganized cloud of {} points (height 1); an organized cloud or a depth image is needed",
            file.display(),
            cloud.len()
        ),
        _ => bail!("{}: contains neither depth nor points", file.display()),
    }
}

/// A camera whose focal length differs from that of the points by more than this factor is not theirs.
const FOCAL_LENGTH_FACTOR: f64 = 1.25;

/// Refuses a camera that contradicts the points of a cloud.
fn check_camera(cloud: &OrganizedCloud, camera: &Camera) -> Result<()> {
    let view = PointsView::from_organized(cloud).map_err(Error::from)?;
    match view.range_rule() {
        RangeRule::Depth { pitch_at_1m: Some(pitch) } => {
            let ratio = camera.fx * pitch;
            if !(1.0 / FOCAL_LENGTH_FACTOR..=FOCAL_LENGTH_FACTOR).contains(&ratio) {
                bail!(
                    "the camera has fx = {}, but the points {:.1}; give the camera of this cloud, or none",
                    camera.fx,
                    1.0 / pitch
                );
            }
        }
        RangeRule::Depth { .. } => {}
        _ => bail!("the grid does not match a camera in this frame; give --sensor-pose, or no camera"),
    }
    Ok(())
}
