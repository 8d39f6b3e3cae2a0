//! Edge preservation: the surface that a point lies on is found from the planes around it (docs/method.md, section 10).
//!
//! A separate pass fits the first planes of all pixels; each of their numbers is a channel laid out like the padded frame.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::padded::PaddedFrame;
use super::plane::Plane;
use super::polynomial_in_range;
use super::row_tasks::SplitRows;
use super::vector::{Mask, Vec3, splat};
use super::window::Window;
use crate::method::{DISTANCE_WEIGHT, DOUBT_WEIGHT, MIN_INCIDENCE_COSINE, MIN_NEIGHBOURS, MIN_NOISE, NARROW_WIDTH};
use crate::params::{Edges, SmoothParams, edge_shift_px};
use crate::range::{MAX_RADIUS_M, RangeRules};

// The channels of a first plane.
const NORMAL: usize = 0;
const HEIGHT: usize = 3;
/// The variance along the normal plus the plane's uncertainty, in m²; infinite where the neighbours are too few, or on a line.
const RESIDUAL: usize = 4;
const CURVATURE: usize = 5;
/// The number of neighbours; negative where they are on a line.
const COUNT: usize = 6;
/// The square of the extent in m².
const EXTENT: usize = 7;
const CHANNELS: usize = 8;

/// The first planes of a frame.
pub(super) struct FirstPlanes {
    channels: [Vec<f32>; CHANNELS],
    row_len: usize,
    reach: usize,
    /// Distance in pixels to the eight planes considered.
    shift: usize,
}

/// A band of rows of them.
pub(super) struct FirstRows<'a> {
    /// The first row's number in the image.
    pub(super) first: usize,
    channels: [&'a mut [f32]; CHANNELS],
    row_len: usize,
    reach: usize,
}

/// The standard deviation of depth at a range, between bounds whose squares are within f32, whatever the coordinates.
#[inline(always)]
pub(super) fn noise<S: Simd>(simd: S, rules: &RangeRules, range: S::f32s, radius: S::f32s) -> S::f32s {
    let noise = polynomial_in_range(simd, rules.sigma, range).max(radius * splat(simd, MIN_NOISE));
    noise.max(splat(simd, 1e-15)).min(splat(simd, MAX_RADIUS_M))
}

impl SplitRows for FirstRows<'_> {
    fn count(&self) -> usize {
        self.channels[0].len() / self.row_len
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, channels, row_len, reach } = self;
        let [mut before, mut after]: [[&mut [f32]; CHANNELS]; 2] = Default::default();
        for (k, channel) in channels.into_iter().enumerate() {
            (before[k], after[k]) = channel.split_at_mut(rows * row_len);
        }
        (
            Self { first, channels: before, row_len, reach },
            Self { first: first + rows, channels: after, row_len, reach },
        )
    }
}

impl FirstRows<'_> {
    /// Where column u of the `row`-th of these rows is.
    pub(super) fn index(&self, row: usize, u: usize) -> usize {
        row * self.row_len + self.reach + u
    }

    /// Stores the planes of the points at the end of rays, from an index on.
    #[inline(always)]
    pub(super) fn store<S: Simd>(
        &mut self,
        simd: S,
        at: usize,
        ray: Vec3<S>,
        noise: S::f32s,
        plane: &Plane<S>,
        n: S::f32s,
    ) {
        let residual = (noise * noise * splat(simd, DOUBT_WEIGHT)).mul_add(plane.doubt, plane.residual);
        let along = plane.normal.dot(ray);
        let seen: Mask<S> =
            (along * along).simd_ge(ray.dot(ray) * splat(simd, MIN_INCIDENCE_COSINE * MIN_INCIDENCE_COSINE));
        let usable = n.simd_ge(splat(simd, MIN_NEIGHBOURS)) & !plane.degenerate & seen;
        let channels = [
            plane.normal.x,
            plane.normal.y,
            plane.normal.z,
            plane.height,
            usable.select(residual, splat(simd, f32::INFINITY)),
            plane.curvature,
            plane.degenerate.select(-n, n),
            plane.extent_squared,
        ];
        for (kept, values) in self.channels.iter_mut().zip(channels) {
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
    /// Room for the planes of frames with this padding; `None` if edges are not kept.
    pub(super) fn new(params: &SmoothParams, padded: &PaddedFrame) -> Option<Self> {
        if params.edges == Edges::Off {
            return None;
        }
        Some(Self {
            channels: std::array::from_fn(|_| vec![0.0; padded.z.len()]),
            row_len: padded.row_len,
            reach: params.reach_px(),
            shift: edge_shift_px(params.window * params.stride) as usize,
        })
    }

    /// Bytes of the planes' channels.
    pub(super) fn bytes(&self) -> usize {
        self.channels.iter().map(|channel| size_of_val(&channel[..])).sum()
    }

    /// The rows of the image.
    pub(super) fn rows(&mut self, height: usize) -> FirstRows<'_> {
        let (row_len, reach) = (self.row_len, self.reach);
        let image = reach * row_len..(reach + height) * row_len;
        let channels = self.channels.each_mut().map(|channel| &mut channel[image.clone()]);
        FirstRows { first: 0, channels, row_len, reach }
    }

    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        S::f32s::from_slice(simd, &self.channels[channel][at..at + S::f32s::LEN])
    }

    #[inline(always)]
    fn normal<S: Simd>(&self, simd: S, at: usize) -> Vec3<S> {
        let [x, y, z] = [NORMAL, NORMAL + 1, NORMAL + 2].map(
            #[inline(always)]
            |channel| self.load(simd, channel, at),
        );
        Vec3::new(x, y, z)
    }

    /// Returns the planes that the points p at the window's centre, at the end of rays, lie on, from their own first planes and the
    /// eight around them.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(super) fn surface<S: Simd>(
        &self,
        simd: S,
        window: &Window<'_>,
        p: Vec3<S>,
        ray: Vec3<S>,
        valid: Mask<S>,
        radius: S::f32s,
        noise: S::f32s,
    ) -> Surface<S> {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
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
                // An unusable plane has an infinite residual, hence no weight; one that is not near may hold anything.
                let weight = near.select(square * square, zero);
                normal = normal.add_scaled(weight, n.or(near, Vec3::splat(simd, 0.0)));
                height = weight.mul_add(near.select(to_plane, zero), height);
                total += weight;
            }
        }
        let count = self.load(simd, COUNT, here);
        let own: Mask<S> = self.load(simd, RESIDUAL, here).simd_lt(splat(simd, f32::INFINITY)) & valid;
        // Planes that disagree may lie further away than a point may move.
        let height = height / own.select(total, one);
        let own = own & height.abs().simd_le(radius);
        let length = own.select(normal.dot(normal), one).sqrt();
        // The other way round it is the same plane.
        let away: Mask<S> = normal.dot(ray).simd_gt(zero);
        let sign = away.select(-one, one);
        Surface {
            plane: Plane {
                normal: normal.scale(sign / length).or(own, self.normal(simd, here)),
                height: own.select(sign * height, self.load(simd, HEIGHT, here)),
                residual: zero,
                doubt: one,
                extent_squared: self.load(simd, EXTENT, here),
                curvature: self.load(simd, CURVATURE, here),
                degenerate: count.simd_lt(zero),
            },
            n: valid.select(count.abs(), zero),
            width: own.select(splat(simd, NARROW_WIDTH) * noise, splat(simd, f32::INFINITY)),
        }
    }
}
