//! Edges kept: the surface that a point lies on is taken from the planes around it (docs/method.md, section 10).
//!
//! A pass of its own fits the first planes of all pixels; they are kept in planes of numbers laid out as [`Planes`].

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::halves::Halves;
use super::plane::Plane;
use super::planes::Planes;
use super::vector::{Mask, Vec3, splat};
use super::window::Window;
use crate::params::{Edges, SmoothParams, edge_shift_px};
use crate::radius::MAX_RADIUS_M;

/// A plane through fewer points than this says too little.
const MIN_NEIGHBOURS: f32 = 6.0;
/// The noise is at least this share of the radius.
const MIN_NOISE: f32 = 0.01;
/// How much a plane's distance from p weighs beside its own residual, both squared.
const DISTANCE_WEIGHT: f32 = 0.5;
/// Neighbours count up to so many deviations of the noise from the surface.
const WIDTH: f32 = 1.8;

/// A plane whose points hardly determine it counts as one with more noise: by this share of the noise's variance for a disc.
const DOUBT_WEIGHT: f32 = 0.01;

/// No camera sees a surface as steep as this; what looks like one is a row of points far apart.
const MIN_INCIDENCE_COSINE: f32 = 0.05;

/// What is kept of a first plane, a number each.
const NORMAL: usize = 0;
const HEIGHT: usize = 3;
/// The variance along the normal and what the plane is in doubt, in m²; infinite where the neighbours are too few, or on a line.
const RESIDUAL: usize = 4;
const CURVATURE: usize = 5;
/// How many neighbours; negative where they are on a line.
const COUNT: usize = 6;
const NUMBERS: usize = 7;

/// The first planes of a frame.
pub(super) struct FirstPlanes {
    numbers: [Vec<f32>; NUMBERS],
    row_len: usize,
    reach: usize,
    noise_at_1m: f32,
    /// Pixels to the planes that are asked.
    shift: usize,
}

/// Some rows of them.
pub(super) struct FirstRows<'a> {
    /// The first row's number in the image.
    pub(super) first: usize,
    numbers: [&'a mut [f32]; NUMBERS],
    row_len: usize,
    reach: usize,
    noise_at_1m: f32,
}

/// The standard deviation of depth at z, between bounds whose squares are within f32, whatever the coordinates.
#[inline(always)]
fn noise<S: Simd>(simd: S, noise_at_1m: f32, z: S::f32s, radius: S::f32s) -> S::f32s {
    let noise = (z * z * splat(simd, noise_at_1m)).max(radius * splat(simd, MIN_NOISE));
    noise.max(splat(simd, 1e-15)).min(splat(simd, MAX_RADIUS_M))
}

impl Halves for FirstRows<'_> {
    fn count(&self) -> usize {
        self.numbers[0].len() / self.row_len
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, numbers, row_len, reach, noise_at_1m } = self;
        let [mut before, mut after]: [[&mut [f32]; NUMBERS]; 2] = Default::default();
        for (k, number) in numbers.into_iter().enumerate() {
            (before[k], after[k]) = number.split_at_mut(rows * row_len);
        }
        (
            Self { first, numbers: before, row_len, reach, noise_at_1m },
            Self { first: first + rows, numbers: after, row_len, reach, noise_at_1m },
        )
    }
}

impl FirstRows<'_> {
    /// Where column u of the `row`-th of these rows is.
    pub(super) fn index(&self, row: usize, u: usize) -> usize {
        row * self.row_len + self.reach + u
    }

    /// Keeps the planes of the points p from an index on.
    #[inline(always)]
    pub(super) fn store<S: Simd>(
        &mut self,
        simd: S,
        at: usize,
        p: Vec3<S>,
        radius: S::f32s,
        plane: &Plane<S>,
        n: S::f32s,
    ) {
        let noise = noise(simd, self.noise_at_1m, p.z, radius);
        let residual = (noise * noise * splat(simd, DOUBT_WEIGHT)).mul_add(plane.doubt, plane.residual);
        let along = plane.normal.dot(p);
        let seen: Mask<S> =
            (along * along).simd_ge(p.dot(p) * splat(simd, MIN_INCIDENCE_COSINE * MIN_INCIDENCE_COSINE));
        let usable = n.simd_ge(splat(simd, MIN_NEIGHBOURS)) & !plane.degenerate & seen;
        let numbers = [
            plane.normal.x,
            plane.normal.y,
            plane.normal.z,
            plane.height,
            usable.select(residual, splat(simd, f32::INFINITY)),
            plane.curvature,
            plane.degenerate.select(-n, n),
        ];
        for (kept, values) in self.numbers.iter_mut().zip(numbers) {
            values.store_slice(&mut kept[at..at + S::f32s::LEN]);
        }
    }
}

/// The surface that points lie on.
pub(super) struct Surface<S: Simd> {
    pub(super) plane: Plane<S>,
    /// How many neighbours.
    pub(super) n: S::f32s,
    /// How far from the plane a neighbour counts, in metres; infinite where it is the pixel's own for want of others.
    pub(super) width: S::f32s,
}

impl FirstPlanes {
    /// Room for the planes of frames that have these `planes`; `None` if edges are not kept.
    pub(super) fn new(params: &SmoothParams, planes: &Planes) -> Option<Self> {
        let Edges::Robust { noise_at_1m } = params.edges else { return None };
        Some(Self {
            numbers: std::array::from_fn(|_| vec![0.0; planes.z.len()]),
            row_len: planes.row_len,
            reach: params.reach_px(),
            noise_at_1m,
            shift: edge_shift_px(params.window * params.stride) as usize,
        })
    }

    /// Bytes of the planes' numbers.
    pub(super) fn bytes(&self) -> usize {
        self.numbers.iter().map(|number| size_of_val(&number[..])).sum()
    }

    /// The rows of the image.
    pub(super) fn rows(&mut self, height: usize) -> FirstRows<'_> {
        let (row_len, reach) = (self.row_len, self.reach);
        let image = reach * row_len..(reach + height) * row_len;
        let numbers = self.numbers.each_mut().map(|n| &mut n[image.clone()]);
        FirstRows { first: 0, numbers, row_len, reach, noise_at_1m: self.noise_at_1m }
    }

    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, number: usize, at: usize) -> S::f32s {
        S::f32s::from_slice(simd, &self.numbers[number][at..at + S::f32s::LEN])
    }

    #[inline(always)]
    fn normal<S: Simd>(&self, simd: S, at: usize) -> Vec3<S> {
        let [x, y, z] = [NORMAL, NORMAL + 1, NORMAL + 2].map(
            #[inline(always)]
            |number| self.load(simd, number, at),
        );
        Vec3::new(x, y, z)
    }

    /// The planes that the points p at the window's centre lie on, as their own and the eight planes around them say.
    #[inline(always)]
    pub(super) fn surface<S: Simd>(
        &self,
        simd: S,
        window: &Window<'_>,
        p: Vec3<S>,
        valid: Mask<S>,
        radius: S::f32s,
    ) -> Surface<S> {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let noise = noise(simd, self.noise_at_1m, p.z, radius);
        let per_variance = one / (noise * noise);
        let radius_squared = radius * radius;
        let here = window.centre_index();
        let (mut normal, mut height, mut total) = (Vec3::splat(simd, 0.0), zero, zero);
        for row in 0..3 {
            for column in 0..3 {
                let at = here + self.shift * (row * self.row_len + column) - self.shift * (self.row_len + 1);
                let offset = window.load(simd, at).sub(p);
                let near: Mask<S> = offset.dot(offset).simd_le(radius_squared);
                let offset = offset.or(near, Vec3::splat(simd, 0.0));
                let n = self.normal(simd, at);
                // From p to the plane along its normal.
                let to_plane = offset.dot(n) + self.load(simd, HEIGHT, at);
                let residual =
                    (to_plane * to_plane).mul_add(splat(simd, DISTANCE_WEIGHT), self.load(simd, RESIDUAL, at));
                let root = one / residual.mul_add(per_variance, one);
                let square = root * root;
                // What is not usable has an infinite residual, and weighs nothing; what is not near may be anything.
                let weight = near.select(square * square, zero);
                normal = normal.add_scaled(weight, n.or(near, Vec3::splat(simd, 0.0)));
                height = weight.mul_add(near.select(to_plane, zero), height);
                total += weight;
            }
        }
        let count = self.load(simd, COUNT, here);
        let own: Mask<S> = self.load(simd, RESIDUAL, here).simd_lt(splat(simd, f32::INFINITY)) & valid;
        // Planes that agree on nothing may be further away than a point may move.
        let height = height / own.select(total, one);
        let own = own & height.abs().simd_le(radius);
        let length = own.select(normal.dot(normal), one).sqrt();
        // The other way round it is the same plane.
        let away: Mask<S> = normal.dot(p).simd_gt(zero);
        let sign = away.select(-one, one);
        Surface {
            plane: Plane {
                normal: normal.scale(sign / length).or(own, self.normal(simd, here)),
                height: own.select(sign * height, self.load(simd, HEIGHT, here)),
                residual: zero,
                doubt: one,
                curvature: self.load(simd, CURVATURE, here),
                degenerate: count.simd_lt(zero),
            },
            n: valid.select(count.abs(), zero),
            width: own.select(splat(simd, WIDTH) * noise, splat(simd, f32::INFINITY)),
        }
    }
}
