//! `planish render`: the relief of an organized cloud, and its colours.

use std::process::ExitCode;

use anyhow::Result;
use planish::internal::write_rgb_png;
use planish::io;
use planish::render::{colours, normals_of, relief, side_by_side};

use super::organized;
use crate::args::RenderArgs;

pub fn run(args: &RenderArgs) -> Result<ExitCode> {
    let (_, contents) = io::read_with(&args.file, &args.memory.read_options())?;
    let cloud = organized(contents, &args.camera, &args.file)?;
    let mut pictures = vec![relief(cloud.width(), cloud.height(), &normals_of(&cloud))];
    pictures.extend(colours(&cloud));
    write_rgb_png(&args.output, &side_by_side(&pictures))?;
    Ok(ExitCode::SUCCESS)
}
