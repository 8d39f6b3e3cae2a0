//! What the numbers of a file mean: their unit, and which of them are no measurements.

use super::{Contents, FormatResult, LengthUnit};
use planish_core::{FormatError, OrganizedCloud, PointCloud};

/// Converts points and floating-point depth in this unit to metres.
pub(super) fn to_metres(contents: &mut Contents, unit: LengthUnit, notes: &mut Vec<String>) -> FormatResult<()> {
    let cloud = match contents {
        Contents::Depth(_) => {
            let units = 1.0 / unit.metres;
            return Err(FormatError::Unsupported(format!(
                "its 16-bit values have no unit of length; give the number of depth units in a metre, {units:.0} for {}s",
                unit.name
            )));
        }
        Contents::DepthMetres { depth_m, .. } => {
            depth_m.iter_mut().for_each(|depth| *depth = (f64::from(*depth) * unit.metres) as f32);
            None
        }
        Contents::Organized(OrganizedCloud { points, .. }) | Contents::General(points) => Some(points),
    };
    if let Some(cloud) = cloud {
        let stated = LengthUnit::of_cloud(cloud);
        if !stated.is_metre() && stated != unit {
            return Err(FormatError::Unsupported(format!("the file states its unit, the {stated}")));
        }
        scale(cloud, unit.metres);
    }
    if !unit.is_metre() {
        notes.push(format!("lengths in {} become metres", unit.symbol));
    }
    Ok(())
}

/// Multiplies all coordinates.
fn scale(cloud: &mut PointCloud, factor: f64) {
    for values in cloud.positions.as_mut_slices() {
        values.iter_mut().for_each(|value| *value = (f64::from(*value) * factor) as f32);
    }
    cloud.origin_m.iter_mut().for_each(|origin| *origin *= factor);
    cloud.pose.position_m.iter_mut().for_each(|position| *position *= factor);
    cloud.exact_m.iter_mut().flatten().flatten().for_each(|coordinate| *coordinate *= factor);
    cloud.steps = None;
}

/// Turns the points (0, 0, 0) of a cloud in the frame of its sensor into holes: drivers write them where nothing was
/// measured.
pub(super) fn holes_at_sensor(cloud: &mut OrganizedCloud, notes: &mut Vec<String>) {
    let points = &mut cloud.points;
    if !points.pose.is_identity() || points.origin_m != [0.0; 3] {
        return;
    }
    let is_zero = |points: &PointCloud, i: usize| points.positions.get(i) == [0.0; 3];
    let zeros: Vec<usize> = (0..points.len()).filter(|&i| is_zero(points, i)).collect();
    // A single one may be a point of a surface, unless all others are before the sensor.
    let is_before = |z: &f32| *z > 0.0 || !z.is_finite();
    let others_are_before = || points.positions.z().iter().filter(|z| **z != 0.0).all(is_before);
    if zeros.is_empty() || zeros.len() == 1 && !others_are_before() {
        return;
    }
    zeros.iter().for_each(|&i| points.positions.set(i, [f32::NAN; 3]));
    notes.push(format!("{} points at (0, 0, 0), where the sensor is, are holes", zeros.len()));
}
