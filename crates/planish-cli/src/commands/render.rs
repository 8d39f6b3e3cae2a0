//! `planish render`: draws the relief of a cloud, and its colours.

use crate::exit::ExitCode;

use anyhow::{Result, bail};
use planish::io::write_rgb_png;
use planish::io::{Contents, FileRead, Work};
use planish::render::{colours, normals_of, relief, seen_from, side_by_side};
use planish::{FrameError, ParamError};

use super::checks::{check_not_beside, check_not_input, report_notes};
use super::{check_work, organized, read_input};
use crate::args::RenderArgs;

/// Length in pixels of the longer side of an unorganized cloud's picture.
const LONGEST_SIDE: usize = 1280;

pub fn run(args: &RenderArgs) -> Result<ExitCode> {
    if !args.output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
        bail!("{}: unsupported picture extension; expected .png", args.output.display());
    }
    check_not_input(&args.file, &args.output, None)?;
    check_not_beside([&args.camera.camera_file], &args.output)?;
    let (FileRead { contents, notes, .. }, camera) =
        read_input(&args.file, &args.reading.read_options(), &args.camera)?;
    report_notes(&args.file, &notes);
    let work = if matches!(contents, Contents::General(_)) { Work::RenderCloud } else { Work::Render };
    check_work(work, &contents, &args.reading.read_options(), &args.file)?;
    let cloud = match contents {
        Contents::General(points) => {
            seen_from(&points, args.from.unwrap_or_default().0, LONGEST_SIDE).map_err(|error| match error {
                FrameError::BadPose(problem) => anyhow::Error::from(ParamError { field: "--from", ..problem }),
                error => anyhow::Error::from(error).context(args.file.display().to_string()),
            })?
        }
        _ if args.from.is_some() => {
            bail!("{}: --from applies to unorganized clouds; this one is drawn from its sensor", args.file.display());
        }
        contents => organized(contents, &camera, &args.file)?,
    };
    let mut pictures = vec![relief(cloud.width(), cloud.height(), &normals_of(&cloud))];
    pictures.extend(colours(&cloud));
    write_rgb_png(&args.output, &side_by_side(&pictures))?;
    Ok(ExitCode::SUCCESS)
}
