//! `planish clean`: a box cut out, a cloud thinned, outliers removed.

use crate::exit::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::io::{self, CloudRef, Contents, FileRead, Format};
use planish::{Error, OrganizedCloud, Outputs, ParamError, PointCloud, PointsView, clean};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::checks::{check_not_input, check_output, convert_fields, report_columns, report_losses, report_notes};
use super::{ms_since, organized};
use crate::args::CleanArgs;

/// Number of points removed by each step.
#[derive(Serialize)]
struct Report {
    points_in: usize,
    outside_box: Option<usize>,
    /// Number of points replaced by another in the same voxel.
    merged: Option<usize>,
    statistical_outliers: Option<usize>,
    radius_outliers: Option<usize>,
    points_out: usize,
    read_ms: f64,
    clean_ms: f64,
    write_ms: f64,
}

/// Points, and the grid that they are on.
struct Cloud {
    points: PointCloud,
    grid: Option<(usize, usize)>,
}

pub fn run(args: &CleanArgs) -> Result<ExitCode> {
    let CleanArgs { input, output, .. } = args;
    if args.crop.is_none() && args.voxel.is_none() && args.statistical.is_none() && args.radius.is_none() {
        bail!("no step is given; use --crop, --voxel, --statistical or --radius-outliers");
    }
    check_output(output, args.encoding.is_some())?;
    if matches!(Format::of_extension(output), Some(Format::DepthPng | Format::DepthTiff)) {
        bail!("{}: an image cannot store points; end the name in .pcd or .ply", output.display());
    }
    check_not_input(input, output, Some(args.overwrite))?;
    let start = Instant::now();
    let FileRead { format, encoding, contents, notes, .. } = io::read_file(input, &args.memory.read_options())?;
    report_notes(input, &notes);
    let mut cloud = match contents {
        Contents::General(points) => {
            report_columns(input, format, &points);
            Cloud { points, grid: None }
        }
        contents => {
            let cloud = organized(contents, &args.camera, input)?;
            Cloud { grid: Some((cloud.width(), cloud.height())), points: cloud.points }
        }
    };
    convert_fields(&mut cloud.points, format, output);
    io::check_writable(output, &cloud.points, Outputs::POINTS)?;
    let read_ms = ms_since(start);

    let start = Instant::now();
    let mut report = cloud.clean(args).with_context(|| input.display().to_string())?;
    (report.read_ms, report.clean_ms) = (read_ms, ms_since(start));
    if report.points_out == 0 && report.points_in > 0 {
        bail!("{}: no points remain; nothing is written", input.display());
    }

    let start = Instant::now();
    report_losses(output, &cloud.points);
    let encoding = args.encoding.map(Into::into).or(encoding).unwrap_or_default();
    match cloud.grid {
        Some((width, height)) => {
            let cloud = OrganizedCloud::new(width, height, cloud.points).map_err(Error::from)?;
            io::write_cloud(output, CloudRef::Organized(&cloud), encoding)?;
        }
        None => io::write_cloud(output, CloudRef::General(&cloud.points), encoding)?,
    }
    report.write_ms = ms_since(start);
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print(args, &report);
    }
    Ok(ExitCode::SUCCESS)
}

impl Cloud {
    /// Applies the requested steps in order.
    fn clean(&mut self, args: &CleanArgs) -> Result<Report> {
        let points_in = self.points.valid_points();
        let holes = self.points.len() - points_in;
        if self.grid.is_none() && holes > 0 {
            errln!("{}: {holes} holes of an unorganized cloud are dropped", args.input.display());
            let is_hole: Vec<bool> = (0..self.points.len()).map(|i| !self.points.positions.is_finite(i)).collect();
            self.remove(&is_hole);
        }
        let outside_box = args.crop.map(|crop| {
            let is_outside = clean::cloud_outside_box(&self.points, crop.low, crop.high);
            let is_outside = is_outside.map_err(|error| ParamError { field: "--crop", ..error })?;
            anyhow::Ok(self.remove(&is_outside))
        });
        let outside_box = outside_box.transpose()?;
        let merged = args.voxel.map(|size_m| self.thin(args, size_m)).transpose()?;
        let statistical_outliers = args
            .statistical
            .map(|of| {
                self.remove_marked("K of --statistical", "R of --statistical", |view| {
                    clean::statistical_outliers(view, of.neighbours, of.deviations)
                })
            })
            .transpose()?;
        let radius_outliers = args
            .radius
            .map(|of| {
                self.remove_marked("N of --radius-outliers", "METRES of --radius-outliers", |view| {
                    clean::radius_outliers(view, of.radius_m, of.least)
                })
            })
            .transpose()?;
        let points_out = self.points.valid_points();
        let (read_ms, clean_ms, write_ms) = Default::default();
        Ok(Report {
            points_in,
            outside_box,
            merged,
            statistical_outliers,
            radius_outliers,
            points_out,
            read_ms,
            clean_ms,
            write_ms,
        })
    }

    /// Removes the points that an option marks; returns how many. Errors name the option's number of neighbours or its
    /// other value.
    fn remove_marked(
        &mut self,
        neighbours: &'static str,
        other: &'static str,
        mark: impl FnOnce(&PointsView<'_>) -> Result<Vec<bool>, ParamError>,
    ) -> Result<usize> {
        let is_marked = mark(&PointsView::from_cloud(&self.points).map_err(Error::from)?);
        let option = |field: &str| if field == "neighbours" { neighbours } else { other };
        let is_marked = is_marked.map_err(|error| ParamError { field: option(error.field), ..error })?;
        Ok(self.remove(&is_marked))
    }

    /// Makes holes of marked points on a grid, and leaves them out elsewhere; returns how many.
    fn remove(&mut self, is_marked: &[bool]) -> usize {
        if self.grid.is_some() {
            let marked = is_marked.iter().enumerate().filter(|(_, marked)| **marked);
            marked.for_each(|(i, _)| self.points.positions.set(i, [f32::NAN; 3]));
        } else {
            let kept: Vec<usize> = (0..is_marked.len()).filter(|&i| !is_marked[i]).collect();
            self.points = self.points.select(&kept);
        }
        is_marked.iter().filter(|marked| **marked).count()
    }

    fn thin(&mut self, args: &CleanArgs, size_m: f64) -> Result<usize> {
        let before = self.points.valid_points();
        if self.grid.take().is_some() {
            errln!("{}: with --voxel the output is unorganized", args.input.display());
        }
        let thinned = clean::voxel_downsample(&self.points, size_m);
        self.points = thinned.map_err(|error| ParamError { field: "--voxel", ..error })?;
        Ok(before - self.points.len())
    }
}

fn print(args: &CleanArgs, report: &Report) {
    outln!("{} -> {}", args.input.display(), args.output.display());
    let steps = [
        (report.outside_box, "outside the box"),
        (report.merged, "merged with others in their voxel"),
        (report.statistical_outliers, "statistical outliers"),
        (report.radius_outliers, "with too few neighbours within the radius"),
    ];
    let steps: String =
        steps.iter().filter_map(|(count, what)| count.map(|count| format!(", {count} {what}"))).collect();
    outln!("  {} points{steps}: {} remain", report.points_in, report.points_out);
    outln!("  read {:.1} ms, clean {:.2} ms, write {:.1} ms", report.read_ms, report.clean_ms, report.write_ms);
}
