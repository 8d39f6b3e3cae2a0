//! What the caller may choose: one plain struct with public fields; its defaults live in `impl Default` alone.

use crate::error::ParamError;

/// How the radius of a neighbourhood is found (docs/method.md, section 3).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Radius {
    /// One radius for every point, in metres.
    Fixed {
        /// The radius in metres.
        radius_m: f32,
    },
    /// r(z) = max(1.5 k s z/fx, 4 step z²): wide enough for the window at this range, and for the depth noise.
    Sensor {
        /// The depth step of the sensor at 1 m, in metres; it grows with z². Kinect v1: 2.85e-3.
        depth_step_at_1m: f32,
    },
}

/// The depth step of a Kinect v1 in metres at a range of 1 m: one unit of its 11-bit disparity
/// (Khoshelham & Elberink 2012).
pub const KINECT_V1_DEPTH_STEP_AT_1M: f32 = 2.85e-3;

impl Radius {
    /// The sensor rule with the depth step of a Kinect v1.
    pub const KINECT_V1: Self = Self::Sensor { depth_step_at_1m: KINECT_V1_DEPTH_STEP_AT_1M };
}

/// The parameters of the smoother.
///
/// ```
/// use planish::{Radius, SmoothParams};
///
/// let params = SmoothParams { window: 4, ..SmoothParams::default() };
/// assert!(params.validate().is_ok());
/// let error = SmoothParams { window: 9, ..params }.validate().unwrap_err();
/// assert_eq!(error.to_string(), "window = 9 is not allowed: 1 to 7");
/// # let _ = Radius::KINECT_V1;
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SmoothParams {
    /// Half width k of the pixel window; the candidates are (2k+1)² pixels. 1 to 7.
    pub window: u32,
    /// Distance s between candidates in pixels. 1 to 8.
    pub stride: u32,
    /// The gate: candidates further away than this from the point are no neighbours.
    pub radius: Radius,
    /// Highest degree of the polynomial fitted over the plane. 1 (the plane itself) to 3.
    pub degree: u32,
    /// Bandwidth g of the Gaussian weight exp(-d²/g²) in metres; `None` is the radius.
    pub bandwidth_m: Option<f32>,
}

impl Default for SmoothParams {
    /// 49 candidates spread over 19x19 pixels, the radius of the sensor, degree 2: on correlated Kinect noise this leaves
    /// two thirds of the error of [`SmoothParams::paper`] at the same cost.
    fn default() -> Self {
        Self { window: 3, stride: 3, radius: Radius::KINECT_V1, degree: 2, bandwidth_m: None }
    }
}

impl SmoothParams {
    /// The setting of the 2011 report: 49 adjacent pixels, 3 cm, degree 3.
    pub fn paper() -> Self {
        Self { window: 3, stride: 1, radius: Radius::Fixed { radius_m: 0.03 }, degree: 3, bandwidth_m: None }
    }

    /// Refuses every value outside its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        let integer = |field, value: u32, range: std::ops::RangeInclusive<u32>, allowed| {
            if range.contains(&value) { Ok(()) } else { Err(ParamError { field, value: value.to_string(), allowed }) }
        };
        // Written so that a NaN is refused too.
        let real = |field, value: f32, range: std::ops::RangeInclusive<f32>, allowed| {
            if range.contains(&value) { Ok(()) } else { Err(ParamError { field, value: value.to_string(), allowed }) }
        };
        integer("window", self.window, 1..=7, "1 to 7")?;
        integer("stride", self.stride, 1..=8, "1 to 8")?;
        integer("degree", self.degree, 1..=3, "1 to 3")?;
        match self.radius {
            Radius::Fixed { radius_m } => {
                real("radius_m", radius_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
            }
            Radius::Sensor { depth_step_at_1m } => {
                real("depth_step_at_1m", depth_step_at_1m, 0.0..=1.0, "0 to 1 metre")?
            }
        }
        if let Some(bandwidth_m) = self.bandwidth_m {
            real("bandwidth_m", bandwidth_m, 1e-6..=1e3, "1e-6 to 1000 metres")?;
        }
        Ok(())
    }

    /// How far a window reaches from its centre, in pixels: k s.
    pub fn reach_px(&self) -> usize {
        (self.window * self.stride) as usize
    }

    /// How many candidates a window has: (2k+1)².
    pub fn candidates(&self) -> usize {
        let side = 2 * self.window as usize + 1;
        side * side
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_is_refused_outside_its_range_by_name_value_and_range() {
        let ok = SmoothParams::default();
        let fixed = |radius_m| Radius::Fixed { radius_m };
        let cases = [
            (SmoothParams { window: 0, ..ok }, "window", "0", "1 to 7"),
            (SmoothParams { window: 8, ..ok }, "window", "8", "1 to 7"),
            (SmoothParams { stride: 0, ..ok }, "stride", "0", "1 to 8"),
            (SmoothParams { stride: 9, ..ok }, "stride", "9", "1 to 8"),
            (SmoothParams { degree: 0, ..ok }, "degree", "0", "1 to 3"),
            (SmoothParams { degree: 4, ..ok }, "degree", "4", "1 to 3"),
            (SmoothParams { radius: fixed(-0.5), ..ok }, "radius_m", "-0.5", "1e-6 to 1000"),
            (SmoothParams { radius: fixed(f32::NAN), ..ok }, "radius_m", "NaN", "1e-6 to 1000"),
            (SmoothParams { radius: fixed(f32::INFINITY), ..ok }, "radius_m", "inf", "1e-6 to 1000"),
            (
                SmoothParams { radius: Radius::Sensor { depth_step_at_1m: -1.0 }, ..ok },
                "depth_step_at_1m",
                "-1",
                "0 to 1",
            ),
            (SmoothParams { bandwidth_m: Some(0.0), ..ok }, "bandwidth_m", "0", "1e-6 to 1000"),
        ];
        for (params, field, value, allowed) in cases {
            let error = params.validate().unwrap_err();
            assert_eq!((error.field, error.value.as_str()), (field, value));
            assert!(error.allowed.starts_with(allowed), "{error}");
        }
        assert!(ok.validate().is_ok());
        assert!(SmoothParams::paper().validate().is_ok());
    }
}
