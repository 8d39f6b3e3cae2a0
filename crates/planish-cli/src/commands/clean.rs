//! `planish clean`: crops a cloud to a box, thins it, and removes outliers.

use crate::exit::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::clean::{CleanCounts, CleanSteps};
use planish::io::{self, CloudRef, Contents, FileRead, Format};
use planish::{Error, OrganizedCloud, Outputs, ParamError};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::checks::{
    check_not_beside, check_not_input, convert_fields, report_columns, report_losses, report_notes, report_unit,
};
use super::{check_work, ms_since, organized, read_input};
use crate::args::CleanArgs;

/// Number of points removed by each step, and the times.
#[derive(Serialize)]
struct Report {
    #[serde(flatten)]
    counts: CleanCounts,
    read_ms: f64,
    clean_ms: f64,
    write_ms: f64,
}

pub fn run(args: &CleanArgs) -> Result<ExitCode> {
    let CleanArgs { input, output, .. } = args;
    let steps = CleanSteps {
        crop_m: args.crop.map(|crop| [crop.low, crop.high]),
        voxel_m: args.voxel,
        statistical: args.statistical.map(|of| (of.neighbours, of.deviations)),
        radius: args.radius.map(|of| (of.radius_m, of.least)),
    };
    if steps.is_empty() {
        bail!("no step is given; use --crop, --voxel, --statistical or --radius-outliers");
    }
    args.encoding.check(output)?;
    if matches!(Format::of_extension(output), Some(Format::DepthPng | Format::DepthTiff)) {
        bail!("{}: an image cannot store points; end the name in .pcd or .ply", output.display());
    }
    check_not_input(input, output, Some(args.overwrite))?;
    check_not_beside([&args.camera.camera_file], output)?;
    let start = Instant::now();
    let (file, camera) = read_input(input, &args.reading.read_options(), &args.camera)?;
    let FileRead { format, encoding, contents, notes, .. } = file;
    report_notes(input, &notes);
    check_work(io::Work::Clean, &contents, &args.reading.read_options(), input)?;
    let (mut points, mut grid) = match contents {
        Contents::General(points) => {
            report_columns(input, format, &points);
            report_unit(input, &points);
            (points, None)
        }
        contents => {
            let cloud = organized(contents, &camera, input)?;
            let grid = (cloud.width(), cloud.height());
            (cloud.points, Some(grid))
        }
    };
    convert_fields(&mut points, format, output, args.encoding.precision());
    io::check_writable(output, &points, Outputs::POINTS)?;
    let read_ms = ms_since(start);

    let start = Instant::now();
    let had_grid = grid.is_some();
    let counts = steps.apply(&mut points, &mut grid).map_err(by_option).with_context(|| input.display().to_string())?;
    let clean_ms = ms_since(start);
    if counts.holes_dropped > 0 {
        errln!("{}: {} holes of an unorganized cloud are dropped", input.display(), counts.holes_dropped);
    }
    if had_grid && grid.is_none() {
        errln!("{}: with --voxel the output is unorganized", input.display());
    }
    if counts.points_out == 0 && counts.points_in > 0 {
        bail!("{}: no points remain; nothing is written", input.display());
    }

    let start = Instant::now();
    report_losses(output, &points);
    let encoding = args.encoding.encoding().or(encoding).unwrap_or_default();
    match grid {
        Some((width, height)) => {
            let cloud = OrganizedCloud::new(width, height, points).map_err(Error::from)?;
            io::write_cloud(output, CloudRef::Organized(&cloud), encoding)?;
        }
        None => io::write_cloud(output, CloudRef::General(&points), encoding)?,
    }
    let report = Report { counts, read_ms, clean_ms, write_ms: ms_since(start) };
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print(args, &report);
    }
    Ok(ExitCode::SUCCESS)
}

/// Replaces the field name in an error by the name of the field's option.
fn by_option(error: Error) -> Error {
    let Error::Param(error) = error else { return error };
    let field = match error.field {
        "crop" => "--crop",
        "voxel" => "--voxel",
        "statistical.neighbours" => "K of --statistical",
        "statistical.deviations" => "R of --statistical",
        "radius.neighbours" => "N of --radius-outliers",
        "radius.radius_m" => "METRES of --radius-outliers",
        other => other,
    };
    ParamError { field, ..error }.into()
}

fn print(args: &CleanArgs, report: &Report) {
    outln!("{} -> {}", args.input.display(), args.output.display());
    let counts = &report.counts;
    let steps = [
        (counts.outside_box, "outside the box"),
        (counts.merged, "merged with others in their voxel"),
        (counts.statistical_outliers, "statistical outliers"),
        (counts.radius_outliers, "with too few neighbours within the radius"),
    ];
    let steps: String =
        steps.iter().filter_map(|(count, what)| count.map(|count| format!(", {count} {what}"))).collect();
    outln!("  {} points{steps}: {} remain", counts.points_in, counts.points_out);
    outln!("  read {:.1} ms, clean {:.2} ms, write {:.1} ms", report.read_ms, report.clean_ms, report.write_ms);
}
