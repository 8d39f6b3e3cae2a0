//! Edge preservation: finds the surface of each point from the planes around it (docs/method.md, section 10).
//!
//! One pass fits the first planes of all pixels. Another derives each pixel's surface from them, and the mean of its
//! block's points on that surface. Each component of a plane is a channel with the layout of the padded frame.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::bend::{self, Around, Bend};
use super::blocks::Block;
use super::eigen::{Symmetric, tangents};
use super::padded::{PaddedFrame, PaddedRows};
use super::plane::{self, Plane, Points, Surface};
use super::row_tasks::SplitRows;
use super::vector::{Mask, Vec3, share, splat};
use super::window::{Gate, Window};
use super::{Input, Kernel, polynomial_in_range, valid_points};
use crate::constants::{
    COSINE_FADE, DISTANCE_WEIGHT, DOUBT_WEIGHT, LEAST_VARIANCE, MIN_INCIDENCE_COSINE, MIN_NOISE, MIN_TOTAL,
    NARROW_WIDTH, OWN_NORMAL_WEIGHT, PLANE_REACH, STAY_WEIGHT,
};
use crate::params::{EngineParams, edge_shift_px};
use crate::range::{MAX_RADIUS_M, RangeRules};

// Channels of first planes and of surfaces: the normal...
const NORMAL: usize = 0;

// ...of first planes:
/// The mean of the neighbours, relative to the pixel's point.
const CENTROID: usize = 3;
/// The variance along the normal plus the plane's uncertainty, in m². Larger, and finally infinite, if neighbours are too
/// few, collinear, or on a plane seen edge-on.
const RESIDUAL: usize = 6;
/// The variance along the plane in m².
const SPREAD: usize = 7;
const CURVATURE: usize = 8;
/// The number of neighbours; negative if they are collinear.
const COUNT: usize = 9;
/// The square of the extent in m².
const EXTENT: usize = 10;
/// How the surface in the window bends: xx, xy, xz, yy, yz, zz.
const WINDOW_BEND: usize = 11;
const FIRST_CHANNELS: usize = 17;

// ...of surfaces:
const HEIGHT: usize = 3;
/// The distance in metres within which neighbours count.
const WIDTH: usize = 4;
/// How it bends along the tangents of its normal: uu, uv, vv.
const BEND: usize = 5;
const SURFACE_CHANNELS: usize = 8;

/// A plane for each pixel of a frame, as channels with the layout of the padded frame.
struct Planes<const CHANNELS: usize> {
    channels: [Vec<f32>; CHANNELS],
    row_len: usize,
    border: usize,
}

/// A band of rows of them, and of the samples that change with them.
pub(super) struct PlaneRows<'a, const CHANNELS: usize> {
    /// The first row's number in the image.
    first: usize,
    channels: [&'a mut [f32]; CHANNELS],
    row_len: usize,
    border: usize,
    means: Option<PaddedRows<'a>>,
}

/// Rows of first planes.
pub(super) type FirstRows<'a> = PlaneRows<'a, FIRST_CHANNELS>;
/// Rows of surfaces.
pub(super) type SurfaceRows<'a> = PlaneRows<'a, SURFACE_CHANNELS>;

/// The first planes of a frame.
pub(super) struct FirstPlanes {
    planes: Planes<FIRST_CHANNELS>,
    /// Distance in pixels to the eight planes considered.
    shift: usize,
}

/// The surfaces found from them.
pub(super) struct Surfaces {
    planes: Planes<SURFACE_CHANNELS>,
}

/// Returns the standard deviation of depth at a range, between bounds whose squares are within f32, whatever the
/// coordinates.
#[inline(always)]
fn noise<S: Simd>(simd: S, rules: &RangeRules, range: S::f32s, radius: S::f32s) -> S::f32s {
    let noise = polynomial_in_range(simd, rules.sigma, range).max(radius * splat(simd, MIN_NOISE));
    noise.max(splat(simd, 1e-15)).min(splat(simd, MAX_RADIUS_M))
}

impl<const CHANNELS: usize> SplitRows for PlaneRows<'_, CHANNELS> {
    fn count(&self) -> usize {
        self.channels[0].len() / self.row_len
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, channels, row_len, border, means } = self;
        let [mut before, mut after] = [(); 2].map(|()| std::array::from_fn(|_| <&mut [f32]>::default()));
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

impl<const CHANNELS: usize> PlaneRows<'_, CHANNELS> {
    /// Returns the index of column u in the `row`-th of these rows.
    fn index(&self, row: usize, u: usize) -> usize {
        row * self.row_len + self.border + u
    }

    #[inline(always)]
    fn store<S: Simd>(&mut self, channel: usize, at: usize, values: S::f32s) {
        values.store_slice(&mut self.channels[channel][at..at + S::f32s::LEN]);
    }

    #[inline(always)]
    fn store_vector<S: Simd>(&mut self, channel: usize, at: usize, vector: Vec3<S>) {
        self.store::<S>(channel, at, vector.x);
        self.store::<S>(channel + 1, at, vector.y);
        self.store::<S>(channel + 2, at, vector.z);
    }
}

impl<const CHANNELS: usize> Planes<CHANNELS> {
    fn new(padded: &PaddedFrame) -> Self {
        let channels = std::array::from_fn(|_| vec![0.0; padded.z.len()]);
        Self { channels, row_len: padded.row_len, border: padded.border }
    }

    fn bytes(&self) -> usize {
        self.channels.iter().map(|channel| size_of_val(&channel[..])).sum()
    }

    fn rows<'a>(&'a mut self, height: usize, means: Option<PaddedRows<'a>>) -> PlaneRows<'a, CHANNELS> {
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
    fn vector<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        Vec3::new(self.load(simd, channel, at), self.load(simd, channel + 1, at), self.load(simd, channel + 2, at))
    }
}

impl Surfaces {
    /// Room for the surfaces of frames with this padding.
    pub(super) fn new(padded: &PaddedFrame) -> Self {
        Self { planes: Planes::new(padded) }
    }

    /// Bytes of the channels.
    pub(super) fn bytes(&self) -> usize {
        self.planes.bytes()
    }

    /// Returns the rows of the image, and of the means if blocks are averaged.
    pub(super) fn rows<'a>(&'a mut self, height: usize, means: Option<PaddedRows<'a>>) -> SurfaceRows<'a> {
        self.planes.rows(height, means)
    }

    /// Returns the surfaces from an index on, as their pass has found them.
    #[inline(always)]
    pub(super) fn surface<S: Simd>(&self, simd: S, first_planes: &FirstPlanes, at: usize) -> Surface<S> {
        let plane = Plane {
            normal: self.planes.vector(simd, NORMAL, at),
            height: self.planes.load(simd, HEIGHT, at),
            ..first_planes.plane(simd, at)
        };
        let bend = Bend {
            uu: self.planes.load(simd, BEND, at),
            uv: self.planes.load(simd, BEND + 1, at),
            vv: self.planes.load(simd, BEND + 2, at),
        };
        let width = self.planes.load(simd, WIDTH, at);
        Surface { plane, n: first_planes.count(simd, at).abs(), width: Some(width), bend: Some(bend) }
    }
}

/// A first plane that may be the surface of a point, and how much it counts. Without a weight, all is 0.
struct Candidate<S: Simd> {
    /// Offset of its centroid from the point.
    centroid: Vec3<S>,
    normal: Vec3<S>,
    nearness: S::f32s,
    variance: S::f32s,
    spread: S::f32s,
    /// How its window bends.
    window_bend: Symmetric<S>,
}

/// Weighs the candidates by how well they fit a point, whose surface bends like this along the tangents `frame` if it
/// `BENDS`. Returns their sums, for the bend only if it does not yet, and that of their heights.
#[inline(always)]
fn vote<S: Simd, const BENDS: bool>(
    simd: S,
    candidates: &[Candidate<S>; 9],
    to_mean: Vec3<S>,
    per_variance: S::f32s,
    bend: &Bend<S>,
    frame: (Vec3<S>, Vec3<S>),
) -> (Around<S>, S::f32s) {
    let one = splat(simd, 1.0);
    let (mut around, mut height) = (Around::nothing(simd), splat(simd, 0.0));
    for candidate in candidates {
        let n = candidate.normal;
        // Distance from p to the surface along the plane's normal.
        let mut to_surface = candidate.centroid.dot(n);
        let mut variance = candidate.variance;
        if BENDS {
            let square = bend.of(candidate.centroid.dot(frame.0), candidate.centroid.dot(frame.1));
            to_surface = square.mul_add(splat(simd, 0.5), to_surface);
            to_surface -= candidate.spread * bend.trace() * splat(simd, 0.25);
            let bent = bend::variance(simd, bend, candidate.spread);
            variance = (variance - bent).max(variance * splat(simd, LEAST_VARIANCE));
        }
        let from_mean = to_surface - to_mean.dot(n);
        let residual = (from_mean * from_mean).mul_add(splat(simd, DISTANCE_WEIGHT), variance);
        let badness = residual.mul_add(per_variance, one);
        let square = badness * badness;
        // An unusable plane has an infinite residual, hence no weight.
        let weight = candidate.nearness / (square * square);
        height = weight.mul_add(to_surface, height);
        around.add::<BENDS>(weight, candidate.centroid, n, &candidate.window_bend);
    }
    (around, height)
}

impl FirstPlanes {
    /// Room for the planes of frames with this padding.
    pub(super) fn new(params: &EngineParams, padded: &PaddedFrame) -> Self {
        Self { planes: Planes::new(padded), shift: edge_shift_px(params.reach_px()) }
    }

    /// Bytes of the channels.
    pub(super) fn bytes(&self) -> usize {
        self.planes.bytes()
    }

    /// Returns the rows of the image.
    pub(super) fn rows(&mut self, height: usize) -> FirstRows<'_> {
        self.planes.rows(height, None)
    }

    #[inline(always)]
    fn count<S: Simd>(&self, simd: S, at: usize) -> S::f32s {
        self.planes.load(simd, COUNT, at)
    }

    /// Returns the planes from an index on, unchanged.
    #[inline(always)]
    fn plane<S: Simd>(&self, simd: S, at: usize) -> Plane<S> {
        let (normal, centroid) = (self.planes.vector(simd, NORMAL, at), self.planes.vector(simd, CENTROID, at));
        Plane {
            normal,
            height: centroid.dot(normal),
            centroid,
            spread: self.planes.load(simd, SPREAD, at),
            residual: splat(simd, 0.0),
            doubt: splat(simd, 1.0),
            extent_squared: self.planes.load(simd, EXTENT, at),
            curvature: self.planes.load(simd, CURVATURE, at),
            off_line: splat(simd, 0.0),
            degenerate: self.count(simd, at).simd_lt(splat(simd, 0.0)),
        }
    }

    #[inline(always)]
    fn near<S: Simd>(&self, simd: S, channel: usize, at: usize, near: Mask<S>) -> S::f32s {
        near.select(self.planes.load(simd, channel, at), splat(simd, 0.0))
    }

    /// Returns the k-th of the nine planes around the points p from an index on.
    #[inline(always)]
    fn candidate<S: Simd>(
        &self,
        simd: S,
        measured: &PaddedFrame,
        (here, k): (usize, usize),
        p: Vec3<S>,
        gate: &Gate<S>,
    ) -> Candidate<S> {
        let row_len = self.planes.row_len;
        let at = here + self.shift * (k / 3 * row_len + k % 3) - self.shift * (row_len + 1);
        let (zero, nothing) = (splat(simd, 0.0), Vec3::splat(simd, 0.0));
        let offset = measured.load(simd, at).sub(p);
        let (nearness, near) = gate.weight(simd, offset);
        // One that is not near may hold anything.
        Candidate {
            centroid: offset.add(self.planes.vector(simd, CENTROID, at)).or(near, nothing),
            normal: self.planes.vector(simd, NORMAL, at).or(near, nothing),
            nearness: near.select(nearness, zero),
            variance: self.near(simd, RESIDUAL, at, near),
            spread: self.near(simd, SPREAD, at, near),
            window_bend: Symmetric {
                xx: self.near(simd, WINDOW_BEND, at, near),
                xy: self.near(simd, WINDOW_BEND + 1, at, near),
                xz: self.near(simd, WINDOW_BEND + 2, at, near),
                yy: self.near(simd, WINDOW_BEND + 3, at, near),
                yz: self.near(simd, WINDOW_BEND + 4, at, near),
                zz: self.near(simd, WINDOW_BEND + 5, at, near),
            },
        }
    }

    /// Finds the surfaces of the points from an index on, from their first planes and the eight around them. The distance
    /// of `mean` from a plane determines how well it fits.
    #[inline(always)]
    fn find_surface<S: Simd>(
        &self,
        simd: S,
        measured: &PaddedFrame,
        here: usize,
        points: Points<S>,
        mean: Vec3<S>,
        noise: S::f32s,
    ) -> Surface<S> {
        let Points { p, ray, radius, valid } = points;
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let per_variance = one / (noise * noise);
        let gate = Gate::new(simd, radius * splat(simd, PLANE_REACH));
        let to_mean = mean.sub(p);
        let mut plane = self.plane(simd, here);
        let count = self.count(simd, here);
        // A hole may hold anything, and so may a point on a line.
        let has_plane = valid & count.simd_ge(splat(simd, 3.0));
        let candidates = [
            self.candidate(simd, measured, (here, 0), p, &gate),
            self.candidate(simd, measured, (here, 1), p, &gate),
            self.candidate(simd, measured, (here, 2), p, &gate),
            self.candidate(simd, measured, (here, 3), p, &gate),
            self.candidate(simd, measured, (here, 4), p, &gate),
            self.candidate(simd, measured, (here, 5), p, &gate),
            self.candidate(simd, measured, (here, 6), p, &gate),
            self.candidate(simd, measured, (here, 7), p, &gate),
            self.candidate(simd, measured, (here, 8), p, &gate),
        ];
        let own_normal = plane.normal.scale(splat(simd, OWN_NORMAL_WEIGHT));
        let none = (Vec3::splat(simd, 0.0), Vec3::splat(simd, 0.0));
        let flat = Bend::none(simd);
        let (around, height) = vote::<S, false>(simd, &candidates, to_mean, per_variance, &flat, none);
        let (mut normal, mut sign) = facing(simd, around.normal.add(own_normal), ray, has_plane);
        let frame = tangents(simd, normal);
        let (bend, centre) = around.bend(simd, frame, radius, noise);
        let (mut total, mut height) = (around.total, height);
        // Most surfaces are flat.
        if (bend.square().simd_gt(zero) & has_plane).any_true() {
            let (around, height_m) = vote::<S, true>(simd, &candidates, to_mean, per_variance, &bend, frame);
            (normal, sign) = facing(simd, around.normal.add(own_normal), ray, has_plane);
            (total, height) = (around.total, height_m);
        }
        // Planes that disagree may lie further away than a point may move.
        let height = sign * (height / (total + splat(simd, STAY_WEIGHT))).max(-radius).min(radius);
        // In the middle of the planes, where this normal is, the slope differs from that at p.
        let (a, b) = bend.times(centre[0], centre[1]);
        let tilted = normal.add_scaled(a, frame.0).add_scaled(b, frame.1);
        // The other way round it is the same surface.
        let (tilted, side) = facing(simd, tilted, ray, has_plane);
        plane.normal = tilted.or(has_plane, plane.normal);
        plane.height = has_plane.select(side * height, plane.height);
        let width = has_plane.select(splat(simd, NARROW_WIDTH) * noise, splat(simd, f32::INFINITY));
        let bend = bend.turned(frame, tangents(simd, plane.normal)).scale(side);
        let bend = Bend {
            uu: has_plane.select(bend.uu, zero),
            uv: has_plane.select(bend.uv, zero),
            vv: has_plane.select(bend.vv, zero),
        };
        Surface { plane, n: count.abs(), width: Some(width), bend: Some(bend) }
    }
}

/// Returns unit normals towards the sensor where there are planes, and the signs by which they differ from the given ones.
#[inline(always)]
fn facing<S: Simd>(simd: S, normal: Vec3<S>, ray: Vec3<S>, has_plane: Mask<S>) -> (Vec3<S>, S::f32s) {
    let one = splat(simd, 1.0);
    let away: Mask<S> = normal.dot(ray).simd_gt(splat(simd, 0.0));
    let sign = away.select(-one, one);
    let length = has_plane.select(normal.dot(normal), one).sqrt();
    (normal.scale(sign / length), sign)
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
pub(super) fn fit_first_planes<S: Simd>(simd: S, input: Input<'_>, kernel: &Kernel, rows: &mut FirstRows<'_>) {
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
            let half = kernel.side / 2;
            let window = Window::at(input.samples, kernel, u, v);
            let (sums, places) = bend::sums(simd, window, p, radius, half);
            let plane = plane::fit(simd, ray, &sums);
            let residual = (noise * noise * splat(simd, DOUBT_WEIGHT)).mul_add(plane.doubt, plane.residual);
            let usable = usable(simd, ray, &plane, sums.total);
            // A single point has no residual.
            let is_usable: Mask<S> = usable.simd_gt(splat(simd, 0.0));
            let residual = is_usable.select(residual / usable, splat(simd, f32::INFINITY));
            let bend = places.bend(simd, half, radius, &sums, &plane);
            let at = rows.index(row, u);
            rows.store_vector(NORMAL, at, plane.normal);
            rows.store_vector(CENTROID, at, plane.centroid);
            rows.store::<S>(RESIDUAL, at, residual);
            rows.store::<S>(SPREAD, at, plane.spread);
            rows.store::<S>(CURVATURE, at, plane.curvature);
            rows.store::<S>(COUNT, at, plane.degenerate.select(-sums.n, sums.n));
            rows.store::<S>(EXTENT, at, plane.extent_squared);
            rows.store_vector(WINDOW_BEND, at, Vec3::<S>::new(bend.xx, bend.xy, bend.xz));
            rows.store_vector(WINDOW_BEND + 3, at, Vec3::<S>::new(bend.yy, bend.yz, bend.zz));
        }
    }
}

/// Finds the surfaces of some rows. If blocks are averaged, it also replaces their means by the means of points on
/// these surfaces.
#[inline(always)]
pub(super) fn find_surfaces<S: Simd>(
    simd: S,
    measured: &PaddedFrame,
    first_planes: &FirstPlanes,
    kernel: &Kernel,
    rows: &mut SurfaceRows<'_>,
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
            let Surface { plane, width, bend, .. } =
                first_planes.find_surface(simd, measured, here, points, mean, noise);
            let (width, bend) = (width.unwrap_or(noise), bend.unwrap_or(Bend::none(simd)));
            rows.store_vector(NORMAL, at, plane.normal);
            rows.store::<S>(HEIGHT, at, plane.height);
            rows.store::<S>(WIDTH, at, width);
            rows.store_vector(BEND, at, Vec3::<S>::new(bend.uu, bend.uv, bend.vv));
            if let Some(means) = &mut rows.means {
                let block = Block::around(simd, measured, kernel, here, p, range);
                let mean = block.mean_on_surface(simd, &plane, width);
                means.store(at, mean.or(valid, Vec3::splat(simd, f32::NAN)));
            }
        }
    }
}
