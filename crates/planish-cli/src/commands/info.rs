//! `planish info`: describes a file.

#[cfg(feature = "mcap")]
mod bag;

use crate::exit::ExitCode;
use std::path::Path;

use anyhow::Result;
use planish::io::{self, Contents, DepthSummary, FileRead, Format, LengthUnit};
use planish::{
    Attribute, AttributeValues, DepthFrame, DepthView, Error, FormatError, Frame, FrameError, IntoFrame, IoError,
    OrganizedCloud, PointCloud, PointsView, RangeRule, SensorModel, doubt_about_lens,
};
use planish_bench::outln;
use serde::Serialize;

use super::check_work;
use super::checks::refuse_unit;
use crate::args::{CameraArgs, InfoArgs};

#[derive(Serialize)]
struct Info {
    format: &'static str,
    width: usize,
    height: usize,
    organized: bool,
    fields: Vec<String>,
    valid_points: usize,
    /// Smallest and largest x, y, z, in metres or in `unit`.
    bounds_m: Option<[[f64; 3]; 2]>,
    /// Unit of a LAS file's coordinates and of the lengths in this report, if it is not the metre.
    #[serde(skip_serializing_if = "Option::is_none")]
    unit: Option<&'static str>,
    #[serde(skip)]
    symbol: &'static str,
    median_z_m: Option<f64>,
    /// Distance between neighbouring pixels at a range of 1 m, in metres.
    pixel_pitch_at_1m: Option<f64>,
    /// The range rule: `depth` of a camera, `distance` from another sensor, `constant` if the sensor is unknown.
    range: Option<&'static str>,
    /// Position and orientation (quaternion w, x, y, z) of the sensor, if the file states them.
    sensor_pose: Option<[f64; 7]>,
    /// The sensor that --sensor auto would choose.
    sensor: Option<SensorInfo>,
    /// Smallest and largest raw value of a depth image.
    raw_depth: Option<[u16; 2]>,
    /// Notes on dropped data, guesses and repairs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    notes: Vec<String>,
}

/// Depth steps and noise of a sensor in metres, as coefficients of 1, z and z².
#[derive(Serialize)]
struct SensorInfo {
    step: [f32; 3],
    sigma: [f32; 3],
}

pub fn run(args: &InfoArgs) -> Result<ExitCode> {
    let options = args.reading.options(&args.camera);
    #[cfg(feature = "mcap")]
    {
        let file = planish::bag::file_of(&args.file)?;
        if planish::bag::is_bag(&file) {
            return bag::show(args, &file);
        }
        if super::checks::is_mcap(&file) && file.is_file() {
            anyhow::bail!("{}: not an MCAP recording: its signature is missing", file.display());
        }
    }
    if !args.camera.is_given()
        && args.file != Path::new("-")
        && let Some((format, summary)) = io::summarize_depth(&args.file, &options)?
    {
        return show(args, &describe_depth(format, &summary), true);
    }
    let read = io::read_file(&args.file, &options);
    let has_parts = matches!(Format::of_extension(&args.file), Some(Format::Las | Format::Laz | Format::Ply));
    if let (Err(IoError { problem: FormatError::TooLarge { .. }, .. }), true) = (&read, has_parts) {
        refuse_unit(&args.reading, &args.file)?;
        return show(args, &describe_in_parts(args)?, false);
    }
    let FileRead { format, mut contents, camera, notes, .. } = read?;
    let camera = args.camera.or(camera);
    check_work(io::Work::Describe, &contents, &options, &args.file)?;
    if let (Some(pose), Contents::Organized(OrganizedCloud { points, .. }) | Contents::General(points)) =
        (args.pose.pose()?, &mut contents)
    {
        points.pose = pose;
    }
    let mut info = describe(&camera, format, &contents)?;
    info.notes.splice(0..0, notes);
    show(args, &info, contents.is_depth())
}

fn show(args: &InfoArgs, info: &Info, is_depth: bool) -> Result<ExitCode> {
    if args.json {
        outln!("{}", serde_json::to_string(info)?);
    } else {
        print_text(&args.file, info, is_depth);
    }
    Ok(ExitCode::SUCCESS)
}

impl Info {
    /// Creates a description with only format and size.
    fn new(format: Format, (width, height): (usize, usize), organized: bool) -> Self {
        Self {
            format: format.name(),
            width,
            height,
            organized,
            fields: vec!["depth".into()],
            valid_points: 0,
            bounds_m: None,
            unit: None,
            symbol: LengthUnit::METRE.symbol,
            median_z_m: None,
            pixel_pitch_at_1m: None,
            range: None,
            sensor_pose: None,
            sensor: None,
            raw_depth: None,
            notes: Vec::new(),
        }
    }
}

impl Info {
    /// Adds notes on values that a depth camera would not measure.
    fn question(&mut self, frame: Result<Frame<'_>, FrameError>) {
        let Ok(frame) = frame else { return };
        let of_lens = frame.camera().and_then(doubt_about_lens);
        self.notes.extend(planish::doubts(frame).iter().chain(&of_lens).map(ToString::to_string));
    }
}

/// Describes a file larger than memory. The median of z comes from a sample of the points.
fn describe_in_parts(args: &InfoArgs) -> Result<Info> {
    const POINTS_AT_ONCE: usize = 1 << 18;
    const SAMPLE_STEP: usize = 97;
    let mut info = Info::new(Format::Las, (0, 1), false);
    let mut sample = Vec::new();
    let (format, notes) = io::read_in_parts(&args.file, POINTS_AT_ONCE, |cloud| {
        let mut part = Info::new(Format::Las, (cloud.len(), 1), false);
        describe_points(cloud, &mut part);
        info.width += cloud.len();
        info.valid_points += part.valid_points;
        info.bounds_m = [info.bounds_m, part.bounds_m].into_iter().flatten().reduce(union);
        info.fields = fields(cloud);
        (info.unit, info.symbol) = (part.unit, part.symbol);
        info.sensor_pose = info.sensor_pose.or(part.sensor_pose);
        let finite = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i));
        sample.extend(finite.step_by(SAMPLE_STEP).map(|i| cloud.origin_m[2] + f64::from(cloud.positions.z()[i])));
    })?;
    (info.format, info.notes) = (format.name(), notes);
    info.median_z_m = median(&mut sample);
    Ok(info)
}

fn union([low, high]: [[f64; 3]; 2], [other_low, other_high]: [[f64; 3]; 2]) -> [[f64; 3]; 2] {
    [[0, 1, 2].map(|axis| low[axis].min(other_low[axis])), [0, 1, 2].map(|axis| high[axis].max(other_high[axis]))]
}

fn describe_depth(format: Format, summary: &DepthSummary) -> Info {
    let mut info = Info::new(format, (summary.width, summary.height), true);
    (info.valid_points, info.raw_depth) = (summary.valid, summary.raw);
    info
}

fn describe(camera: &CameraArgs, format: Format, contents: &Contents) -> Result<Info> {
    let (width, height) = contents.shape();
    let mut info = Info::new(format, (width, height), !matches!(contents, Contents::General(_)));
    match contents {
        Contents::Depth(image) => {
            info = describe_depth(format, &DepthSummary::from(image));
            if let Some(camera) = camera.camera((width, height))? {
                let frame = DepthFrame::from_image(camera, image.clone()).map_err(Error::from)?;
                info.question((&frame).into_frame());
                describe_grid(&frame.deproject().map_err(Error::from)?, &mut info)?;
            }
        }
        Contents::DepthMetres { depth_m, .. } => {
            let mut z: Vec<f64> =
                depth_m.iter().filter(|z| **z > 0.0 && z.is_finite()).map(|&z| f64::from(z)).collect();
            info.valid_points = z.len();
            info.median_z_m = median(&mut z);
            if let Some(camera) = camera.camera((width, height))? {
                let view = DepthView::from_metres(depth_m, &camera).map_err(Error::from)?;
                info.question(view.into_frame());
                describe_grid(&view.deproject().map_err(Error::from)?, &mut info)?;
            }
        }
        Contents::Organized(cloud) => {
            let mut cloud = cloud.clone();
            cloud.camera = camera.camera((width, height))?;
            info.question((&cloud).into_frame());
            describe_grid(&cloud, &mut info)?;
            info.fields = fields(&cloud.points);
        }
        Contents::General(cloud) => {
            describe_points(cloud, &mut info);
            info.fields = fields(cloud);
        }
        _ => {}
    }
    Ok(info)
}

fn describe_grid(cloud: &OrganizedCloud, info: &mut Info) -> Result<()> {
    let view = PointsView::from_organized(cloud).map_err(Error::from)?;
    info.range = match view.range_rule() {
        RangeRule::Depth { .. } => Some("depth"),
        RangeRule::Distance { .. } => Some("distance"),
        RangeRule::Constant { .. } => Some("constant"),
        _ => None,
    };
    info.pixel_pitch_at_1m = cloud.pixel_pitch_at_1m();
    info.sensor = SensorModel::estimate(cloud).map(|model| SensorInfo { step: model.step, sigma: model.sigma });
    describe_points(&cloud.points, info);
    Ok(())
}

fn describe_points(cloud: &PointCloud, info: &mut Info) {
    info.sensor_pose = (!cloud.pose.is_identity()).then(|| cloud.pose.viewpoint());
    info.valid_points = cloud.valid_points();
    let unit = LengthUnit::of_cloud(cloud);
    (info.unit, info.symbol) = ((!unit.is_metre()).then_some(unit.name), unit.symbol);
    let valid = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)).map(|i| {
        let p = cloud.positions.get(i);
        [0, 1, 2].map(|axis| cloud.origin_m[axis] + f64::from(p[axis]))
    });
    let valid: Vec<[f64; 3]> = valid.collect();
    info.bounds_m = valid.iter().map(|&p| [p, p]).reduce(union);
    info.median_z_m = median(&mut valid.iter().map(|p| p[2]).collect::<Vec<_>>());
}

fn fields(cloud: &PointCloud) -> Vec<String> {
    let position = if cloud.is_written_in_f64() { "F8" } else { "F4" };
    let positions = ["x", "y", "z"].iter().map(|axis| format!("{axis}:{position}"));
    positions.chain(cloud.attributes.iter().map(field)).collect()
}

/// Returns `name:TYPE`, followed by `x` and the number of values per point if there are several.
fn field(attribute: &Attribute) -> String {
    let kind = match attribute.values {
        AttributeValues::I8(_) | AttributeValues::I16(_) | AttributeValues::I32(_) | AttributeValues::I64(_) => 'I',
        AttributeValues::U8(_) | AttributeValues::U16(_) | AttributeValues::U32(_) | AttributeValues::U64(_) => 'U',
        AttributeValues::F32(_) | AttributeValues::F64(_) => 'F',
    };
    let size = attribute.values.scalar_size();
    match attribute.count {
        1 => format!("{}:{kind}{size}", attribute.name),
        count => format!("{}:{kind}{size}x{count}", attribute.name),
    }
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

fn print_text(file: &Path, info: &Info, is_depth: bool) {
    let kind = match (is_depth, info.organized) {
        (true, _) => "depth image",
        (false, true) => "organized cloud",
        (false, false) => "unorganized cloud",
    };
    let pixels = info.width * info.height;
    outln!("{}: {}, {kind}", file.display(), info.format);
    outln!("  size          {} x {}", info.width, info.height);
    outln!("  fields        {}", io::printable_line(&info.fields.join(" ")));
    let share = 100.0 * info.valid_points as f64 / pixels.max(1) as f64;
    outln!("  valid         {} of {pixels} ({share:.1} %)", info.valid_points);
    if let Some(unit) = info.unit {
        outln!("  unit          {unit}");
    }
    if let Some([low, high]) = info.bounds_m {
        for (axis, name) in ["x", "y", "z"].iter().enumerate() {
            outln!("  {name}             {:.4} to {:.4} {}", low[axis], high[axis], info.symbol);
        }
    }
    if let Some([low, high]) = info.raw_depth {
        outln!("  raw depth     {low} to {high}");
    }
    if let Some(z) = info.median_z_m {
        outln!("  median z      {z:.4} {}", info.symbol);
    }
    if let Some(pose) = info.sensor_pose {
        outln!("  sensor pose   {}", pose.map(|number| number.to_string()).join(" "));
    }
    match (info.range, info.pixel_pitch_at_1m) {
        (Some("depth"), Some(pitch)) => {
            outln!("  pixel pitch   {:.3} mm at 1 m (focal length {:.1} px)", 1e3 * pitch, 1.0 / pitch);
        }
        (Some("distance"), Some(pitch)) => {
            outln!(
                "  pixel pitch   {:.3} mm at a distance of 1 m from the sensor; not the grid of a camera",
                1e3 * pitch
            );
        }
        (Some("constant"), _) => {
            outln!("  pixel pitch   unknown, as is the sensor's position (see --sensor-pose)")
        }
        _ => {}
    }
    if let Some(SensorInfo { step, sigma }) = info.sensor {
        let at = |[c0, c1, c2]: [f32; 3], z: f32| 1e3 * (c0 + z * (c1 + z * c2));
        outln!(
            "  sensor        steps of {:.2} mm and noise of {:.2} mm at 1 m, {:.2} and {:.2} mm at 3 m",
            at(step, 1.0),
            at(sigma, 1.0),
            at(step, 3.0),
            at(sigma, 3.0)
        );
        outln!("                (a Kinect v1: 2.85 and 1.80, 25.65 and 16.20)");
    }
    for note in &info.notes {
        outln!("  note          {note}");
    }
}
