//! A noise model for depth sensors; each noise source has its own parameter.
//!
//! Triangulating sensors (structured light, stereo) have noise in disparity: D = 1/(step z) in units of one disparity
//! step, so an error of one unit is step * z² metres of depth (Khoshelham & Elberink 2012). Other sensors have noise
//! in depth. Each pixel's error is the sum of temporal noise and a fixed pattern that is correlated over a few pixels.
//! The pattern makes up most of the error of a single frame, and averaging frames does not remove it. Disparities are
//! rounded. At depth steps the sensor looks past the edge, mixes both sides, and misses regions hidden from its
//! projector or second camera. Output: u16 millimetres, 0 for no measurement.

use rayon::prelude::*;

use super::random::Random;
use super::scene::{NO_OBJECT, Truth};
use planish_core::{Camera, DepthFrame, FrameError, SensorModel};

/// The unit of a sensor's errors.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum ErrorUnit {
    /// Disparity steps, to which measurements are rounded.
    Disparity {
        /// Depth error in metres of a one-step disparity error at 1 m; it grows with z².
        step_at_1m: f64,
    },
    /// Standard deviations of depth, which is not rounded.
    Depth {
        /// Coefficients of 1, z and z² of the standard deviation in metres.
        sigma: [f64; 3],
    },
}

/// Noise parameters. The default is a Kinect v1; [`DepthNoise::NONE`] only rounds to millimetres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthNoise {
    /// The unit of the errors.
    pub unit: ErrorUnit,
    /// Root mean square of the fixed pattern, in multiples of [`unit`](Self::unit).
    pub fixed_pattern_rms: f64,
    /// Distance in pixels at which the fixed pattern's correlation has fallen to 1/e.
    pub fixed_pattern_correlation_px: f64,
    /// Root mean square of the temporal noise, in multiples of [`unit`](Self::unit).
    pub temporal_rms: f64,
    /// Distance in pixels at which the temporal noise's correlation has fallen to 1/e; 0 for independent pixels.
    pub temporal_correlation_px: f64,
    /// Standard deviation of the sampling offset of a pixel near a depth step, along each image axis, in pixels.
    pub edge_jitter_px: f64,
    /// Probability that a pixel at a depth step floats between the two surfaces.
    pub flying_pixel_probability: f64,
    /// Distance from the camera to the projector or second camera on its right, in metres; 0 disables shadows.
    pub projector_baseline_m: f64,
    /// Angle of incidence in degrees at which measurements begin to drop out; all are lost at 90°.
    pub dropout_incidence_deg: f64,
    /// Nearest depth that is measured, in metres.
    pub min_range_m: f64,
    /// Farthest depth that is measured, in metres.
    pub max_range_m: f64,
}

impl Default for DepthNoise {
    fn default() -> Self {
        Self {
            unit: ErrorUnit::Disparity { step_at_1m: SensorModel::KINECT_V1.step_m(1.0) },
            fixed_pattern_rms: 0.5,
            fixed_pattern_correlation_px: 2.5,
            temporal_rms: 0.3,
            temporal_correlation_px: 0.0,
            edge_jitter_px: 0.8,
            flying_pixel_probability: 0.15,
            projector_baseline_m: 0.075,
            dropout_incidence_deg: 70.0,
            min_range_m: 0.5,
            max_range_m: 5.0,
        }
    }
}

impl DepthNoise {
    /// No noise; depth is only rounded to millimetres.
    pub const NONE: Self = Self {
        unit: ErrorUnit::Depth { sigma: [0.0; 3] },
        fixed_pattern_rms: 0.0,
        fixed_pattern_correlation_px: 1.0,
        temporal_rms: 0.0,
        temporal_correlation_px: 0.0,
        edge_jitter_px: 0.0,
        flying_pixel_probability: 0.0,
        projector_baseline_m: 0.0,
        dropout_incidence_deg: 90.0,
        min_range_m: 0.0,
        max_range_m: f64::INFINITY,
    };

    /// Returns noise parameters for a sensor model. The Kinect v1 has its own. A model whose noise grows with z² alone
    /// is treated as a stereo camera, any other as a time-of-flight camera. Returns [`NONE`](Self::NONE) for a model
    /// without noise.
    ///
    /// The standard deviation comes from the model. Correlation and behaviour at depth steps are assumptions. Stereo
    /// cameras match windows of about 7 pixels, so errors are correlated over 3 pixels and edges fray; they resolve
    /// 1/32 pixel of disparity, with a noise of 0.08 pixels (RealSense D400). Time-of-flight cameras have almost
    /// independent pixels and no shadow, and mix both sides of an edge.
    pub fn of_sensor(sensor: &SensorModel) -> Self {
        let sigma = sensor.sigma.map(f64::from);
        match sigma {
            _ if *sensor == SensorModel::KINECT_V1 => Self::default(),
            [0.0, 0.0, 0.0] => Self::NONE,
            [0.0, 0.0, sigma_at_1m] => Self {
                unit: ErrorUnit::Disparity { step_at_1m: sigma_at_1m / STEREO_NOISE_IN_STEPS },
                fixed_pattern_rms: 0.8 * STEREO_NOISE_IN_STEPS,
                fixed_pattern_correlation_px: 3.0,
                temporal_rms: 0.6 * STEREO_NOISE_IN_STEPS,
                temporal_correlation_px: 0.0,
                edge_jitter_px: 1.5,
                flying_pixel_probability: 0.15,
                projector_baseline_m: 0.05,
                dropout_incidence_deg: 70.0,
                min_range_m: 0.3,
                max_range_m: 6.0,
            },
            _ => Self {
                unit: ErrorUnit::Depth { sigma },
                fixed_pattern_rms: 0.3,
                fixed_pattern_correlation_px: 1.0,
                temporal_rms: 0.95,
                temporal_correlation_px: 0.0,
                edge_jitter_px: 0.3,
                flying_pixel_probability: 0.3,
                projector_baseline_m: 0.0,
                dropout_incidence_deg: 75.0,
                min_range_m: 0.25,
                max_range_m: 6.0,
            },
        }
    }
}

impl DepthNoise {
    /// Returns the standard deviation of a measurement at `range_m`, in metres, including the error of rounding.
    pub fn deviation_m(&self, range_m: f64) -> f64 {
        let squares = self.fixed_pattern_rms.powi(2) + self.temporal_rms.powi(2);
        match self.unit {
            ErrorUnit::Disparity { step_at_1m } => (squares + 1.0 / 12.0).sqrt() * step_at_1m * range_m * range_m,
            ErrorUnit::Depth { sigma: [c0, c1, c2] } => squares.sqrt() * (c0 + range_m * (c1 + range_m * c2)),
        }
    }
}

/// Stereo disparity noise of 0.08 pixels, in steps of 1/32 pixel.
const STEREO_NOISE_IN_STEPS: f64 = 0.08 * 32.0;

/// Turns noise-free images of one camera into depth frames.
pub struct DepthSimulator {
    noise: DepthNoise,
    camera: Camera,
    seed: u64,
    /// One value per pixel, in multiples of the noise unit; the same for all frames.
    fixed_pattern: Vec<f32>,
}

const STREAM_FIXED_PATTERN: u64 = 3;
const STREAM_FRAME: u64 = 4;
const STREAM_TEMPORAL: u64 = 1 << 48;

impl DepthSimulator {
    /// Creates a simulator whose fixed pattern is determined by the seed.
    pub fn new(noise: DepthNoise, camera: Camera, seed: u64) -> Self {
        let correlation_px = noise.fixed_pattern_correlation_px;
        let random = Random::new(seed, STREAM_FIXED_PATTERN);
        let fixed_pattern = correlated(noise.fixed_pattern_rms, correlation_px, &camera, random);
        Self { noise, camera, seed, fixed_pattern }
    }

    /// Returns frame `index` of `truth`; frames differ only in their temporal noise.
    ///
    /// Returns an error if `truth` was rendered with a camera of a different size.
    pub fn frame(&self, truth: &Truth, index: u64) -> Result<DepthFrame, FrameError> {
        let (width, height) = (self.camera.width, self.camera.height);
        let (frame_width, frame_height) = (truth.camera.width, truth.camera.height);
        if (frame_width, frame_height) != (width, height) {
            return Err(FrameError::ShapeMismatch { frame_width, frame_height, width, height });
        }
        let correlation_px = self.noise.temporal_correlation_px;
        let temporal = (correlation_px > 0.0).then(|| {
            let random = Random::new(self.seed, STREAM_TEMPORAL + index);
            correlated(1.0, correlation_px, &self.camera, random)
        });
        let mut raw = vec![0; width * height];
        raw.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            let stream = STREAM_FRAME + (index * height as u64 + v as u64);
            let temporal = temporal.as_ref().map(|temporal| &temporal[v * width..(v + 1) * width]);
            self.simulate_row(truth, v, temporal, &mut Random::new(self.seed, stream), row);
        });
        Ok(DepthFrame::new(self.camera, raw)?.with_rgb(colours(truth)))
    }

    /// Simulates row `v`. If `noise` is `None`, draws independent temporal noise for each pixel.
    fn simulate_row(&self, truth: &Truth, v: usize, noise: Option<&[f32]>, random: &mut Random, row: &mut [u16]) {
        let shadow = self.shadow(truth, v);
        for (u, raw) in row.iter_mut().enumerate() {
            let i = v * self.camera.width + u;
            // Drawn for every pixel, so that a pixel's noise does not depend on what its neighbours show.
            let (temporal, jitter_u, jitter_v) = (random.normal(), random.normal(), random.normal());
            let temporal = noise.map_or(temporal, |noise| f64::from(noise[u]));
            let (drop_chance, fly_chance, fly_at) = (random.uniform(), random.uniform(), random.uniform());
            if shadow[u] || drop_chance < self.dropout_probability(truth.incidence_cosine(i)) {
                continue;
            }
            let mut depth_m = f64::from(truth.points.z()[i]);
            if let Some(other) = self.beyond_step(truth, u, v, jitter_u, jitter_v) {
                depth_m = other;
            }
            if fly_chance < self.noise.flying_pixel_probability
                && let Some(other) = step_neighbour(truth, u, v)
            {
                depth_m += fly_at * (other - depth_m);
            }
            *raw = self.measure(depth_m, f64::from(self.fixed_pattern[i]) + self.noise.temporal_rms * temporal);
        }
    }

    /// Returns the raw depth for `depth_m` with an `error` in noise units, quantized; 0 if the result is out of range.
    fn measure(&self, depth_m: f64, error: f64) -> u16 {
        let measured = match self.noise.unit {
            ErrorUnit::Disparity { step_at_1m } => 1.0 / (step_at_1m * (1.0 / (step_at_1m * depth_m) + error).round()),
            ErrorUnit::Depth { sigma: [c0, c1, c2] } => depth_m + error * (c0 + depth_m * (c1 + depth_m * c2)),
        };
        let in_range = measured >= self.noise.min_range_m && measured <= self.noise.max_range_m;
        if in_range { self.camera.raw_depth(measured as f32) } else { 0 }
    }

    /// Marks the pixels of row v that the projector does not light. Going left, away from the projector, the column in
    /// the projector's image decreases as well; a pixel whose projector column was already passed is in the shadow of
    /// a nearer surface.
    fn shadow(&self, truth: &Truth, v: usize) -> Vec<bool> {
        let width = self.camera.width;
        let shift = self.noise.projector_baseline_m * self.camera.fx;
        let mut shadow = vec![false; width];
        let mut leftmost = f64::INFINITY;
        for u in (0..width).rev() {
            let in_projector = u as f64 - shift / f64::from(truth.points.z()[v * width + u]);
            // On a steep surface, the projector column may run back by a fraction of a pixel without a shadow.
            shadow[u] = shift > 0.0 && in_projector > leftmost + 1.0;
            leftmost = leftmost.min(in_projector);
        }
        shadow
    }

    /// Returns the probability of no measurement: 0 up to the dropout angle, rising linearly to 1 at 90°; 1 without a
    /// surface.
    fn dropout_probability(&self, incidence_cosine: f64) -> f64 {
        if incidence_cosine.is_nan() {
            return 1.0;
        }
        let angle_deg = incidence_cosine.clamp(0.0, 1.0).acos().to_degrees();
        let start = self.noise.dropout_incidence_deg;
        if angle_deg <= start { 0.0 } else { ((angle_deg - start) / (90.0 - start)).min(1.0) }
    }

    /// Returns the depth at a randomly offset pixel; `None` unless a depth step separates it from pixel (u, v).
    fn beyond_step(&self, truth: &Truth, u: usize, v: usize, jitter_u: f64, jitter_v: f64) -> Option<f64> {
        let moved = |at: usize, by: f64, size: usize| {
            (at as f64 + self.noise.edge_jitter_px * by).round().clamp(0.0, size as f64 - 1.0) as usize
        };
        let (width, height) = (self.camera.width, self.camera.height);
        let (i, j) = (v * width + u, moved(v, jitter_v, height) * width + moved(u, jitter_u, width));
        (truth.is_step(i, j) && truth.objects[j] != NO_OBJECT).then(|| f64::from(truth.points.z()[j]))
    }
}

/// Returns the depth of a neighbouring pixel across a step, if there is one.
fn step_neighbour(truth: &Truth, u: usize, v: usize) -> Option<f64> {
    let (width, height) = (truth.camera.width, truth.camera.height);
    let i = v * width + u;
    let neighbours = [
        (u > 0).then(|| i - 1),
        (u + 1 < width).then(|| i + 1),
        (v > 0).then(|| i - width),
        (v + 1 < height).then(|| i + width),
    ];
    neighbours
        .into_iter()
        .flatten()
        .find(|&j| truth.objects[j] != NO_OBJECT && truth.is_step(i, j))
        .map(|j| f64::from(truth.points.z()[j]))
}

/// Filters white noise by a Gaussian. With standard deviation s, values at distance d have correlation exp(-d²/4s²).
fn correlated(rms: f64, correlation_px: f64, camera: &Camera, mut random: Random) -> Vec<f32> {
    let (width, height) = (camera.width, camera.height);
    let sigma = (correlation_px / 2.0).max(0.1);
    let reach = (4.0 * sigma).ceil() as isize;
    let weights: Vec<f64> = (-reach..=reach).map(|d| (-0.5 * (d as f64 / sigma).powi(2)).exp()).collect();
    // The variance of a weighted sum of independent values is the sum of the squared weights.
    let norm = 1.0 / weights.iter().map(|w| w * w).sum::<f64>().sqrt();
    let white: Vec<f64> = (0..width * height).map(|_| random.normal()).collect();
    let at = |values: &[f64], u: isize, v: isize| {
        // Wrapping around keeps the variance the same at the border.
        values[v.rem_euclid(height as isize) as usize * width + u.rem_euclid(width as isize) as usize]
    };
    let blur = |values: Vec<f64>, du: isize, dv: isize| -> Vec<f64> {
        (0..width * height)
            .into_par_iter()
            .map(|i| {
                let (u, v) = ((i % width) as isize, (i / width) as isize);
                let sum = |(d, w): (isize, &f64)| w * at(&values, u + d * du, v + d * dv);
                norm * (-reach..).zip(&weights).map(sum).sum::<f64>()
            })
            .collect()
    };
    blur(blur(white, 1, 0), 0, 1).into_iter().map(|x| (rms * x) as f32).collect()
}

/// Returns a colour for each object, shaded by the angle of incidence, 3 bytes per pixel.
fn colours(truth: &Truth) -> Vec<u8> {
    const PALETTE: [[f64; 3]; 8] = [
        [150.0, 140.0, 130.0],
        [190.0, 195.0, 200.0],
        [160.0, 110.0, 70.0],
        [200.0, 70.0, 60.0],
        [70.0, 130.0, 180.0],
        [90.0, 160.0, 80.0],
        [220.0, 180.0, 60.0],
        [150.0, 90.0, 160.0],
    ];
    let colour = |i: usize| {
        let id = truth.objects[i];
        let shade = 0.35 + 0.65 * truth.incidence_cosine(i);
        let palette = PALETTE[usize::from(id) % PALETTE.len()];
        palette.map(|c| if id == NO_OBJECT { 0 } else { (c * shade) as u8 })
    };
    (0..truth.objects.len()).flat_map(colour).collect()
}

#[cfg(test)]
mod tests {
    use super::super::{Pose, Scene, Shape};
    use super::*;

    fn wall(distance_m: f64) -> (Truth, Camera) {
        let camera = Camera::kinect_v1();
        let plane = Shape::Plane { point_m: [0.0, 0.0, distance_m], normal: [0.0, 0.0, 1.0] };
        let scene = Scene { objects: vec![plane] };
        (scene.render(&camera, &Pose::looking([0.0; 3], 0.0, 0.0)), camera)
    }

    /// Returns the depth errors in metres over the whole wall.
    fn errors(frame: &DepthFrame, distance_m: f64) -> Vec<f64> {
        frame.raw.iter().map(|&raw| f64::from(frame.camera.depth_m(raw)) - distance_m).collect()
    }

    fn rms(values: &[f64]) -> f64 {
        (values.iter().map(|x| x * x).sum::<f64>() / values.len() as f64).sqrt()
    }

    #[test]
    fn without_noise_only_the_millimetre_remains() {
        let (truth, camera) = wall(1.2344);
        let frame = DepthSimulator::new(DepthNoise::NONE, camera, 1).frame(&truth, 0).unwrap();
        assert!(frame.raw.iter().all(|&raw| raw == 1234));
    }

    #[test]
    fn the_error_has_the_size_and_the_correlation_that_the_parameters_say() {
        let (truth, camera) = wall(2.0);
        let noise = DepthNoise { projector_baseline_m: 0.0, ..DepthNoise::default() };
        let simulator = DepthSimulator::new(noise, camera, 5);
        let frame = errors(&simulator.frame(&truth, 0).unwrap(), 2.0);
        // Fixed pattern, temporal noise and rounding (1/12 unit²) are independent.
        let unit = SensorModel::KINECT_V1.step_m(2.0);
        let expected = unit * (0.25f64 + 0.09 + 1.0 / 12.0).sqrt();
        assert!((rms(&frame) / expected - 1.0).abs() < 0.05, "{} {expected}", rms(&frame));

        let correlation = |lag: usize| {
            let pairs = frame.chunks(640).flat_map(|row| row.iter().zip(&row[lag..]));
            let (sum, n) = pairs.fold((0.0, 0), |(sum, n), (a, b)| (sum + a * b, n + 1));
            sum / f64::from(n) / rms(&frame).powi(2)
        };
        // In a real tripod sequence, the correlation is 0.65, 0.50, 0.35 and 0.18 at 1, 2, 3 and 5 pixels.
        assert!((0.4..0.7).contains(&correlation(1)), "{}", correlation(1));
        assert!((0.2..0.5).contains(&correlation(2)), "{}", correlation(2));
        assert!(correlation(5) < 0.1, "{}", correlation(5));

        // The fixed pattern remains when frames are averaged.
        let mut mean = vec![0.0; frame.len()];
        for index in 0..20 {
            for (m, error) in mean.iter_mut().zip(errors(&simulator.frame(&truth, index).unwrap(), 2.0)) {
                *m += error / 20.0;
            }
        }
        assert!(rms(&mean) > 0.7 * rms(&frame));
    }

    #[test]
    fn every_kind_of_sensor_has_the_noise_that_its_model_states() {
        let range_m = 2.0;
        let (truth, camera) = wall(range_m);
        for sensor in [SensorModel::KINECT_V1, SensorModel::REALSENSE_D435, SensorModel::AZURE_KINECT] {
            let noise = DepthNoise { projector_baseline_m: 0.0, ..DepthNoise::of_sensor(&sensor) };
            let found = rms(&errors(&DepthSimulator::new(noise, camera, 5).frame(&truth, 0).unwrap(), range_m));
            let stated = sensor.sigma_m(range_m);
            assert!((found / stated - 1.0).abs() < 0.07, "{sensor:?}: {found} m, stated {stated} m");
        }
        assert_eq!(DepthNoise::of_sensor(&SensorModel::EXACT), DepthNoise::NONE);
    }

    #[test]
    fn frames_repeat_by_seed_and_index() {
        let (truth, camera) = wall(1.0);
        let simulator = |seed| DepthSimulator::new(DepthNoise::default(), camera, seed);
        assert_eq!(simulator(3).frame(&truth, 7).unwrap(), simulator(3).frame(&truth, 7).unwrap());
        assert_ne!(simulator(3).frame(&truth, 7).unwrap().raw, simulator(3).frame(&truth, 8).unwrap().raw);
        assert_ne!(simulator(3).frame(&truth, 7).unwrap().raw, simulator(4).frame(&truth, 7).unwrap().raw);
    }

    #[test]
    fn an_object_casts_a_shadow_on_its_left_and_steps_have_flying_pixels() {
        let camera = Camera::kinect_v1();
        let scene = Scene {
            objects: vec![
                Shape::Plane { point_m: [0.0, 0.0, 2.0], normal: [0.0, 0.0, 1.0] },
                Shape::Sphere { centre_m: [0.0, 0.0, 1.0], radius_m: 0.1 },
            ],
        };
        let truth = scene.render(&camera, &Pose::looking([0.0; 3], 0.0, 0.0));
        let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).unwrap();
        let row = &frame.raw[240 * 640..241 * 640];
        // The disparities at 1 m and 2 m differ by 0.075 * 525 / 2 = 20 pixels.
        let holes = |range: std::ops::Range<usize>| row[range].iter().filter(|&&raw| raw == 0).count();
        assert!(holes(230..275) >= 15, "{}", holes(230..275));
        assert!(holes(380..420) <= 2, "{}", holes(380..420));
        let floating = frame.raw.iter().filter(|&&raw| (1150..1850).contains(&raw)).count();
        assert!(floating > 10, "{floating}");
    }
}
