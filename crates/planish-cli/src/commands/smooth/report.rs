//! The output of `planish smooth`: the report of a frame or a folder, and likely causes of problems.

use std::path::{Path, PathBuf};

use planish::{CloudChoice, CloudRadius, Frame, FrameRadius, Params, RangeRule};
use planish_bench::{errln, outln};
use serde::Serialize;

/// Report on one frame.
#[derive(Serialize)]
pub struct Report {
    #[serde(serialize_with = "lossily")]
    pub input: PathBuf,
    #[serde(serialize_with = "lossily")]
    pub output: PathBuf,
    pub engine: &'static str,
    /// Name of the GPU, if one was used.
    pub adapter: Option<String>,
    /// Reason for the choice of `auto`.
    pub engine_reason: Option<String>,
    pub width: usize,
    pub height: usize,
    pub points_in: usize,
    /// Number of points that became holes.
    pub points_lost: usize,
    pub status: StatusCounts,
    /// Number of tiles of a file larger than memory; the smoothing time then includes reading and writing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tiles: Option<usize>,
    /// Neighbours, edges and passes chosen for an unorganized cloud, if the settings leave them to planish and no
    /// sensor was recognized.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cloud: Option<CloudChoice>,
    /// Width and height of the rebuilt grid, for a cloud that had lost its grid.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rebuilt_grid: Option<[usize; 2]>,
    pub read_ms: f64,
    pub smooth_ms: SmoothTimes,
    pub write_ms: f64,
}

#[derive(Serialize)]
pub struct StatusCounts {
    pub hole: usize,
    pub too_few: usize,
    pub degenerate: usize,
    pub plane: usize,
    pub polynomial: usize,
    pub isolated: usize,
    pub carried: usize,
    pub filled: usize,
}

impl StatusCounts {
    /// Creates counts from the number of points with each status code.
    pub fn of(counts: [usize; 9]) -> Self {
        let [hole, too_few, degenerate, plane, quadratic, cubic, isolated, carried, filled] = counts;
        Self { hole, too_few, degenerate, plane, polynomial: quadratic + cubic, isolated, carried, filled }
    }

    /// Lists the points that were not smoothed, by cause; omits causes without points.
    fn others(&self) -> String {
        let causes = [
            (self.degenerate, "unchanged (collinear or coincident neighbours)"),
            (self.isolated, "unchanged (too few neighbours)"),
            (self.carried, "carried over from the previous frame"),
            (self.filled, "holes filled from the surrounding surface"),
            (self.too_few, "turned into holes (too few neighbours)"),
            (self.hole, "holes in the input"),
        ];
        let there = causes.into_iter().filter(|(count, _)| *count > 0);
        there.map(|(count, cause)| format!(", {count} {cause}")).collect()
    }
}

#[derive(Serialize)]
pub struct SmoothTimes {
    pub median: f64,
    pub p99: f64,
    pub runs: usize,
}

#[derive(Serialize)]
pub struct Failure {
    #[serde(serialize_with = "lossily")]
    pub input: PathBuf,
    pub error: String,
}

#[derive(Serialize)]
pub struct FolderReport {
    pub frames: Vec<Report>,
    pub failed: Vec<Failure>,
    /// True if a signal ended the run early.
    pub interrupted: bool,
}

/// Serializes a path as text; invalid UTF-8 is replaced rather than losing the report.
fn lossily<S: serde::Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}

pub fn print_report(report: &Report) {
    let Report { status, smooth_ms, .. } = report;
    outln!("{} -> {}", report.input.display(), report.output.display());
    let adapter = report.adapter.as_ref().map_or(String::new(), |name| format!(" ({name})"));
    let grid = if report.height > 1 { format!("{} x {}, ", report.width, report.height) } else { String::new() };
    outln!("  {grid}{} points, engine {}{adapter}", report.points_in, report.engine);
    outln!("  smoothed {} ({} onto a plane only){}", status.plane + status.polynomial, status.plane, status.others());
    let runs = if smooth_ms.runs > 1 {
        format!(" (median of {}, p99 {:.2})", smooth_ms.runs, smooth_ms.p99)
    } else {
        String::new()
    };
    if let Some(tiles) = report.tiles {
        return outln!("  {tiles} tiles, {:.1} s including reading and writing", 1e-3 * smooth_ms.median);
    }
    outln!("  read {:.1} ms, smooth {:.2} ms{runs}, write {:.1} ms", report.read_ms, smooth_ms.median, report.write_ms);
}

/// Prints a message if the ranges of a grid are not camera depths. If a pose is given, ranges that are distances from
/// the sensor are expected and not reported.
pub fn report_range_rule(input: &Path, frame: Frame<'_>, rule: Option<RangeRule>, pose_is_given: bool) {
    let Frame::Points(points) = frame else { return };
    let input = input.display();
    match rule.unwrap_or_else(|| points.range_rule()) {
        RangeRule::Distance { .. } if pose_is_given => {}
        RangeRule::Distance { .. } if !points.pose().is_identity() => errln!(
            "{input}: the grid does not match a camera at the stated sensor pose; ranges are distances from the sensor"
        ),
        RangeRule::Distance { .. } => errln!(
            "{input}: the grid does not match a camera at the origin looking along +z; ranges are distances from the \
             origin, and normals face it (change with --sensor-pose)"
        ),
        RangeRule::Constant { spacing_m } => errln!(
            "{input}: the sensor's position is unknown; the spacing of the points, {spacing_m:.4} m, sets the radius, \
             and normals point to one side of the surface (change with --sensor-pose)"
        ),
        _ => {}
    }
}

/// Reports the assumed sensor position of an unorganized cloud whose file states none; `None` means the origin.
pub fn report_assumed_sensor(input: &Path, position_m: Option<[f64; 3]>) {
    let (input, what) = (input.display(), "(change with --sensor-pose)");
    match position_m {
        Some([x, y, z]) => errln!(
            "{input}: the sensor's position is unknown and apparently not the origin; normals face ({x:.1}, {y:.1}, \
             {z:.1}) {what}"
        ),
        None => {
            errln!("{input}: the sensor's position is not stated; normals face the origin {what}")
        }
    }
}

/// Returns the likely reason why points have too few neighbours, judging by the parameters, and a remedy.
pub fn likely_cause(frame: Frame<'_>, params: &Params, sensor_is_given: bool) -> String {
    let too_small = |radius_m: f32, other: &str| {
        format!(
            "The radius of {radius_m} m is probably below the spacing of the points; try a larger --radius, or {other}"
        )
    };
    match params {
        Params::Cloud(params) => match params.radius {
            CloudRadius::Fixed { radius_m } => too_small(radius_m, "--neighbours 40"),
            _ if frame.valid_points() < 4 => "The cloud has too few points for a surface".to_owned(),
            _ => "They are probably far from all others".to_owned(),
        },
        Params::Frame(params) => match (params.radius, frame) {
            (FrameRadius::Fixed { radius_m }, _) => too_small(radius_m, "--radius sensor"),
            (_, Frame::Points(points)) if points.camera().is_none() && points.pose().is_identity() => {
                "They are probably isolated, or the file lacks the sensor's pose; try --sensor-pose, or --radius METRES"
                    .to_owned()
            }
            _ if !sensor_is_given => {
                "They are probably isolated between holes. If the sensor is noisier than a Kinect v1, set it with \
                 --sensor, which widens the windows"
                    .to_owned()
            }
            _ => "They are probably isolated between holes; try --preset strong".to_owned(),
        },
    }
}

pub fn summarize(mut times_ms: Vec<f64>) -> SmoothTimes {
    times_ms.sort_by(f64::total_cmp);
    let runs = times_ms.len();
    let at = |share: f64| times_ms[((runs as f64 * share) as usize).min(runs - 1)];
    SmoothTimes { median: at(0.5), p99: at(0.99), runs }
}
