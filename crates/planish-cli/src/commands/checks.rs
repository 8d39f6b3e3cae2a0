//! What the commands that write points have in common: what they refuse, what they report, how colours are written.

use std::path::Path;

use anyhow::{Result, bail};
use planish::PointCloud;
use planish::io::Format;
use planish_bench::errln;

/// A radius over this share of a cloud's extent is taken for a slip of units.
const MAX_RADIUS_SHARE: f32 = 0.2;
/// More neighbours of a point than this are taken for one too.
const MOST_NEIGHBOURS: f64 = 5000.0;
/// Clouds with fewer points may have any radius: they are done at once.
const FEW_POINTS: usize = 1000;

/// Refuses, before anything is read, an output of no known format, and an encoding that its format does not have.
pub fn check_output(output: &Path, encoding_is_given: bool) -> Result<()> {
    match (Format::of_extension(output), encoding_is_given) {
        (None, _) => {
            bail!("{}: cannot tell the format to write: end the name in {}", output.display(), planish::io::WRITTEN)
        }
        (Some(format @ (Format::Obj | Format::Stl)), _) => {
            let name = format.name();
            bail!("{}: {name} is read, not written: end the name in {}", output.display(), planish::io::WRITTEN)
        }
        (Some(Format::Pcd | Format::Ply), _) | (_, false) => Ok(()),
        (Some(format), true) => {
            bail!("{}: --encoding is for .pcd and .ply; {} has one encoding", output.display(), format.name())
        }
    }
}

/// Whether a name is that of a recording of ROS 2.
pub fn is_mcap(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
}

/// Refuses to write over a recording: what was measured may be in it alone.
pub fn check_is_new(output: &Path) -> Result<()> {
    if output.exists() {
        bail!("{}: is there already, and is not replaced: give another name, or remove it", output.display());
    }
    Ok(())
}

/// Refuses to write over the input, unless that was asked for; `None` where it cannot be.
pub fn check_not_input(input: &Path, output: &Path, overwrite: Option<bool>) -> Result<()> {
    let can_overwrite = overwrite.is_some();
    if overwrite != Some(true) && is_same_file(input, output) {
        bail!(
            "{}: is the input, the only copy of what was measured: write to another file{}",
            output.display(),
            if can_overwrite { ", or add --overwrite" } else { "" }
        );
    }
    Ok(())
}

/// Refuses to write over the settings.
pub fn check_not_settings(settings: Option<&Path>, output: &Path) -> Result<()> {
    if settings.is_some_and(|settings| is_same_file(settings, output)) {
        bail!("{}: is the file of the settings: write to another file", output.display());
    }
    Ok(())
}

/// Whether two names stand for one file, by links of either kind.
fn is_same_file(a: &Path, b: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let identity = |path: &Path| std::fs::metadata(path).map(|metadata| (metadata.dev(), metadata.ino())).ok();
        identity(a).is_some_and(|a| identity(b) == Some(a))
    }
    #[cfg(not(unix))]
    a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
}

/// Refuses a radius that is out of all proportion to the cloud: each point would have most others as neighbours, or
/// thousands.
pub fn check_radius(input: &Path, cloud: &PointCloud, radius_m: f32) -> Result<()> {
    let extent_m = cloud.extent_m().into_iter().fold(0.0, f32::max);
    if cloud.valid_points() < FEW_POINTS {
        return Ok(());
    }
    if radius_m <= MAX_RADIUS_SHARE * extent_m {
        let neighbours = cloud.mean_neighbours(radius_m);
        if neighbours > MOST_NEIGHBOURS {
            bail!(
                "{}: within {radius_m} m each point has some {neighbours:.0} others, which would take long and flatten the \
                 surface: give a smaller --radius in the file's unit (the cloud is {extent_m} m wide), or add --force",
                input.display()
            );
        }
        return Ok(());
    }
    let slip = if extent_m < 2.0 { "is the cloud in kilometres?" } else { "is the radius in millimetres?" };
    bail!(
        "{}: a radius of {radius_m} m on a cloud {extent_m} m wide would take long and flatten all of it ({slip}): give a \
         smaller --radius in the file's unit, or add --force",
        input.display()
    );
}

/// Reports what was left out of a file, or taken for something that its name does not say.
pub fn report_notes(input: &Path, notes: &[String]) {
    for note in notes {
        errln!("{}: {note}", input.display());
    }
}

/// Reports what the columns of lines of text were taken for.
pub fn report_columns(input: &Path, format: Format, cloud: &PointCloud) {
    const MOST: usize = 12;
    if !matches!(format, Format::Text | Format::Csv) {
        return;
    }
    let names = cloud.attributes.iter().map(|attribute| attribute.name.as_str());
    let columns: Vec<&str> = ["x", "y", "z"].into_iter().chain(names).collect();
    let more = columns.len().checked_sub(MOST).filter(|more| *more > 0);
    let more = more.map_or(String::new(), |more| format!(" and {more} more"));
    errln!("{}: columns taken as {}{more}", input.display(), columns[..columns.len().min(MOST)].join(" "));
}

/// Reports holes and fields that the format to write has no place for.
pub fn report_losses(output: &Path, cloud: &PointCloud) {
    if matches!(Format::of_extension(output), Some(Format::Las | Format::Laz)) {
        let holes = cloud.len() - cloud.valid_points();
        if holes > 0 {
            errln!("{}: {holes} holes are left out, since LAS has no place for them", output.display());
        }
    }
    if Format::of_extension(output) == Some(Format::Npy) && !cloud.attributes.is_empty() {
        let fields = cloud.attributes.len();
        errln!("{}: {fields} fields are left out, since NPY has no place for them (write .npz)", output.display());
    }
}

/// Puts colours, and intensities, as the format to write has them.
pub fn convert_fields(cloud: &mut PointCloud, read: Format, output: &Path) {
    match Format::of_extension(output) {
        Some(Format::Ply) if read != Format::Ply => cloud.unpack_colour(),
        Some(Format::Pcd) if read == Format::Ply => cloud.pack_colour(),
        Some(Format::Las | Format::Laz) if !matches!(read, Format::Las | Format::Laz) && cloud.scale_intensity() => {
            errln!("{}: intensities from 0 to 1 become 0 to 65535, as LAS has them", output.display());
        }
        _ => {}
    }
}
