//! The commands, one file each.

pub mod bench;
mod checks;
pub mod clean;
pub mod convert;
pub mod demo;
pub mod devices;
pub mod evaluate;
pub mod info;
pub mod manual;
pub mod mesh;
pub mod record;
pub mod recover;
pub mod render;
pub mod rig;
pub mod smooth;
mod sources;
mod status_line;
pub mod stream;
pub mod view;

pub use checks::check_output;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::OrganizedCloud;
use planish::doubt_about_lens;
use planish::io::{self, Contents, FileRead};
use planish_bench::errln;

use crate::args::{CameraArgs, MemoryArgs, StreamArgs};
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

/// Returns the milliseconds since `start`.
fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

/// Reads a file. Returns it, and the camera options with the camera that the file contains, if any.
fn read_input(file: &Path, options: &io::ReadOptions, camera: &CameraArgs) -> Result<(FileRead, CameraArgs)> {
    let options = options.with_depth_units_per_metre(camera.depth_units_per_metre);
    let read = io::read_file(file, &options)?;
    let camera = camera.or(read.camera);
    Ok((read, camera))
}

/// Reads a file for the given kind of work, within the memory limit.
fn read_within(memory: &MemoryArgs, work: io::Work, file: &Path) -> Result<Contents> {
    let options = memory.options();
    let contents = io::read_with(file, &options)?.1;
    check_work(work, &contents, &options, file)?;
    Ok(contents)
}

/// Returns an error if the work needs more memory than allowed.
fn check_work(work: io::Work, contents: &Contents, options: &io::ReadOptions, file: &Path) -> Result<()> {
    options.check_work_on(work, contents).with_context(|| file.display().to_string())
}

/// Returns the organized cloud in a file's contents; depth is deprojected with the given camera. Reports a lens model
/// that loses pixels.
fn organized(contents: Contents, camera: &CameraArgs, file: &Path) -> Result<OrganizedCloud> {
    let is_depth = contents.is_depth();
    let cloud = organized_for_session(contents, camera, file)?;
    if let Some(doubt) = cloud.camera.filter(|_| is_depth).as_ref().and_then(doubt_about_lens) {
        errln!("{}: {doubt}", file.display());
    }
    Ok(cloud)
}

/// Same as [`organized`], for a session, which reports the lens model itself.
fn organized_for_session(contents: Contents, camera: &CameraArgs, file: &Path) -> Result<OrganizedCloud> {
    let shape = contents.shape();
    let camera = if contents.is_depth() { Some(camera.required(shape, file)?) } else { camera.camera(shape)? };
    contents.into_organized(camera.as_ref()).with_context(|| file.display().to_string())
}
