//! Edge preservation: finds the surface of each point from the planes around it (docs/method.md, section 10).
//!
//! One pass fits the first planes of all pixels. Another derives each pixel's surface from them, and the mean of its
//! block's points on that surface. Each component of a plane is a channel with the layout of the padded frame.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::blocks::Block;
use super::padded::{PaddedFrame, PaddedRows};
use super::plane::{self, Plane, Points, Surface};
use super::row_tasks::SplitRows;
use super::vector::{Mask, Vec3, share, splat};
use super::window::{Candidates, Gate, Window};
use super::{Input, Kernel, polynomial_in_range, valid_points};
use crate::constants::{
    COSINE_FADE, DISTANCE_WEIGHT, DOUBT_WEIGHT, MIN_INCIDENCE_COSINE, MIN_NOISE, MIN_TOTAL, NARROW_WIDTH,
    OWN_NORMAL_WEIGHT, PLANE_REACH, STAY_WEIGHT,
};
use crate::params::{EngineParams, edge_shift_px};
use crate::range::{MAX_RADIUS_M, RangeRules};

// The channels.
const NORMAL: usize = 0;
const HEIGHT: usize = 3;
/// For a first plane: the variance along the normal plus the plane's uncertainty, in m². Larger, and finally infinite,
/// if neighbours are too few, collinear, or on a plane seen edge-on.
const RESIDUAL: usize = 4;
/// For a surface: the distance in metres within which neighbours count.
const WIDTH: usize = 4;
const CURVATURE: usize = 5;
/// The number of neighbours; negative if they are collinear.
const COUNT: usize = 6;
/// The square of the extent in m².
const EXTENT: usize = 7;
const CHANNELS: usize = 8;

/// A plane for each pixel of a frame: first planes, or the surfaces found from them.
pub(super) struct Planes {
    channels: [Vec<f32>; CHANNELS],
    row_len: usize,
    border: usize,
    /// Distance in pixels to the eight planes considered.
    shift: usize,
}

/// A band of rows of them, and of the samples that change with them.
pub(super) struct PlaneRows<'a> {
    /// The first row's number in the image.
    first: usize,
    channels: [&'a mut [f32]; CHANNELS],
    row_len: usize,
    border: usize,
    means: Option<PaddedRows<'a>>,
}

/// Returns the standard deviation of depth at a range, between bounds whose squares are within f32, whatever the
/// coordinates.
#[inline(always)]
fn noise<S: Simd>(simd: S, rules: &RangeRules, range: S::f32s, radius: S::f32s) -> S::f32s {
    let noise = polynomial_in_range(simd, rules.sigma, range).max(radius * splat(simd, MIN_NOISE));
    noise.max(splat(simd, 1e-15)).min(splat(simd, MAX_RADIUS_M))
}

impl SplitRows for PlaneRows<'_> {
    fn count(&self) -> usize {
        self.channels[0].len() / self.row_len
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, channels, row_len, border, means } = self;
        let [mut before, mut after]: [[&mut [f32]; CHANNELS]; 2] = Default::default();
        for (k, channel) in channels.into_iter().enumerate() {
            (before[k], after[k]) = channel.split_at_mut(rows * row_len);
        }
        let (means, means_after) = means.map(|means| means.split_at(rows)).unzip();
        (
            Self { first, channels: before, row_len, border, means },
            Self { first: first + rows, channels: after, row_len, border, means: means_after },
        )
    }
}

impl PlaneRows<'_> {
    /// Returns the index of column u in the `row`-th of these rows.
    fn index(&self, row: usize, u: usize) -> usize {
        row * self.row_len + self.border + u
    }

    /// Stores planes from an index on, and their [`RESIDUAL`] or [`WIDTH`].
    #[inline(always)]
    fn store<S: Simd>(&mut self, at: usize, plane: &Plane<S>, residual_or_width: S::f32s, n: S::f32s) {
        self.store_channel::<S>(NORMAL, at, plane.normal.x);
        self.store_channel::<S>(NORMAL + 1, at, plane.normal.y);
        self.store_channel::<S>(NORMAL + 2, at, plane.normal.z);
        self.store_channel::<S>(HEIGHT, at, plane.height);
        self.store_channel::<S>(RESIDUAL, at, residual_or_width);
        self.store_channel::<S>(CURVATURE, at, plane.curvature);
        self.store_channel::<S>(COUNT, at, plane.degenerate.select(-n, n));
        self.store_channel::<S>(EXTENT, at, plane.extent_squared);
    }

    #[inline(always)]
    fn store_channel<S: Simd>(&mut self, channel: usize, at: usize, values: S::f32s) {
        values.store_slice(&mut self.channels[channel][at..at + S::f32s::LEN]);
    }
}

impl Planes {
    /// Room for the planes of frames with this padding.
    pub(super) fn new(params: &EngineParams, padded: &PaddedFrame) -> Self {
        let channels = std::array::from_fn(|_| vec![0.0; padded.z.len()]);
        Self { channels, row_len: padded.row_len, border: padded.border, shift: edge_shift_px(params.reach_px()) }
    }

    /// Bytes of the planes' channels.
    pub(super) fn bytes(&self) -> usize {
        self.channels.iter().map(|channel| size_of_val(&channel[..])).sum()
    }

    /// Returns the rows of the image, and of the means if blocks are averaged.
    pub(super) fn rows<'a>(&'a mut self, height: usize, means: Option<PaddedRows<'a>>) -> PlaneRows<'a> {
        let (row_len, border) = (self.row_len, self.border);
        let image = border * row_len..(border + height) * row_len;
        let channels = self.channels.each_mut().map(|channel| &mut channel[image.clone()]);
        PlaneRows { first: 0, channels, row_len, border, means }
    }

    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        S::f32s::from_slice(simd, &self.channels[channel][at..at + S::f32s::LEN])
    }

    #[inline(always)]
    fn normal<S: Simd>(&self, simd: S, at: usize) -> Vec3<S> {
        Vec3::new(self.load(simd, NORMAL, at), self.load(simd, NORMAL + 1, at), self.load(simd, NORMAL + 2, at))
    }

    /// Returns the planes from an index on, unchanged.
    #[inline(always)]
    fn plane<S: Simd>(&self, simd: S, at: usize) -> Plane<S> {
        Plane {
            normal: self.normal(simd, at),
            height: self.load(simd, HEIGHT, at),
            residual: splat(simd, 0.0),
            doubt: splat(simd, 1.0),
            extent_squared: self.load(simd, EXTENT, at),
            curvature: self.load(simd, CURVATURE, at),
            off_line: splat(simd, 0.0),
            degenerate: self.load(simd, COUNT, at).simd_lt(splat(simd, 0.0)),
        }
    }

    /// Returns the surfaces from an index on, as their pass has found them.
    #[inline(always)]
    pub(super) fn surface<S: Simd>(&self, simd: S, at: usize) -> Surface<S> {
        let n = self.load(simd, COUNT, at).abs();
        Surface { plane: self.plane(simd, at), n, width: Some(self.load(simd, WIDTH, at)) }
    }

    /// Finds the surfaces of the points from an index on, from their first planes and the eight around them; returns
    /// plane, number of neighbours and width. The distance of `mean` from a plane determines how well it fits.
    #[inline(always)]
    fn find_surface<S: Simd>(
        &self,
        simd: S,
        measured: &PaddedFrame,
        here: usize,
        points: Points<S>,
        mean: Vec3<S>,
        noise: S::f32s,
    ) -> (Plane<S>, S::f32s, S::f32s) {
        let Points { p, ray, radius, valid } = points;
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let per_variance = one / (noise * noise);
        let gate = Gate::new(simd, radius * splat(simd, PLANE_REACH));
        let to_mean = mean.sub(p);
        let mut plane = self.plane(simd, here);
        let (mut normal, mut height, mut total) =
            (plane.normal.scale(splat(simd, OWN_NORMAL_WEIGHT)), zero, splat(simd, STAY_WEIGHT));
        for row in 0..3 {
            for column in 0..3 {
                let at = here + self.shift * (row * self.row_len + column) - self.shift * (self.row_len + 1);
                let offset = measured.load(simd, at).sub(p);
                let (nearness, near) = gate.weight(simd, offset);
                let n = self.normal(simd, at);
                // Distance from p to the plane along the plane's normal.
                let to_plane = offset.dot(n) + self.load(simd, HEIGHT, at);
                let from_mean = to_plane - to_mean.dot(n);
                let residual =
                    (from_mean * from_mean).mul_add(splat(simd, DISTANCE_WEIGHT), self.load(simd, RESIDUAL, at));
                let badness = residual.mul_add(per_variance, one);
                let square = badness * badness;
                // An unusable plane has an infinite residual, hence no weight. One that is not near may hold anything,
                // and changes nothing.
                let weight = nearness / (square * square);
                normal = normal.add_scaled(weight, n).or(near, normal);
                height = near.select(weight.mul_add(to_plane, height), height);
                total = near.select(total + weight, total);
            }
        }
        // A hole may hold anything, and so may a point on a line.
        let has_plane = valid & self.load(simd, COUNT, here).simd_ge(splat(simd, 3.0));
        // Planes that disagree may lie further away than a point may move.
        let height = (height / total).max(-radius).min(radius);
        let length = has_plane.select(normal.dot(normal), one).sqrt();
        // The other way round it is the same plane.
        let away: Mask<S> = normal.dot(ray).simd_gt(zero);
        let sign = away.select(-one, one);
        plane.normal = normal.scale(sign / length).or(has_plane, plane.normal);
        plane.height = has_plane.select(sign * height, plane.height);
        let width = has_plane.select(splat(simd, NARROW_WIDTH) * noise, splat(simd, f32::INFINITY));
        (plane, self.load(simd, COUNT, here).abs(), width)
    }
}

/// Returns how far planes are usable, from 0 to 1: 0 if neighbours are too few, collinear, or on a plane seen edge-on.
#[inline(always)]
fn usable<S: Simd>(simd: S, ray: Vec3<S>, plane: &Plane<S>, total: S::f32s) -> S::f32s {
    // Scaled, since the squares may be too large.
    let largest = ray.x.abs().max(ray.y.abs()).max(ray.z.abs()).max(splat(simd, f32::MIN_POSITIVE));
    let direction = ray.scale(splat(simd, 1.0) / largest);
    let cosine = plane.normal.dot(direction).abs() / direction.dot(direction).sqrt();
    let enough = total - splat(simd, MIN_TOTAL);
    let facing = (cosine - splat(simd, MIN_INCIDENCE_COSINE)) * splat(simd, 1.0 / COSINE_FADE);
    share(simd, enough) * share(simd, plane.off_line) * share(simd, facing)
}

/// The pass of the first planes, for some rows.
#[inline(always)]
pub(super) fn fit_first_planes<S: Simd>(simd: S, input: Input<'_>, kernel: &Kernel, rows: &mut PlaneRows<'_>) {
    for row in 0..rows.count() {
        for u in (0..input.measured.width).step_by(S::f32s::LEN) {
            let v = rows.first + row;
            let p = input.measured.load(simd, input.measured.index(u, v));
            // Values stored for holes are never read.
            if !valid_points(simd, p).any_true() {
                continue;
            }
            let ray = kernel.sensor.ray(simd, p);
            let range = kernel.range(simd, ray);
            let radius = kernel.rules.radius(simd, range);
            let noise = noise(simd, &kernel.rules, range, radius);
            let sums = Window::at(input.samples, kernel, u, v).sums(simd, p, radius);
            let plane = plane::fit(simd, ray, &sums);
            let residual = (noise * noise * splat(simd, DOUBT_WEIGHT)).mul_add(plane.doubt, plane.residual);
            let usable = usable(simd, ray, &plane, sums.total);
            // A single point has no residual.
            let is_usable: Mask<S> = usable.simd_gt(splat(simd, 0.0));
            let residual = is_usable.select(residual / usable, splat(simd, f32::INFINITY));
            rows.store(rows.index(row, u), &plane, residual, sums.n);
        }
    }
}

/// Finds the surfaces of some rows. If blocks are averaged, it also replaces their means by the means of points on
/// these surfaces.
#[inline(always)]
pub(super) fn find_surfaces<S: Simd>(
    simd: S,
    measured: &PaddedFrame,
    first_planes: &Planes,
    kernel: &Kernel,
    rows: &mut PlaneRows<'_>,
) {
    for row in 0..rows.count() {
        for u in (0..measured.width).step_by(S::f32s::LEN) {
            let here = measured.index(u, rows.first + row);
            let p = measured.load(simd, here);
            let valid = valid_points(simd, p);
            if !valid.any_true() {
                continue;
            }
            let at = rows.index(row, u);
            let ray = kernel.sensor.ray(simd, p);
            let range = kernel.range(simd, ray);
            let radius = kernel.rules.radius(simd, range);
            let noise = noise(simd, &kernel.rules, range, radius);
            let mean = rows.means.as_ref().map_or(p, |means| means.load(simd, at));
            let points = Points { p, ray, radius, valid };
            let (plane, n, width) = first_planes.find_surface(simd, measured, here, points, mean, noise);
            rows.store(at, &plane, width, n);
            if let Some(means) = &mut rows.means {
                let block = Block::around(simd, measured, kernel, here, p, range);
                let mean = block.mean_on_surface(simd, &plane, width);
                means.store(at, mean.or(valid, Vec3::splat(simd, f32::NAN)));
            }
        }
    }
}
