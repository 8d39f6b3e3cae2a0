//! `planish info`: what a file holds.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;
use planish::io::{self, Contents, Format};
use planish::{Attribute, AttributeValues, PointCloud, Sensor};
use serde::Serialize;

use crate::args::InfoArgs;

#[derive(Serialize)]
struct Info {
    format: &'static str,
    width: usize,
    height: usize,
    organized: bool,
    fields: Vec<String>,
    valid_points: usize,
    /// Smallest and largest x, y, z in metres.
    bounds_m: Option<[[f64; 3]; 2]>,
    median_z_m: Option<f64>,
    /// Metres between neighbouring pixels at 1 m.
    pixel_pitch_at_1m: Option<f64>,
    /// What --sensor auto would take the sensor for.
    sensor: Option<SensorInfo>,
    /// Smallest and largest raw value of a depth image.
    raw_depth: Option<[u16; 2]>,
}

/// Both grow with z².
#[derive(Serialize)]
struct SensorInfo {
    depth_step_at_1m: f32,
    noise_at_1m: f32,
}

pub fn run(args: &InfoArgs) -> Result<ExitCode> {
    let (format, contents) = io::read(&args.file)?;
    let info = describe(format, &contents);
    if args.json {
        println!("{}", serde_json::to_string(&info)?);
    } else {
        print_text(&args.file, &info, contents.is_depth());
    }
    Ok(ExitCode::SUCCESS)
}

fn describe(format: Format, contents: &Contents) -> Info {
    let (width, height) = contents.shape();
    let mut info = Info {
        format: format.name(),
        width,
        height,
        organized: !matches!(contents, Contents::Points(_)),
        fields: vec!["depth".into()],
        valid_points: 0,
        bounds_m: None,
        median_z_m: None,
        pixel_pitch_at_1m: None,
        sensor: None,
        raw_depth: None,
    };
    match contents {
        Contents::Depth(image) => {
            let valid = || image.raw.iter().copied().filter(|&raw| raw != 0 && raw != planish::SATURATED_DEPTH);
            info.valid_points = valid().count();
            info.raw_depth = valid().min().zip(valid().max()).map(|(min, max)| [min, max]);
        }
        Contents::DepthMetres { depth_m, .. } => {
            let mut z: Vec<f64> =
                depth_m.iter().filter(|z| **z > 0.0 && z.is_finite()).map(|&z| f64::from(z)).collect();
            info.valid_points = z.len();
            info.median_z_m = median(&mut z);
        }
        Contents::Organized(cloud) => {
            info.pixel_pitch_at_1m = cloud.pixel_pitch_at_1m();
            info.sensor = Sensor::estimate(cloud)
                .map(|Sensor { depth_step_at_1m, noise_at_1m }| SensorInfo { depth_step_at_1m, noise_at_1m });
            describe_points(&cloud.points, &mut info);
        }
        Contents::Points(cloud) => describe_points(cloud, &mut info),
    }
    info
}

fn describe_points(cloud: &PointCloud, info: &mut Info) {
    let position = if cloud.position_columns.double { "F8" } else { "F4" };
    info.fields = ["x", "y", "z"].iter().map(|axis| format!("{axis}:{position}")).collect();
    info.fields.extend(cloud.attributes.iter().map(field));
    info.valid_points = cloud.valid_points();
    let valid = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)).map(|i| {
        let p = cloud.positions.get(i);
        [0, 1, 2].map(|axis| cloud.origin_m[axis] + f64::from(p[axis]))
    });
    let valid: Vec<[f64; 3]> = valid.collect();
    info.bounds_m = valid.iter().copied().map(|p| [p, p]).reduce(|[low, high], [p, _]| {
        [[0, 1, 2].map(|axis| low[axis].min(p[axis])), [0, 1, 2].map(|axis| high[axis].max(p[axis]))]
    });
    info.median_z_m = median(&mut valid.iter().map(|p| p[2]).collect::<Vec<_>>());
}

/// `name:TYPE`, with the number of values if there are several.
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
        (false, false) => "points, not organized",
    };
    let pixels = info.width * info.height;
    println!("{}: {}, {kind}", file.display(), info.format);
    println!("  size          {} x {}", info.width, info.height);
    println!("  fields        {}", info.fields.join(" "));
    let share = 100.0 * info.valid_points as f64 / pixels.max(1) as f64;
    println!("  valid         {} of {pixels} ({share:.1} %)", info.valid_points);
    if let Some([low, high]) = info.bounds_m {
        for (axis, name) in ["x", "y", "z"].iter().enumerate() {
            println!("  {name}             {:.4} to {:.4} m", low[axis], high[axis]);
        }
    }
    if let Some([low, high]) = info.raw_depth {
        println!("  raw depth     {low} to {high}");
    }
    if let Some(z) = info.median_z_m {
        println!("  median z      {z:.4} m");
    }
    if let Some(pitch) = info.pixel_pitch_at_1m {
        println!("  pixel pitch   {:.3} mm at 1 m (focal length {:.1} px)", 1e3 * pitch, 1.0 / pitch);
    }
    if let Some(SensorInfo { depth_step_at_1m, noise_at_1m }) = info.sensor {
        let [step, noise] = [depth_step_at_1m, noise_at_1m].map(|metres| 1e3 * metres);
        println!(
            "  sensor        steps of {step:.2} mm and noise of {noise:.2} mm at 1 m (a Kinect v1 has 2.85 and 1.80)"
        );
    }
}
