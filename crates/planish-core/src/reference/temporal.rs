//! Averages each pixel over the frames of a video, in f64 (docs/method.md, section 16).

use glam::DVec3;

use crate::camera::Camera;
use crate::pose::RigidTransform;
use crate::sensor::SensorModel;
use crate::temporal::{Domain, TemporalParams};

/// Width and height of a tile in pixels.
const TILE: usize = 16;

/// The state of a pixel.
#[derive(Clone, Copy)]
struct Pixel {
    /// Mean q of the averaged quantity.
    mean: f64,
    /// Effective number of frames n; 0 if the pixel is unknown.
    frames: f64,
    /// Bias b.
    bias: f64,
    /// Variance V.
    variance: f64,
    /// Number of frames a since the pixel was last seen.
    idle: u32,
    is_carried: bool,
}

impl Pixel {
    /// State of a pixel that has not been seen in any frame.
    const UNKNOWN: Self = Self { mean: 0.0, frames: 0.0, bias: 0.0, variance: 0.5, idle: 0, is_carried: false };
}

/// The state of a tile.
#[derive(Clone, Copy)]
struct Tile {
    bias: f64,
    variance: f64,
    weight: f64,
}

/// The measurement of a pixel in the current frame.
#[derive(Clone, Copy, Default)]
struct Measured {
    /// Value o; `None` for a hole.
    value: Option<f64>,
    /// Change e; `None` for unknown pixels and holes.
    change: Option<f64>,
    is_candidate: bool,
    /// True if the change is large enough for neighbours with the same sign to confirm it immediately.
    is_large: bool,
}

/// The temporal filter of docs/method.md, section 16.
pub struct TemporalReference {
    params: TemporalParams,
    sensor: SensorModel,
    shape: (usize, usize),
    pixels: Vec<Pixel>,
    tiles: Vec<Tile>,
}

impl TemporalReference {
    /// Creates a filter for the frames of a sensor.
    pub fn new(params: TemporalParams, sensor: SensorModel) -> Self {
        Self { params, sensor, shape: (0, 0), pixels: Vec::new(), tiles: Vec::new() }
    }

    /// Smooths the depth of the next frame in place.
    pub fn smooth(&mut self, width: usize, height: usize, depth_m: &mut [f64]) {
        self.start(width, height);
        self.smooth_here(false, depth_m);
    }

    /// Smooths the depth of the next frame of a camera that has moved.
    pub fn smooth_moved(&mut self, camera: &Camera, previous_from_current: &RigidTransform, depth_m: &mut [f64]) {
        self.start(camera.width, camera.height);
        if !previous_from_current.is_identity() {
            let moved = (0..depth_m.len()).map(|i| self.look_up(camera, previous_from_current, i, depth_m[i]));
            self.pixels = moved.map(Pixel::rounded).collect();
        }
        self.smooth_here(true, depth_m);
    }

    fn start(&mut self, width: usize, height: usize) {
        if self.shape != (width, height) {
            self.shape = (width, height);
            self.pixels = vec![Pixel::UNKNOWN; width * height];
            let tile = Tile { bias: 0.0, variance: 0.04, weight: 1.0 };
            self.tiles = vec![tile; width.div_ceil(TILE) * height.div_ceil(TILE)];
        }
    }

    fn smooth_here(&mut self, knows_motion: bool, depth_m: &mut [f64]) {
        let measured: Vec<Measured> = (0..depth_m.len()).map(|i| self.measure(i, depth_m[i])).collect();
        self.update_tiles(&measured, knows_motion);
        let calm: Vec<bool> = (0..depth_m.len()).map(|i| self.update(i, &measured, &mut depth_m[i])).collect();
        for (i, value) in depth_m.iter_mut().enumerate() {
            self.hold(i, &measured, &calm, value);
        }
    }

    /// Returns the effective number of frames averaged in a pixel of the last frame; 0 for a hole.
    pub fn frames(&self, i: usize) -> f64 {
        let pixel = &self.pixels[i];
        if pixel.idle == 0 || pixel.is_carried { pixel.frames } else { 0.0 }
    }

    /// Returns true if the value of a pixel of the last frame was carried over.
    pub fn is_carried(&self, i: usize) -> bool {
        self.pixels[i].is_carried
    }

    /// Returns the averaged quantity o, whose noise is constant, and its standard deviation.
    fn value(&self, depth_m: f64) -> (f64, f64) {
        let sigma_m = self.sensor.sigma_m(depth_m);
        let (value, sigma) = match Domain::of(&self.sensor) {
            Domain::InverseDepth => (1.0 / depth_m, sigma_m / (depth_m * depth_m)),
            Domain::Depth => (depth_m, sigma_m),
        };
        (value, sigma.max(1e-6 * value))
    }

    fn depth_m(&self, value: f64) -> f64 {
        match Domain::of(&self.sensor) {
            Domain::InverseDepth => 1.0 / value,
            Domain::Depth => value,
        }
    }

    /// Returns the state of pixel i as the current camera sees it, by equations (16.9) to (16.11).
    fn look_up(&self, camera: &Camera, previous_from_current: &RigidTransform, i: usize, depth_m: f64) -> Pixel {
        let (width, height) = self.shape;
        let depth_m = match depth_m {
            _ if depth_m > 0.0 && depth_m < 1e18 => depth_m,
            _ if self.pixels[i].frames > 0.0 => self.depth_m(self.pixels[i].mean),
            _ => return Pixel::UNKNOWN,
        };
        let seen_at = [((i % width) as f64 - camera.cx) / camera.fx, ((i / width) as f64 - camera.cy) / camera.fy];
        let Some([x, y]) = camera.distortion.undistort(seen_at) else { return Pixel::UNKNOWN };
        let before = previous_from_current.to_cloud(depth_m * DVec3::new(x, y, 1.0));
        let Some([u, v]) = camera.project(before.to_array()).filter(|_| before.z >= 0.05) else {
            return Pixel::UNKNOWN;
        };
        let is_inside = u > -0.5 && v > -0.5 && u < width as f64 - 0.5 && v < height as f64 - 0.5;
        if !is_inside {
            return Pixel::UNKNOWN;
        }
        let place = |u: f64, v: f64| {
            v.clamp(0.0, height as f64 - 1.0) as usize * width + u.clamp(0.0, width as f64 - 1.0) as usize
        };
        let (value, sigma) = self.value(before.z);
        let (mut weights, mut mean, mut frames, mut bias) = (0.0, 0.0, 0.0, 0.0);
        for (du, dv) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let (at_u, at_v) = (u.floor() + du, v.floor() + dv);
            let weight = (1.0 - (u - at_u).abs()) * (1.0 - (v - at_v).abs());
            let pixel = &self.pixels[place(at_u, at_v)];
            let band = 5.0 * sigma * (1.0 + 1.0 / pixel.frames.max(1.0)).sqrt() + 0.004 * value;
            if pixel.frames > 0.0 && (pixel.mean - value).abs() < band {
                weights += weight;
                mean += weight * pixel.mean;
                frames += weight * pixel.frames;
                bias += weight * pixel.bias;
            }
        }
        if weights <= 0.2 {
            return Pixel::UNKNOWN;
        }
        let nearest = Pixel { is_carried: false, ..self.pixels[place((u + 0.5).floor(), (v + 0.5).floor())] };
        let found = Pixel { mean: mean / weights, frames: frames / weights, bias: bias / weights, ..nearest };
        let now = previous_from_current.to_sensor(before / before.z * self.depth_m(found.mean));
        if now.z < 0.05 { Pixel::UNKNOWN } else { Pixel { mean: self.value(now.z).0, ..found } }
    }

    /// Measures pixel i by equations (16.1) and (16.3).
    fn measure(&self, i: usize, depth_m: f64) -> Measured {
        if !(depth_m > 0.0 && depth_m < 1e18) {
            return Measured::default();
        }
        let pixel = &self.pixels[i];
        let (value, sigma) = self.value(depth_m);
        if pixel.frames == 0.0 {
            return Measured { value: Some(value), ..Measured::default() };
        }
        let change = (value - pixel.mean) / (sigma * (1.0 + 1.0 / pixel.frames.max(1.0)).sqrt());
        let deviation = pixel.variance.sqrt().max(0.7);
        let (is_candidate, is_large) = (change.abs() > 4.0 * deviation, change.abs() > 5.0 * deviation);
        Measured { value: Some(value), change: Some(change), is_candidate, is_large }
    }

    /// Returns m_t of equation (16.5); `None` with 64 updated pixels or fewer.
    fn change_of_tile(&self, number: usize, measured: &[Measured]) -> Option<f64> {
        let (width, height) = self.shape;
        let across = width.div_ceil(TILE);
        let (left, top) = (number % across * TILE, number / across * TILE);
        let pixels = (top..(top + TILE).min(height))
            .flat_map(|v| (left..(left + TILE).min(width)).map(move |u| &measured[v * width + u]));
        let changes: Vec<f64> = pixels
            .filter(|measured| !measured.is_candidate)
            .filter_map(|measured| measured.change)
            .map(|change| change.clamp(-4.0, 4.0))
            .collect();
        (changes.len() > 64).then(|| changes.iter().sum::<f64>() / changes.len() as f64)
    }

    /// Updates the tiles by equations (16.5) and (16.6).
    fn update_tiles(&mut self, measured: &[Measured], knows_motion: bool) {
        let changes: Vec<Option<f64>> =
            (0..self.tiles.len()).map(|number| self.change_of_tile(number, measured)).collect();
        let (persistence, agreement) = if knows_motion { (0.0, 0.5) } else { self.common_change(&changes) };
        let by_place = (f64::max(agreement - 0.5, 0.0) / 0.12).powi(4);
        let of_camera = 1.0 / (1.0 + (persistence / 0.55).powi(8) + by_place);
        let gate = if knows_motion { 2.0 } else { 1.0 };
        for (tile, change) in self.tiles.iter_mut().zip(changes) {
            let Some(mean) = change else {
                (tile.bias, tile.weight) = (0.0, of_camera);
                continue;
            };
            let deviation = tile.variance.sqrt();
            let from_bias = (mean - tile.bias).abs().min(3.0 * deviation);
            tile.bias += (mean - tile.bias) / 4.0;
            let of_change = (mean / (3.0 * gate * deviation)).powi(4);
            tile.weight = of_camera / (1.0 + of_change + (tile.bias / (1.5 * gate * deviation)).powi(4));
            if persistence <= 0.5 && agreement <= 0.58 {
                let learnt = 0.875 * from_bias.powi(2) - tile.variance;
                tile.variance = (tile.variance + learnt / 16.0).clamp(0.0025, 1.0);
            }
        }
    }

    /// Returns P and A of equation (16.6): 0 and 1/2 with few tiles or small changes.
    fn common_change(&self, changes: &[Option<f64>]) -> (f64, f64) {
        let of_tiles = self.tiles.iter().zip(changes).filter_map(|(tile, change)| Some((tile, (*change)?)));
        let (mut biases, mut magnitudes): (Vec<f64>, Vec<f64>) =
            of_tiles.map(|(tile, change)| ((tile.bias + (change - tile.bias) / 4.0).abs(), change.abs())).unzip();
        if biases.len() < 150 {
            return (0.0, 0.5);
        }
        let median = |values: &mut [f64]| {
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let (bias, magnitude) = (median(&mut biases), median(&mut magnitudes));
        if magnitude <= 0.1 {
            return (0.0, 0.5);
        }
        let across = self.shape.0.div_ceil(TILE);
        let place = |i: usize| (i % across, i / across);
        let is_pair = |i: usize, j: usize| {
            let ((u, v), (other_u, other_v)) = (place(i), place(j));
            (v == other_v && u + 3 == other_u) || (u == other_u && v + 3 == other_v)
        };
        let (mut same, mut all) = (0.0, 0.0);
        for (i, j) in (0..changes.len()).flat_map(|i| [(i, i + 3), (i, i + 3 * across)]) {
            if let (Some(Some(one)), Some(Some(other)), true) = (changes.get(i), changes.get(j), is_pair(i, j)) {
                all += 1.0;
                same += f64::from(u8::from((*one > 0.0) == (*other > 0.0)));
            }
        }
        (bias / magnitude, if all > 0.0 { same / all } else { 0.5 })
    }

    /// Updates pixel i by equations (16.2) to (16.4) and (16.7). Returns true if the pixel is calm.
    fn update(&mut self, i: usize, measured: &[Measured], depth_m: &mut f64) -> bool {
        let (width, _) = self.shape;
        let tile_weight = self.tiles[i / width / TILE * width.div_ceil(TILE) + i % width / TILE].weight;
        let changes: Vec<f64> =
            self.around(i, 2).filter_map(|k| measured[k].change).map(|change| change.clamp(-8.0, 8.0)).collect();
        let mean_change = changes.iter().sum::<f64>() / changes.len().max(1) as f64;
        let Measured { value, change, is_candidate, is_large } = measured[i];
        let sign_of = |k: usize| measured[k].change.filter(|_| measured[k].is_candidate).map_or(0.0, f64::signum);
        let sign_sum: f64 = self.around(i, 1).map(sign_of).sum();
        let old = self.pixels[i];
        let is_certain = sign_of(i) * sign_sum >= 3.0 && is_large;
        let waits = is_candidate && !is_certain && old.idle == 0 && old.frames >= 3.0;
        let mut new = Pixel { is_carried: waits, ..old };
        let deviation = old.variance.sqrt();
        let is_calm = match (value, change) {
            (Some(value), Some(change)) if !is_candidate => {
                let from_bias = (mean_change - old.bias).abs().min(3.0 * deviation);
                new.bias = old.bias + (mean_change - old.bias) / 4.0;
                let around = (mean_change / (2.5 * deviation)).powi(4) + (new.bias / (1.2 * deviation)).powi(4);
                let own = (change / (6.0 * deviation.max(0.7))).powi(4);
                let weight = tile_weight / ((1.0 + around) * (1.0 + own));
                let most = f64::from(self.params.frames);
                new.frames = (old.frames * weight + 1.0).min(most);
                new.mean = old.mean + (value - old.mean) / new.frames;
                let learnt = 0.875 * from_bias.powi(2) - old.variance;
                new.variance = (old.variance + old.frames / (16.0 * most) * learnt).clamp(0.04, 2.25);
                new.idle = 0;
                *depth_m = self.depth_m(new.mean);
                mean_change.abs() < 3.0 * deviation
            }
            (Some(value), _) if !waits => {
                (new.mean, new.frames, new.bias, new.idle) = (value, 1.0, 0.0, 0);
                if is_candidate {
                    new.variance = old.variance.min(0.5);
                }
                false
            }
            _ => {
                new.idle = old.idle + 1;
                if new.idle > 8 {
                    (new.frames, new.idle) = (0.0, 0);
                }
                *depth_m = if waits { self.depth_m(old.mean) } else { f64::NAN };
                false
            }
        };
        self.pixels[i] = new.rounded();
        is_calm
    }

    /// Fills pixel i by equation (16.8) if it is a hole.
    fn hold(&mut self, i: usize, measured: &[Measured], calm: &[bool], depth_m: &mut f64) {
        let pixel = self.pixels[i];
        let is_recent = (1..=self.params.hold_frames).contains(&pixel.idle);
        if measured[i].value.is_some() || !is_recent || pixel.frames < 4.0 {
            return;
        }
        let is_calm = self.around(i, 2).filter(|&k| calm[k]).count() >= 13;
        if is_calm && !self.around(i, 2).any(|k| measured[k].is_candidate) {
            *depth_m = self.depth_m(pixel.mean);
            self.pixels[i].is_carried = true;
        }
    }

    /// Returns the pixels up to `reach` columns and rows from pixel `i`, itself included.
    fn around(&self, i: usize, reach: usize) -> impl Iterator<Item = usize> + use<> {
        let (width, height) = self.shape;
        let (u, v) = (i % width, i / width);
        let columns = u.saturating_sub(reach)..(u + reach + 1).min(width);
        let rows = v.saturating_sub(reach)..(v + reach + 1).min(height);
        rows.flat_map(move |v| columns.clone().map(move |u| v * width + u))
    }
}

impl Pixel {
    /// Rounds the state to the precision with which it is stored, in 12 bytes (16.7).
    fn rounded(self) -> Self {
        let round = |value: f64, steps: f64| (value * steps + 0.5).floor() / steps;
        Self {
            frames: round(self.frames, 2048.0),
            bias: round(self.bias + 8.0, 2048.0) - 8.0,
            variance: round(self.variance, 16384.0),
            ..self
        }
    }
}
