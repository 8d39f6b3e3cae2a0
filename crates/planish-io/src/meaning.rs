//! Interprets a file's numbers: converts their unit, and finds points without a measurement.

use super::{Contents, FormatResult, LengthUnit, ReadOptions};
use planish_core::{FormatError, OrganizedCloud, PointCloud};

/// Converts points and floating-point depth to metres from the unit stated in the options.
pub(super) fn to_metres(contents: &mut Contents, options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<()> {
    let unit = options.unit.filter(|unit| !unit.is_metre());
    match contents {
        Contents::Depth(_) => match unit {
            Some(unit) => Err(FormatError::Unsupported(format!(
                "a length unit does not apply to 16-bit depth; give the number of depth units per metre, {:.0} for {}",
                1.0 / unit.metres,
                unit.symbol
            ))),
            None => Ok(()),
        },
        Contents::DepthMetres { depth_m, .. } => {
            let factor = match (unit, options.depth_units_per_metre) {
                (Some(_), Some(_)) => {
                    let text = "a unit and a number of depth units per metre are both given; give only one of them";
                    return Err(FormatError::Unsupported(text.into()));
                }
                (_, Some(units)) if !(units > 0.0 && units.is_finite()) => {
                    return Err(FormatError::Unsupported(format!(
                        "{units} depth units per metre are invalid; give a positive number"
                    )));
                }
                (Some(unit), None) => unit.metres,
                (None, Some(units)) => units.recip(),
                (None, None) => return Ok(()),
            };
            depth_m.iter_mut().for_each(|depth| *depth = (f64::from(*depth) * factor) as f32);
            notes.extend(unit.map(converted));
            Ok(())
        }
        Contents::Organized(OrganizedCloud { points, .. }) | Contents::General(points) => match unit {
            Some(unit) => points_to_metres(points, unit, notes),
            None => Ok(()),
        },
    }
}

fn converted(unit: LengthUnit) -> String {
    format!("lengths in {} are converted to metres", unit.symbol)
}

fn points_to_metres(cloud: &mut PointCloud, unit: LengthUnit, notes: &mut Vec<String>) -> FormatResult<()> {
    if let Some(stated) = LengthUnit::stated_by(cloud).filter(|stated| *stated != unit) {
        return Err(FormatError::Unsupported(format!(
            "the given unit contradicts the unit stated in the file, the {stated}; give no unit"
        )));
    }
    scale(cloud, unit.metres);
    notes.push(converted(unit));
    // LAS and E57 headers contain scales and a coordinate system in the old unit.
    #[cfg(feature = "scans")]
    if super::las::has_header(cloud) || super::e57::has_scans(cloud) {
        cloud.provenance = planish_core::Provenance::default();
        notes.push("its header is dropped, since its values are in the old unit".into());
    }
    Ok(())
}

/// Converts a cloud to metres if its file states another unit, and drops the header with that unit. Returns a note for
/// users if the cloud was converted.
pub fn convert_to_metres(cloud: &mut PointCloud) -> Option<String> {
    let unit = LengthUnit::stated_by(cloud).filter(|unit| !unit.is_metre())?;
    scale(cloud, unit.metres);
    cloud.provenance = planish_core::Provenance::default();
    Some(format!("{}; its header is dropped, since its values are in the old unit", converted(unit)))
}

/// Multiplies all coordinates and sensor positions by a factor.
fn scale(cloud: &mut PointCloud, factor: f64) {
    let scaled: Vec<[f64; 3]> =
        (0..cloud.len()).map(|i| [0, 1, 2].map(|axis| factor * cloud.coordinate(axis, i))).collect();
    let far = cloud.origin_m != [0.0; 3];
    let origin = cloud.origin_m.map(|origin| (factor * origin).trunc());
    cloud.origin_m = origin;
    for (i, point) in scaled.iter().enumerate() {
        cloud.positions.set(i, [0, 1, 2].map(|axis| (point[axis] - origin[axis]) as f32));
    }
    (cloud.exact_m, cloud.steps) = (None, None);
    if far {
        cloud.keep_exact([0, 1, 2].map(|axis| scaled.iter().map(|point| point[axis]).collect()));
    }
    cloud.pose.position_m.iter_mut().for_each(|position| *position *= factor);
    if let Some(scanners_m) = cloud.scanners_m() {
        let scaled = scanners_m.iter().map(|scanner| scanner.map(|position| position.map(|value| factor * value)));
        let scaled = scaled.collect();
        cloud.set_scanners_m(scaled);
    }
}

/// Maximum |x| / z and |y| / z for a point in front of a camera, which corresponds to a field of view of about 150
/// degrees.
const WIDEST: f32 = 4.0;

/// Converts points at (0, 0, 0) to holes if the cloud is in its sensor's frame, because drivers write such points for
/// missing measurements.
pub(super) fn holes_at_sensor(cloud: &mut OrganizedCloud, notes: &mut Vec<String>) {
    let points = &mut cloud.points;
    if !points.pose.is_identity() || points.origin_m != [0.0; 3] {
        return;
    }
    let is_zero = |points: &PointCloud, i: usize| points.positions.get(i) == [0.0; 3];
    let zeros: Vec<usize> = (0..points.len()).filter(|&i| is_zero(points, i)).collect();
    // A single point at the origin may be on a surface, unless all others are in front of the sensor.
    let is_before = |[x, y, z]: [f32; 3]| z > 0.0 && x.abs() <= WIDEST * z && y.abs() <= WIDEST * z || !z.is_finite();
    let others_are_before =
        || (0..points.len()).filter(|i| !zeros.contains(i)).all(|i| is_before(points.positions.get(i)));
    if zeros.is_empty() || zeros.len() == 1 && !others_are_before() {
        return;
    }
    zeros.iter().for_each(|&i| points.positions.set(i, [f32::NAN; 3]));
    notes.push(format!("{} points at (0, 0, 0), the position of the sensor, are read as holes", zeros.len()));
}
