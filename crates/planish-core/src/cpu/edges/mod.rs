//! Edge preservation: finds the surface of each point from the planes around it (docs/method.md, section 10).
//!
//! The first pass fits the first planes of all cells or pixels. The second derives from them the surface of each cell
//! or pixel, and the mean of its block's points on that surface. Each component of a plane is a channel with the
//! layout of the padded frame. The results of the cells then replace the cells' surfaces, and the results of the
//! pixels are derived from the cells ([`pixels`]).

mod pixels;
mod vote;

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::bend::{self, Bend, Turn};
use super::blocks::Block;
use super::channels::Channels;
use super::eigen::tangents;
use super::padded::{PaddedFrame, PaddedRows};
use super::pixels::Pixels;
use super::plane::{self, Plane, Points, Surface};
use super::row_tasks::SplitRows;
use super::vector::{Mask, Vec3, share, splat};
use super::window::{Candidates, Gate, Window};
use super::{Input, Kernel, polynomial_in_range, valid_points};
use crate::constants::{
    COSINE_FADE, DOUBT_WEIGHT, MIN_INCIDENCE_COSINE, MIN_NOISE, MIN_TOTAL, NARROW_WIDTH, OWN_NORMAL_WEIGHT,
    PLANE_REACH, STAY_WEIGHT,
};
use crate::params::EngineParams;
use crate::range::{MAX_RADIUS_M, RangeRules};
pub(super) use pixels::{Found, results_of_pixels};
use vote::Voting;

// Channels of both first planes and surfaces: the normal (three channels), and the height over the point along it.
const NORMAL: usize = 0;
const HEIGHT: usize = 3;

// Channels of first planes only.
/// Variance along the normal plus the plane's uncertainty, in m². It rises to infinity as the neighbours become too
/// few, collinear, or part of a plane seen edge-on.
const RESIDUAL: usize = 4;
const CURVATURE: usize = 5;
/// The number of neighbours; negative if they are collinear.
const COUNT: usize = 6;
/// Square of the neighbourhood's in-plane extent, in m².
const EXTENT: usize = 7;
/// First of three channels: the mean of the neighbours, relative to the point.
const CENTROID: usize = 8;
/// Sum of the two variances along the plane, in m².
const SPREAD: usize = 11;
/// Sum of the principal curvatures measured within the window, in 1/m.
const WINDOW_BEND: usize = 12;
const FIRST_CHANNELS: usize = 13;

// Channels of surfaces only.
/// Distance from the surface within which neighbours count, in metres.
const WIDTH: usize = 4;
/// First of three channels: the bend along the tangents of the normal, in 1/m (uu, uv, vv).
const BEND: usize = 5;
/// Degree to which no plane around the point fits, from 0 to 1.
const NO_PLANE_FITS: usize = 8;
/// Certainty of the surface, from 0 (no plane near the point fits it) to 1. The results of cells do not overwrite
/// this channel.
const CERTAINTY: usize = 9;
const SURFACE_CHANNELS: usize = 10;

/// One plane for each cell of a frame, as channels with the layout of the padded frame.
struct Planes<const CHANNELS: usize> {
    channels: Channels<CHANNELS>,
    row_len: usize,
    border: usize,
}

/// A band of rows of planes, with the rows of block means that are written along with them.
pub(super) struct PlaneRows<'a, const CHANNELS: usize> {
    /// Index of the band's first row in the image.
    pub(super) first: usize,
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
    /// Distance to the eight surrounding planes that are considered, in cells along each axis.
    shift: usize,
}

/// The surfaces found from the first planes.
pub(super) struct Surfaces {
    planes: Planes<SURFACE_CHANNELS>,
}

/// Returns the standard deviation of depth at a range, limited to values whose squares fit in f32 for any
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
    /// Returns the index of column u in row `row` of this band.
    fn index(&self, row: usize, u: usize) -> usize {
        row * self.row_len + self.border + u
    }

    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        S::f32s::from_slice(simd, &self.channels[channel][at..at + S::f32s::LEN])
    }

    #[inline(always)]
    fn vector<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        Vec3::new(self.load(simd, channel, at), self.load(simd, channel + 1, at), self.load(simd, channel + 2, at))
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
        Self { channels: padded.channels(), row_len: padded.row_len, border: padded.border }
    }

    fn bytes(&self) -> usize {
        self.channels.bytes()
    }

    fn rows<'a>(&'a mut self, height: usize, means: Option<PaddedRows<'a>>) -> PlaneRows<'a, CHANNELS> {
        let (row_len, border) = (self.row_len, self.border);
        let image = border * row_len..(border + height) * row_len;
        PlaneRows { first: 0, channels: self.channels.range_mut(image), row_len, border, means }
    }

    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        self.channels.load(simd, channel, at)
    }

    #[inline(always)]
    fn vector<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        self.channels.vector(simd, channel, at)
    }
}

impl Surfaces {
    /// Allocates the surfaces of frames with the layout of `padded`.
    pub(super) fn new(padded: &PaddedFrame) -> Self {
        Self { planes: Planes::new(padded) }
    }

    /// Returns the size of the channels in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.planes.bytes()
    }

    /// Returns the rows of the image, with the rows of the block means if blocks are averaged.
    pub(super) fn rows<'a>(&'a mut self, height: usize, means: Option<PaddedRows<'a>>) -> SurfaceRows<'a> {
        self.planes.rows(height, means)
    }
}

impl SurfaceRows<'_> {
    /// Returns the surfaces found for the vector of points that starts at column u of row `row` of this band. `here`
    /// is the first point's index in the frame.
    #[inline(always)]
    pub(super) fn surface<S: Simd>(
        &self,
        simd: S,
        first_planes: &FirstPlanes,
        (u, row): (usize, usize),
        here: usize,
    ) -> Surface<S> {
        let at = self.index(row, u);
        let plane = Plane {
            normal: self.vector(simd, NORMAL, at),
            height: self.load(simd, HEIGHT, at),
            ..first_planes.plane(simd, here)
        };
        let bend = self.vector(simd, BEND, at);
        let bend: Bend<S> = Bend { uu: bend.x, uv: bend.y, vv: bend.z };
        let bends: Mask<S> = bend.square().simd_gt(splat(simd, 0.0));
        let width = self.load(simd, WIDTH, at);
        let n = first_planes.count(simd, here).abs();
        let no_plane_fits = self.load(simd, NO_PLANE_FITS, at);
        let exists: Mask<S> = no_plane_fits.simd_gt(splat(simd, 0.0));
        Surface {
            plane,
            n,
            width: Some(width),
            bend: bends.any_true().then_some(bend),
            no_plane_fits: exists.any_true().then_some(no_plane_fits),
        }
    }
}

impl FirstPlanes {
    /// Allocates the planes of frames with the layout of `padded`.
    pub(super) fn new(params: &EngineParams, padded: &PaddedFrame) -> Self {
        Self { planes: Planes::new(padded), shift: params.edge_shift() }
    }

    /// Returns the size of the channels in bytes.
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

    /// Returns the first planes of the vector of points that starts at an index.
    #[inline(always)]
    fn plane<S: Simd>(&self, simd: S, at: usize) -> Plane<S> {
        Plane {
            normal: self.planes.vector(simd, NORMAL, at),
            height: self.planes.load(simd, HEIGHT, at),
            centroid: Vec3::splat(simd, 0.0),
            spread: splat(simd, 0.0),
            residual: splat(simd, 0.0),
            doubt: splat(simd, 1.0),
            extent_squared: self.planes.load(simd, EXTENT, at),
            curvature: self.planes.load(simd, CURVATURE, at),
            off_line: splat(simd, 0.0),
            degenerate: self.count(simd, at).simd_lt(splat(simd, 0.0)),
        }
    }

    /// Derives the surfaces of the vector of points at index `here`, and their certainties, from each point's first
    /// plane and the eight around it. The distance of `mean` from a plane determines how well that plane fits.
    #[inline(always)]
    fn find_surface<S: Simd>(
        &self,
        simd: S,
        measured: &PaddedFrame,
        here: usize,
        points: Points<S>,
        mean: Vec3<S>,
        noise: S::f32s,
    ) -> (Surface<S>, S::f32s) {
        let Points { p, ray, radius, valid } = points;
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let gate = Gate::new(simd, radius * splat(simd, PLANE_REACH));
        let voting = Voting { measured, here, p, to_mean: mean.sub(p), per_variance: one / (noise * noise), gate };
        let mut plane = self.plane(simd, here);
        let count = self.count(simd, here);
        // The planes stored for holes and for points on a line are arbitrary.
        let has_plane = valid & count.simd_ge(splat(simd, 3.0));
        let vote = self.vote(simd, &voting);
        let own_normal = plane.normal.scale(splat(simd, OWN_NORMAL_WEIGHT));
        let (normal, sign) = facing(simd, vote.normal.add(own_normal), ray, has_plane);
        // Heights are measured along the mean normal of the planes, before it is turned towards the sensor.
        let per_total = one / (vote.total + splat(simd, STAY_WEIGHT));
        plane.normal = normal.or(has_plane, plane.normal);
        plane.height = has_plane.select(sign * moved::<S>(vote.height * per_total, radius), plane.height);
        let turn = Turn::new(simd, vote.total, vote.normal, radius, noise);
        let turns: Mask<S> = has_plane & turn.certain.simd_gt(zero);
        let mut bend = Bend::none(simd);
        // Most surfaces are flat and skip this step.
        if turns.any_true() {
            let frame = tangents(simd, normal);
            let measured = self.around(simd, &voting, &vote).bend(simd, &turn, frame, radius);
            let bends = turns & measured.bend.square().simd_gt(zero);
            // The normal applies to the middle of the planes, where the slope differs from that at p.
            let (a, b) = measured.bend.times(measured.centre[0], measured.centre[1]);
            let (tilted, side) = facing(simd, normal.add_scaled(a, frame.0).add_scaled(b, frame.1), ray, has_plane);
            plane.normal = tilted.or(bends, plane.normal);
            // A flipped normal with the opposite height describes the same surface.
            plane.height =
                bends.select(side * sign * moved::<S>((vote.height + measured.rise) * per_total, radius), plane.height);
            bend = measured.bend.turned(frame, tangents(simd, plane.normal)).scale(side).or_none(simd, bends);
        }
        let width = has_plane.select(splat(simd, NARROW_WIDTH) * noise, splat(simd, f32::INFINITY));
        let no_plane_fits = has_plane.select(self.no_plane_fits(simd, &voting, &vote), zero);
        let certainty = has_plane.select(vote.total * per_total, zero);
        let (width, bend, no_plane_fits) = (Some(width), Some(bend), Some(no_plane_fits));
        (Surface { plane, n: count.abs(), width, bend, no_plane_fits }, certainty)
    }
}

/// Limits heights to the radius: the mean of disagreeing planes may be farther away than a point may move.
#[inline(always)]
fn moved<S: Simd>(height: S::f32s, radius: S::f32s) -> S::f32s {
    height.max(-radius).min(radius)
}

/// Normalizes normals and turns them towards the sensor, in lanes with a plane. Also returns the sign by which each
/// was multiplied.
#[inline(always)]
fn facing<S: Simd>(simd: S, normal: Vec3<S>, ray: Vec3<S>, has_plane: Mask<S>) -> (Vec3<S>, S::f32s) {
    let one = splat(simd, 1.0);
    let away: Mask<S> = normal.dot(ray).simd_gt(splat(simd, 0.0));
    let sign = away.select(-one, one);
    let length = has_plane.select(normal.dot(normal), one).sqrt();
    (normal.scale(sign / length), sign)
}

/// Returns the degree to which planes are usable, from 0 to 1: 0 if neighbours are too few, collinear, or on a plane
/// seen edge-on.
#[inline(always)]
fn usable<S: Simd>(simd: S, ray: Vec3<S>, plane: &Plane<S>, total: S::f32s) -> S::f32s {
    // The ray is scaled, since its squares may overflow.
    let largest = ray.x.abs().max(ray.y.abs()).max(ray.z.abs()).max(splat(simd, f32::MIN_POSITIVE));
    let direction = ray.scale(splat(simd, 1.0) / largest);
    let cosine = plane.normal.dot(direction).abs() / direction.dot(direction).sqrt();
    let enough = total - splat(simd, MIN_TOTAL);
    let facing = (cosine - splat(simd, MIN_INCIDENCE_COSINE)) * splat(simd, 1.0 / COSINE_FADE);
    share(simd, enough) * share(simd, plane.off_line) * share(simd, facing)
}

/// Fits the first planes of some rows.
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
            let window = Window::at(input.samples, kernel, u, v);
            let sums = window.sums(simd, p, radius);
            let plane = plane::fit(simd, ray, &sums);
            let residual = (noise * noise * splat(simd, DOUBT_WEIGHT)).mul_add(plane.doubt, plane.residual);
            let usable = usable(simd, ray, &plane, sums.total);
            // The residual of a single point would be 0/0.
            let is_usable: Mask<S> = usable.simd_gt(splat(simd, 0.0));
            let residual = is_usable.select(residual / usable, splat(simd, f32::INFINITY));
            let window_bend = bend::of_window(simd, (window, kernel), p, radius, &plane);
            let at = rows.index(row, u);
            rows.store_vector(NORMAL, at, plane.normal);
            rows.store::<S>(HEIGHT, at, plane.height);
            rows.store::<S>(RESIDUAL, at, residual);
            rows.store::<S>(CURVATURE, at, plane.curvature);
            rows.store::<S>(COUNT, at, plane.degenerate.select(-sums.n, sums.n));
            rows.store::<S>(EXTENT, at, plane.extent_squared);
            rows.store_vector(CENTROID, at, plane.centroid);
            rows.store::<S>(SPREAD, at, plane.spread);
            rows.store::<S>(WINDOW_BEND, at, window_bend);
        }
    }
}

/// Input for the means of each block's points on its surface.
#[derive(Clone, Copy)]
pub(super) struct Blocks<'a> {
    pub(super) pixels: &'a Pixels,
    /// The means of all points of each block.
    pub(super) means: &'a PaddedFrame,
}

/// Finds the surfaces of some rows. With `blocks`, also computes the mean of each block's points on its surface.
#[inline(always)]
pub(super) fn find_surfaces<S: Simd>(
    simd: S,
    measured: &PaddedFrame,
    blocks: Option<Blocks<'_>>,
    first_planes: &FirstPlanes,
    kernel: &Kernel,
    rows: &mut SurfaceRows<'_>,
) {
    for row in 0..rows.count() {
        for u in (0..measured.width).step_by(S::f32s::LEN) {
            let place = (u, rows.first + row);
            let here = measured.index(place.0, place.1);
            let p = measured.load(simd, here);
            let valid = valid_points(simd, p);
            let at = rows.index(row, u);
            if !valid.any_true() {
                if let Some(means) = &mut rows.means {
                    means.store(at, Vec3::<S>::splat(simd, f32::NAN));
                }
                continue;
            }
            let ray = kernel.sensor.ray(simd, p);
            let range = kernel.range(simd, ray);
            let radius = kernel.rules.radius(simd, range);
            let noise = noise(simd, &kernel.rules, range, radius);
            let mean = match blocks {
                Some(blocks) => blocks.means.load(simd, here),
                None => p,
            };
            let points = Points { p, ray, radius, valid };
            let (Surface { plane, width, bend, no_plane_fits, .. }, certainty) =
                first_planes.find_surface(simd, measured, here, points, mean, noise);
            let (width, bend) = (width.unwrap_or(noise), bend.unwrap_or(Bend::none(simd)));
            let no_plane_fits = no_plane_fits.unwrap_or(splat(simd, 0.0));
            rows.store_vector(NORMAL, at, plane.normal);
            rows.store::<S>(HEIGHT, at, plane.height);
            rows.store::<S>(WIDTH, at, width);
            rows.store_vector(BEND, at, Vec3::<S>::new(bend.uu, bend.uv, bend.vv));
            rows.store::<S>(NO_PLANE_FITS, at, no_plane_fits);
            rows.store::<S>(CERTAINTY, at, certainty);
            if let (Some(means), Some(blocks)) = (&mut rows.means, blocks) {
                let block = Block::around(simd, blocks.pixels, kernel, place, p, range);
                let per_width = (splat(simd, 1.0) - no_plane_fits).sqrt() / width;
                let mean = block.mean_on_surface(simd, &plane, per_width);
                means.store(at, mean.or(valid, Vec3::splat(simd, f32::NAN)));
            }
        }
    }
}
