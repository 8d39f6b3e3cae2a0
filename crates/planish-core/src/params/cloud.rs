//! Parameters of unorganized clouds.

use super::fit::{Edges, Fit, check, fit_setters};
use super::frame::FrameParams;
use super::strength::Strength;
use crate::error::ParamError;
use crate::sensor::SensorModel;

/// Default number of neighbours per point in an unorganized cloud.
const NEIGHBOURS: u32 = 40;

/// The radius of a neighbourhood in unorganized clouds (docs/method.md, sections 3 and 8).
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum CloudRadius {
    /// A radius for each point, chosen from the density around the point so that evenly spread points would have this
    /// number of neighbours. It is at most 1.5 times the mean radius of the point's neighbours.
    Neighbours {
        /// The number of neighbours, 6 to 1000.
        count: u32,
    },
    /// A radius that grows with the range of a point, for clouds that one sensor measured from the cloud's pose: as
    /// wide as the windows of that sensor's frames, or up to twice as wide if four depth steps are wider. It is larger
    /// where evenly spread points would have fewer than 20 neighbours, and smaller where they would have more than
    /// about 2000. Points move along their rays. The cloud must be in the sensor's frame or state its pose;
    /// [`Settings`](crate::Settings) refuse clouds whose sensor position is unknown.
    Sensor {
        /// The sensor that measured the points.
        sensor: SensorModel,
        /// The strength, which sets the width of windows.
        strength: Strength,
    },
    /// One radius for every point, in metres.
    Fixed {
        /// The radius in metres.
        radius_m: f32,
    },
}

/// The parameters of unorganized clouds, which have no pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct CloudParams {
    /// Parameters of the fitted surface.
    pub fit: Fit,
    /// The gate: points farther away than this are not neighbours.
    pub radius: CloudRadius,
    /// Whether isolated points become holes instead of staying unchanged. A point is isolated if it has fewer than
    /// three neighbours, or fewer than about a quarter of the number in [`CloudRadius::Neighbours`] (five with
    /// [`CloudRadius::Sensor`]).
    pub remove_isolated: bool,
}

impl Default for CloudParams {
    /// Returns parameters with degree 2, rounded edges, and a radius by density for 40 neighbours.
    fn default() -> Self {
        Self {
            fit: Fit { degree: 2, ..Fit::PAPER },
            radius: CloudRadius::Neighbours { count: NEIGHBOURS },
            remove_isolated: false,
        }
    }
}

impl CloudParams {
    /// Returns the parameters of the 2011 report: a radius of 3 cm, degree 3.
    pub fn paper() -> Self {
        Self { fit: Fit::PAPER, radius: CloudRadius::Fixed { radius_m: 0.03 }, remove_isolated: false }
    }

    /// Returns the parameters for a cloud that one sensor measured from the cloud's pose: edges kept, the fit of the
    /// sensor's frames ([`FrameParams::for_sensor`]), and [`CloudRadius::Sensor`].
    pub fn for_sensor(sensor: SensorModel, strength: Strength) -> Self {
        let FrameParams { fit, .. } = FrameParams::for_sensor(sensor, strength);
        Self { fit, radius: CloudRadius::Sensor { sensor, strength }, remove_isolated: false }
    }

    fit_setters!();

    /// Sets the radius.
    pub const fn with_radius(self, radius: CloudRadius) -> Self {
        Self { radius, ..self }
    }

    /// Sets one radius in metres for every point.
    pub const fn with_radius_m(self, radius_m: f32) -> Self {
        self.with_radius(CloudRadius::Fixed { radius_m })
    }

    /// Sets a radius by density, for this many neighbours.
    pub const fn with_neighbours(self, count: u32) -> Self {
        self.with_radius(CloudRadius::Neighbours { count })
    }

    /// Sets whether isolated points become holes.
    pub const fn with_remove_isolated(self, remove_isolated: bool) -> Self {
        Self { remove_isolated, ..self }
    }

    /// Refuses every value outside its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        self.fit.validate()?;
        match self.radius {
            CloudRadius::Fixed { radius_m } => check("radius_m", radius_m, 1e-6..=1e3, "1e-6 to 1000 metres"),
            CloudRadius::Neighbours { count } => check("neighbours", count, 6..=1000, "6 to 1000"),
            CloudRadius::Sensor { sensor, .. } => sensor.validate(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radii_are_refused_outside_their_ranges_by_name() {
        let ok = CloudParams::default();
        for (params, field) in [
            (ok.with_radius_m(0.0), "radius_m"),
            (ok.with_neighbours(5), "neighbours"),
            (ok.with_neighbours(1001), "neighbours"),
            (ok.with_degree(4), "degree"),
        ] {
            assert_eq!(params.validate().unwrap_err().field, field);
        }
        assert!(ok.validate().is_ok() && CloudParams::paper().validate().is_ok());
    }
}
