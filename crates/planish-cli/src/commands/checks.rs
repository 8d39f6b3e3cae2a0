//! Checks, reports and field conversions shared by the commands that write points.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use planish::io::{self, Format, LengthUnit};
use planish::{PointCloud, Precision};
use planish_bench::errln;

/// Ratio of the radius to the cloud's extent above which the radius is probably in the wrong unit.
const MAX_RADIUS_SHARE: f32 = 0.2;
/// Mean number of neighbours above which the radius is probably in the wrong unit.
const MOST_NEIGHBOURS: f64 = 5000.0;
/// Number of points below which any radius is accepted, since such small clouds are smoothed quickly.
const FEW_POINTS: usize = 1000;

/// Returns an error if the output's format is unknown or cannot be written, or if an encoding is given that the
/// format does not support. Commands call this before they read anything.
pub fn check_output(output: &Path, encoding_is_given: bool) -> Result<()> {
    match (Format::of_extension(output), encoding_is_given) {
        (None, _) => {
            bail!("{}: unknown file extension; expected {}", output.display(), planish::io::WRITTEN)
        }
        (Some(format), _) if !format.is_written() => {
            let name = format.name();
            bail!(
                "{}: {name} can be read but not written; expected the extension {}",
                output.display(),
                planish::io::WRITTEN
            )
        }
        (Some(Format::Pcd | Format::Ply), _) | (_, false) => Ok(()),
        (Some(format), true) => {
            bail!("{}: --encoding applies to .pcd and .ply; {} has only one encoding", output.display(), format.name())
        }
    }
}

/// Returns true if the file name has the extension of an MCAP recording.
pub fn is_mcap(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
}

/// Refuses to overwrite a recording, finished or not; it may be the only copy of its measurements.
pub fn check_is_new(output: &Path) -> Result<()> {
    if output.exists() {
        bail!("{}: already exists; choose another name or delete it", output.display());
    }
    #[cfg(feature = "mcap")]
    planish::bag::refuse_cut_off(output)?;
    Ok(())
}

/// Refuses to overwrite the input or a read-only file unless `overwrite` is `Some(true)`. Commands without
/// `--overwrite` pass `None`.
pub fn check_not_input(input: &Path, output: &Path, overwrite: Option<bool>) -> Result<()> {
    if overwrite == Some(true) {
        io::replace_read_only_files();
        return Ok(());
    }
    let hint = if overwrite.is_some() { ", or add --overwrite" } else { "" };
    if io::is_same_file(input, output) {
        bail!("{}: the output is the input; write to another file{hint}", output.display());
    }
    if io::is_read_only(output) {
        bail!("{}: the file is read-only; write to another file{hint}", output.display());
    }
    Ok(())
}

/// Reports the unit of a cloud that is not in metres, since lengths such as radii are in that unit.
pub fn report_unit(input: &Path, cloud: &PointCloud) {
    let unit = LengthUnit::of_cloud(cloud);
    if !unit.is_metre() {
        let symbol = unit.symbol;
        errln!(
            "{}: coordinates, and lengths such as radii and voxels, are in units of the {unit} ({symbol})",
            input.display()
        );
    }
}

/// Refuses to overwrite a file with settings, a camera or poses that the command reads in addition to the input.
pub fn check_not_beside<'a>(files: impl IntoIterator<Item = &'a Option<PathBuf>>, output: &Path) -> Result<()> {
    if files.into_iter().flatten().any(|file| io::is_same_file(file, output)) {
        bail!("{}: the output is also read (settings, camera or poses); write to another file", output.display());
    }
    Ok(())
}

/// Refuses a radius that is far too large for the cloud: each point would have thousands of neighbours, or most of
/// the cloud.
pub fn check_radius(input: &Path, cloud: &PointCloud, radius_m: f32) -> Result<()> {
    let extent_m = cloud.extent_m().into_iter().fold(0.0, f32::max);
    if cloud.valid_points() < FEW_POINTS {
        return Ok(());
    }
    if radius_m <= MAX_RADIUS_SHARE * extent_m {
        let neighbours = cloud.mean_neighbours(radius_m);
        if neighbours > MOST_NEIGHBOURS {
            bail!(
                "{}: a radius of {radius_m} m covers about {neighbours:.0} points, so smoothing would take long and \
                 flatten the surface; choose a smaller --radius in the file's unit (the cloud is {extent_m} m wide), \
                 or add --force",
                input.display()
            );
        }
        return Ok(());
    }
    let slip = if extent_m < 2.0 { "the cloud may be in kilometres" } else { "the radius may be in millimetres" };
    bail!(
        "{}: a radius of {radius_m} m is too large for a cloud {extent_m} m wide and would flatten everything \
         ({slip}); choose a smaller --radius in the file's unit, or add --force",
        input.display()
    );
}

/// Refuses `--unit` for a file larger than memory, since the parts of such a file are not converted.
pub fn refuse_unit(reading: &crate::args::ReadArgs, input: &Path) -> Result<()> {
    if reading.unit.is_some_and(|unit| !unit.is_metre()) {
        bail!("{}: --unit cannot be applied to a file larger than --max-memory; raise --max-memory", input.display());
    }
    Ok(())
}

/// Reports dropped data, and contents that contradict the file's name.
pub fn report_notes(input: &Path, notes: &[String]) {
    for note in notes {
        errln!("{}: {note}", input.display());
    }
}

/// Reports the meaning assumed for the columns of a text file.
pub fn report_columns(input: &Path, format: Format, cloud: &PointCloud) {
    const MOST: usize = 12;
    if !matches!(format, Format::Text | Format::Csv) {
        return;
    }
    let names = cloud.attributes.iter().map(|attribute| attribute.name.as_str());
    let columns: Vec<&str> = ["x", "y", "z"].into_iter().chain(names).collect();
    let more = columns.len().checked_sub(MOST).filter(|more| *more > 0);
    let more = more.map_or(String::new(), |more| format!(" and {more} more"));
    errln!("{}: columns are read as {}{more}", input.display(), columns[..columns.len().min(MOST)].join(" "));
}

/// Reports holes and fields that the output format cannot represent.
pub fn report_losses(output: &Path, cloud: &PointCloud) {
    let losses = Format::of_extension(output).map_or(Vec::new(), |to| io::losses(cloud, to));
    report_notes(output, &losses);
}

/// Converts colours, intensities and the precision of coordinates for readers of the output format.
pub fn convert_fields(cloud: &mut PointCloud, read: Format, output: &Path, precision: Option<Precision>) {
    if let Some(to) = Format::of_extension(output) {
        report_notes(output, &io::adapt_fields(cloud, read, to, precision));
    }
}
