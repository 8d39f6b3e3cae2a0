//! `planish convert`, `compare` and `merge`, which do not smooth.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use planish::compare::{Comparison, Distances, Matching};
use planish::io::{self, Contents, ConvertOptions, FileRead, Format, read_trajectory_with};
use planish::{Camera, DepthView, Error, IntoFrame, PointCloud, SensorPose, rig};
use planish_bench::{errln, outln};
use serde_json::json;

use super::checks::{check_not_beside, check_not_input, report_columns, report_notes};
use super::{check_work, organized, read_input};
use crate::args::{CameraArgs, CompareArgs, ConvertArgs, MergeArgs};
use crate::exit::ExitCode;

/// Converts a file.
pub fn convert(args: &ConvertArgs) -> Result<ExitCode> {
    let ConvertArgs { input, output, .. } = args;
    args.encoding.check(output)?;
    check_not_input(input, output, Some(args.overwrite))?;
    check_not_beside([&args.camera.camera_file], output)?;
    let (mut file, camera) = read_input(input, &args.reading.read_options(), &args.camera)?;
    report_notes(input, &std::mem::take(&mut file.notes));
    if let Contents::General(cloud) = &file.contents {
        report_columns(input, file.format, cloud);
    }
    let shape = file.contents.shape();
    let stays_depth = match Format::of_extension(output) {
        Some(Format::DepthPng | Format::DepthTiff) => true,
        Some(Format::Npy) => file.contents.is_depth(),
        _ => false,
    };
    if !stays_depth {
        let is_binary = args.encoding.encoding() != Some(io::Encoding::Ascii);
        let work = match Format::of_extension(output) {
            Some(Format::Pcd | Format::Ply) if is_binary => io::Work::Convert,
            _ => io::Work::Encode,
        };
        check_work(work, &file.contents, &args.reading.read_options(), input)?;
    }
    let camera = match (file.contents.is_depth(), stays_depth) {
        (true, false) => Some(camera.required(shape, input)?),
        _ => camera.camera(shape)?,
    };
    question(input, &file.contents, camera.as_ref());
    let fields = (!args.fields.is_empty()).then(|| match &args.fields[..] {
        [none] if none == "none" => Vec::new(),
        names => names.to_vec(),
    });
    let options = ConvertOptions::default()
        .with_camera(camera)
        .with_depth_units_per_metre(args.camera.depth_units_per_metre.filter(|_| !file.contents.is_depth()))
        .with_drop_holes(args.drop_holes)
        .with_fields(fields)
        .with_encoding(args.encoding.encoding())
        .with_precision(args.encoding.precision());
    let report = io::convert(file, output, &options)?;
    report_notes(output, &report.notes);
    let (width, height) = report.shape;
    let (from, to, valid) = (report.from.name(), report.to.name(), report.valid);
    if args.json {
        let report = json!({
            "input": input, "output": output, "from": from, "to": to, "width": width, "height": height,
            "valid": valid, "notes": report.notes,
        });
        outln!("{report}");
    } else {
        let holes = width * height - valid;
        let size = if height > 1 { format!("{width}x{height}, ") } else { String::new() };
        let points = format!("{size}{valid} points, {holes} holes");
        outln!("{} -> {}: {from} to {to}, {points}", input.display(), output.display());
    }
    Ok(ExitCode::SUCCESS)
}

/// Reports doubts about a depth image and its camera.
fn question(input: &Path, contents: &Contents, camera: Option<&Camera>) {
    let Some(camera) = camera else { return };
    let doubts = match contents {
        Contents::Depth(image) => {
            DepthView::new(&image.raw, camera).and_then(IntoFrame::into_frame).map(planish::doubts)
        }
        Contents::DepthMetres { depth_m, .. } => {
            DepthView::from_metres(depth_m, camera).and_then(IntoFrame::into_frame).map(planish::doubts)
        }
        _ => return,
    };
    doubts.unwrap_or_default().iter().for_each(|doubt| errln!("{}: {doubt}", input.display()));
}

/// Reads a file; a depth image becomes points if its camera is known.
fn read(file: &Path, camera: &CameraArgs, options: &io::ReadOptions) -> Result<Contents> {
    let (FileRead { format, contents, notes, .. }, camera) = read_input(file, options, camera)?;
    report_notes(file, &notes);
    if let Contents::General(cloud) = &contents {
        report_columns(file, format, cloud);
        check_work(io::Work::Compare, &contents, options, file)?;
        return Ok(contents);
    }
    let shape = contents.shape();
    let camera = match contents.is_depth() && camera.is_given() {
        true => Some(camera.required(shape, file)?),
        false => camera.camera(shape)?,
    };
    question(file, &contents, camera.as_ref());
    let stays_depth = contents.is_depth() && camera.is_none();
    check_work(if stays_depth { io::Work::CompareDepth } else { io::Work::Compare }, &contents, options, file)?;
    let contents = contents.with_points(camera.as_ref()).with_context(|| file.display().to_string())?;
    Ok(contents)
}

/// Compares two files.
pub fn compare(args: &CompareArgs) -> Result<ExitCode> {
    if args.max.is_some_and(|max| max.is_nan() || max < 0.0) {
        bail!("--max: expected a distance of 0 or more");
    }
    let options = args.reading.read_options();
    let a = read(&args.a, &args.camera, &options)?;
    let b = read(&args.b, &args.camera, &options)?;
    let names = || format!("{} and {}", args.a.display(), args.b.display());
    let found = planish::compare::compare(&a, &b, args.nearest).with_context(names)?;
    if let Some(picture) = &args.picture {
        if !picture.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
            bail!("{}: unsupported picture extension; expected .png", picture.display());
        }
        for input in [&args.a, &args.b] {
            check_not_input(input, picture, None)?;
        }
        check_not_beside([&args.camera.camera_file], picture)?;
        let full_scale = [args.max, Some(found.distances.p95)].into_iter().flatten().find(|scale| *scale > 0.0);
        let full_scale = full_scale.unwrap_or(f64::MIN_POSITIVE);
        let map = planish::compare::difference_map(&a, &b, full_scale);
        let map = map.with_context(|| {
            format!("{}: the picture needs two inputs on grids of the same size", picture.display())
        })?;
        planish::io::write_rgb_png(picture, &map)?;
        errln!("{}: red marks differences of {} or more", picture.display(), length(full_scale, found.unit));
    }
    let is_within = args.max.is_none_or(|max| found.is_within(max));
    if let (Some(max), false) = (args.max, is_within) {
        let [only_a, only_b] = found.only_in;
        let reason = match only_a + only_b {
            0 => format!("the points differ by more than {}", length(max, found.unit)),
            only => {
                format!("the files differ: {only} pixels are holes in only one of them, or a distance exceeds --max")
            }
        };
        errln!("{}: {reason}", names());
    }
    if args.json {
        outln!("{}", serde_json::to_string(&found)?);
    } else {
        print(args, &found);
    }
    Ok(if is_within { ExitCode::SUCCESS } else { ExitCode::from(1) })
}

/// Formats a distance.
fn length(value: f64, unit: &str) -> String {
    if unit == "m" { format!("{:.3} mm", 1e3 * value) } else { format!("{value:.2} units") }
}

fn print(args: &CompareArgs, found: &Comparison) {
    let Comparison { matching, unit, valid: [valid_a, valid_b], only_in: [only_a, only_b], .. } = found;
    let how = match matching {
        Matching::Index => "point by point",
        Matching::Nearest => "to the nearest point",
    };
    outln!("{} and {}, {how}", args.a.display(), args.b.display());
    outln!("  points      {valid_a} and {valid_b}");
    if *matching == Matching::Index {
        outln!("  in one only {only_a} and {only_b}");
    }
    let line = |name: &str, distances: &Distances| {
        let Distances { count, equal, mean, rms, median, p95, max, .. } = *distances;
        if count == 0 {
            return outln!("  {name} no common points");
        }
        let [mean, rms, median, p95, max] = [mean, rms, median, p95, max].map(|value| length(value, unit));
        outln!("  {name} {equal} of {count} equal; mean {mean}, RMS {rms}, median {median}, 95 % {p95}, max {max}");
    };
    line("distance   ", &found.distances);
    if let Some(back) = &found.back {
        line("and back   ", back);
    }
    for field in &found.fields {
        match (field.is_in, field.differing) {
            ([true, false], _) => outln!("  {} exists only in the first file", field.name),
            ([false, true], _) => outln!("  {} exists only in the second file", field.name),
            (_, Some((count, most))) => outln!("  {} differs in {count} values, by up to {most}", field.name),
            _ => {}
        }
    }
}

/// Merges clouds.
pub fn merge(args: &MergeArgs) -> Result<ExitCode> {
    args.encoding.check(&args.out)?;
    if matches!(Format::of_extension(&args.out), Some(Format::DepthPng | Format::DepthTiff)) {
        bail!("{}: an image cannot store points; end the name in .pcd or .ply", args.out.display());
    }
    check_not_beside([&args.camera.camera_file, &args.poses], &args.out)?;
    let options = args.reading.read_options();
    let poses = args.poses.as_ref().map(|file| read_trajectory_with(file, &options)).transpose()?;
    let mut clouds: Vec<(PointCloud, SensorPose)> = Vec::new();
    let mut bytes = 0u64;
    for (i, input) in args.inputs.iter().enumerate() {
        check_not_input(input, &args.out, None)?;
        let contents = read(input, &args.camera, &options.with_max_memory_bytes(options.max_memory_bytes - bytes))?;
        let cloud = match contents {
            Contents::General(cloud) => cloud,
            Contents::Organized(cloud) => cloud.points,
            contents => organized(contents, &args.camera, input)?.points,
        };
        let pose = poses.as_ref().map(|poses| {
            let name = input.file_stem().and_then(|name| name.to_str());
            let missing = || missing_pose(input, args.poses.as_ref());
            poses.pose(i as u64, None, name).with_context(missing)
        });
        bytes =
            (bytes + (12 + cloud.field_bytes_per_point()) as u64 * cloud.len() as u64).min(options.max_memory_bytes);
        clouds.push((cloud, pose.transpose()?.unwrap_or(SensorPose::IDENTITY)));
    }
    let count = clouds.len();
    let points = clouds.iter().map(|(cloud, _)| cloud.len()).sum();
    let fields = clouds.iter().map(|(cloud, _)| cloud.field_bytes_per_point()).max().unwrap_or(0);
    options.check_work(io::Work::Merge, points, fields).with_context(|| args.out.display().to_string())?;
    let merged = rig::merge(clouds).map_err(Error::from);
    let (mut merged, notes) = merged.with_context(|| format!("{}: nothing is written", args.out.display()))?;
    report_notes(&args.out, &notes);
    let encoding = args.encoding.encoding().unwrap_or_default();
    let notes = io::write_merged(&args.out, &mut merged, encoding, args.encoding.precision())?;
    report_notes(&args.out, &notes);
    let clouds = if count == 1 { "cloud" } else { "clouds" };
    outln!("{count} {clouds} -> {}: {} points", args.out.display(), merged.len());
    Ok(ExitCode::SUCCESS)
}

fn missing_pose(input: &Path, poses: Option<&PathBuf>) -> String {
    let file = poses.map_or(String::new(), |file| file.display().to_string());
    format!("{}: no pose for this cloud in {file}", input.display())
}
