//! Clouds measured by several scanners: the position of each, and normals that face the right one.

use crate::cloud::{AttributeValues, PointCloud};

/// The name of the field that contains the number of each point's scan.
const SCAN: &str = "scan";
const NORMALS: [&str; 3] = ["normal_x", "normal_y", "normal_z"];

impl PointCloud {
    /// Returns the position of each scanner in metres, in the frame of the file, indexed by the field `scan`.
    ///
    /// Returns `None` if the positions are unknown, the cloud lacks the field `scan`, or the cloud has a single pose.
    /// An entry is `None` if the file does not state the pose of that scan.
    pub fn scanners_m(&self) -> Option<&[Option<[f64; 3]>]> {
        self.attribute(SCAN).filter(|_| self.pose.is_identity())?;
        self.scanners_m.as_deref()
    }

    /// Turns the normal of each point towards the point's scanner, if the scanner's position is known.
    pub(crate) fn face_scanners(&mut self) {
        let Some(scanners) = self.scanners_m() else { return };
        let Some(AttributeValues::U16(scan_of)) = self.attribute(SCAN).map(|scan| &scan.values) else { return };
        let normals = NORMALS.map(|name| match self.attribute(name).map(|normal| &normal.values) {
            Some(AttributeValues::F32(values)) => values.clone(),
            _ => Vec::new(),
        });
        if normals.iter().any(|values| values.len() != self.len()) || scan_of.len() != self.len() {
            return;
        }
        let faces_away = |i: usize| {
            let Some(Some(scanner)) = scanners.get(usize::from(scan_of[i])) else { return false };
            let along = |axis: usize| f64::from(normals[axis][i]) * (self.coordinate(axis, i) - scanner[axis]);
            along(0) + along(1) + along(2) > 0.0
        };
        let away: Vec<bool> = (0..self.len()).map(faces_away).collect();
        for (name, values) in NORMALS.into_iter().zip(&normals) {
            let turned = values.iter().zip(&away).map(|(&value, &away)| if away { -value } else { value });
            self.set_attribute(name, turned.collect::<Vec<f32>>());
        }
    }
}
