//! Sensor models: how depth steps and noise grow with range. All values are in metres.
//!
//! Steps and noise are polynomials c0 + c1 z + c2 z² in the range z. In triangulating sensors (structured light,
//! stereo) they grow with z²; in time-of-flight sensors and lidars they grow nearly linearly from an offset.

mod estimate;
mod recognize;

use std::str::FromStr;

use crate::error::ParamError;

/// Noise of a Kinect v1 in units of its depth step. The radius must cover the noise, so for sensors without
/// noticeable depth steps, the step is set to the noise divided by this ratio.
const NOISE_IN_STEPS: f64 = 0.63;

/// The properties of a depth sensor that the smoother uses.
///
/// ```
/// use planish::SensorModel;
///
/// let sensor = SensorModel::realsense_d400(0.050, 448.0);
/// assert!((sensor.sigma_m(2.0) / sensor.sigma_m(1.0) - 4.0).abs() < 1e-6);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct SensorModel {
    /// Difference between adjacent depths that the sensor distinguishes, in metres: coefficients of 1, z and z². Must
    /// be at least the noise between neighbouring pixels, because the radius (docs/method.md, section 3) is four
    /// steps.
    pub step: [f32; 3],
    /// Standard deviation of depth in metres: coefficients of 1, z and z².
    pub sigma: [f32; 3],
}

impl SensorModel {
    /// Kinect v1 and other sensors with its pattern (Xtion, PrimeSense Carmine): one unit of 11-bit disparity is
    /// 2.85e-3 z² (Khoshelham & Elberink 2012); on real frames the noise around a line through 8 pixels is 1.66e-3 to
    /// 1.88e-3 z² (docs/method.md, section 10).
    pub const KINECT_V1: Self = Self { step: [0.0, 0.0, 2.85e-3], sigma: [0.0, 0.0, 1.8e-3] };
    /// RealSense D415 at 1280x720: baseline 55 mm, focal length 1005 px (horizontal field of view 65°).
    pub const REALSENSE_D415: Self = Self::realsense_d400(0.055, 1005.0);
    /// RealSense D435 at 848x480: baseline 50 mm, focal length 424 px (90°). For the D435i and D405 families, whose
    /// baselines differ, use [`SensorModel::realsense_d400`].
    pub const REALSENSE_D435: Self = Self::realsense_d400(0.050, 424.0);
    /// RealSense D455 at 848x480: baseline 95 mm, focal length 424 px (90°).
    pub const REALSENSE_D455: Self = Self::realsense_d400(0.095, 424.0);
    /// Azure Kinect (NFOV unbinned) and Orbbec Femto Bolt, which has the same sensor: the polynomial through standard
    /// deviations of 0.61 mm at 0.8 m, 0.89 mm at 1.5 m and 1.78 mm at 3 m (Tölgyessy et al. 2021, Sensors 21(2):413).
    /// These three figures are unverified; only the paper's bound of 17 mm for all modes and ranges was verified.
    pub const AZURE_KINECT: Self = Self::from_noise([4.1e-4, 1.8e-4, 9.3e-5]);
    /// RealSense L515: the line through standard deviations of 2.5 mm at 1 m and 15.5 mm at 9 m on 95 % reflectivity
    /// (Intel's product page, quoted in librealsense issue 5808).
    pub const REALSENSE_L515: Self = Self::from_noise([8.75e-4, 1.625e-3, 0.0]);
    /// Depth of iPhone and iPad lidars: half of the absolute accuracy of ±1 cm that Luetzenburg et al. 2021
    /// (Scientific Reports 11:22221) found for small objects, at any range. The figure is not verified.
    pub const APPLE_LIDAR: Self = Self::from_noise([5e-3, 0.0, 0.0]);
    /// Depth without noise: rendered, or averaged over many frames.
    pub const EXACT: Self = Self { step: [0.0; 3], sigma: [0.0; 3] };

    /// Creates a model from the coefficients of its depth step and of its noise.
    pub const fn new(step: [f32; 3], sigma: [f32; 3]) -> Self {
        Self { step, sigma }
    }

    /// Creates the model of a stereo camera of the RealSense D400 family: sigma = 0.08 z²/(focal length x baseline).
    /// The noise of 0.08 pixels of disparity is Intel's figure for well textured targets ("Best known methods for
    /// tuning Intel RealSense D400").
    pub const fn realsense_d400(baseline_m: f32, focal_length_px: f32) -> Self {
        Self::from_noise([0.0, 0.0, 0.08 / (baseline_m * focal_length_px)])
    }

    /// Creates the model of a sensor without noticeable depth steps from its noise: coefficients of 1, z and z² in
    /// metres.
    pub const fn from_noise(sigma: [f32; 3]) -> Self {
        let [c0, c1, c2] = sigma;
        let noise = NOISE_IN_STEPS as f32;
        Self { step: [c0 / noise, c1 / noise, c2 / noise], sigma }
    }

    /// Returns the depth step at a range, in metres.
    pub fn step_m(&self, range_m: f64) -> f64 {
        evaluate(self.step, range_m)
    }

    /// Returns the standard deviation of depth at a range, in metres.
    pub fn sigma_m(&self, range_m: f64) -> f64 {
        evaluate(self.sigma, range_m)
    }

    /// Returns the baseline of a named triangulating sensor in metres: the distance from the camera to the projector
    /// or second camera. Because of this distance, near objects cast shadows. `None` for other sensors. Sources: 75
    /// mm for a Kinect v1 (Khoshelham & Elberink 2012); Intel's data sheets for the RealSense D400 family.
    pub fn baseline_m(&self) -> Option<f64> {
        let known = [
            (Self::KINECT_V1, 0.075),
            (Self::REALSENSE_D415, 0.055),
            (Self::REALSENSE_D435, 0.050),
            (Self::REALSENSE_D455, 0.095),
        ];
        known.into_iter().find(|(sensor, _)| sensor == self).map(|(_, baseline_m)| baseline_m)
    }

    /// Refuses coefficients outside 0 to 1.
    pub fn validate(&self) -> Result<(), ParamError> {
        for (field, coefficients) in [("sensor.step", self.step), ("sensor.sigma", self.sigma)] {
            // False for a NaN.
            if !coefficients.iter().all(|c| (0.0..=1.0).contains(c)) {
                let value = format!("{coefficients:?}");
                return Err(ParamError { field, value, allowed: "three coefficients in metres, 0 to 1 each" });
            }
        }
        Ok(())
    }
}

impl SensorModel {
    /// The named sensors, with their names in files, options and parameters.
    pub const NAMED: [(&'static str, Self); 8] = [
        ("kinect1", Self::KINECT_V1),
        ("d415", Self::REALSENSE_D415),
        ("d435", Self::REALSENSE_D435),
        ("d455", Self::REALSENSE_D455),
        ("azure-kinect", Self::AZURE_KINECT),
        ("l515", Self::REALSENSE_L515),
        ("iphone", Self::APPLE_LIDAR),
        ("exact", Self::EXACT),
    ];

    /// Returns the name of this sensor, if it is one of [`SensorModel::NAMED`].
    pub fn name(&self) -> Option<&'static str> {
        Self::NAMED.iter().find(|(_, sensor)| sensor == self).map(|(name, _)| *name)
    }
}

impl FromStr for SensorModel {
    type Err = ParamError;

    /// Returns the sensor with a name from [`SensorModel::NAMED`].
    fn from_str(name: &str) -> Result<Self, ParamError> {
        let named = Self::NAMED.iter().find(|(known, _)| *known == name).map(|(_, sensor)| *sensor);
        let allowed = "kinect1, d415, d435, d455, azure-kinect, l515, iphone or exact";
        named.ok_or_else(|| ParamError { field: "sensor", value: format!("{name:?}"), allowed })
    }
}

impl Default for SensorModel {
    /// Returns [`SensorModel::KINECT_V1`].
    fn default() -> Self {
        Self::KINECT_V1
    }
}

fn evaluate(coefficients: [f32; 3], range_m: f64) -> f64 {
    let [c0, c1, c2] = coefficients.map(f64::from);
    c0 + range_m * (c1 + range_m * c2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_give_the_published_figures() {
        let close = |found: f64, published: f64| assert!((found / published - 1.0).abs() < 0.02, "{found} {published}");
        close(SensorModel::KINECT_V1.step_m(3.2), 29.2e-3);
        for (range_m, sigma_m) in [(0.8, 0.6132e-3), (1.5, 0.8873e-3), (3.0, 1.7824e-3)] {
            close(SensorModel::AZURE_KINECT.sigma_m(range_m), sigma_m);
        }
        close(SensorModel::REALSENSE_L515.sigma_m(1.0), 2.5e-3);
        close(SensorModel::REALSENSE_L515.sigma_m(9.0), 15.5e-3);
        close(SensorModel::REALSENSE_D435.sigma_m(2.0), 4.0 * 0.08 / (0.05 * 424.0));
    }

    #[test]
    fn every_sensor_has_a_name() {
        for (name, sensor) in SensorModel::NAMED {
            assert_eq!(name.parse(), Ok(sensor));
            assert_eq!(sensor.name(), Some(name));
        }
        let error = "d999".parse::<SensorModel>().unwrap_err().to_string();
        assert!(SensorModel::NAMED.iter().all(|(name, _)| error.contains(name)), "{error}");
    }

    #[test]
    fn impossible_coefficients_are_refused_by_name() {
        for bad in [-1e-3, f32::NAN, 2.0] {
            let error = SensorModel::new([0.0; 3], [0.0, bad, 0.0]).validate().unwrap_err();
            assert_eq!(error.field, "sensor.sigma");
        }
        assert!(SensorModel::EXACT.validate().is_ok());
    }
}
