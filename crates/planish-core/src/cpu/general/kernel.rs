//! Inputs of the kernels for unorganized clouds, and functions that gather candidates.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::super::Fitting;
use super::super::sensor::Sensor;
use super::super::vector::{Mask, Vec3, splat};
use super::first_planes::FirstPlanes;
use super::gather::{Gathered, Reach};
use crate::constants::{GATE_FADE, MAX_RADIUS_RATIO};
use crate::neighbours::PointIndex;
use crate::range::MIN_GATE_M;

/// Parameters of a kernel other than the points.
#[derive(Clone, Copy)]
pub(super) struct Kernel<'a> {
    pub(super) fitting: Fitting,
    pub(super) sensor: Sensor,
    /// True if points move along their rays.
    pub(super) on_ray: bool,
    pub(super) index: &'a PointIndex,
    pub(super) radii: Radii<'a>,
    /// The first planes; `None` if edges are not kept, or if the first planes are yet to be fitted.
    pub(super) first_planes: Option<&'a FirstPlanes>,
}

#[derive(Clone, Copy)]
pub(super) enum Radii<'a> {
    Fixed(f32),
    /// Radii by density, before they are limited by the mean radius around each point.
    Of(&'a [f32]),
    /// Final radii, used without a further limit.
    Known(&'a [f32]),
}

impl Kernel<'_> {
    /// Gathers the candidates of the vector of points p that starts at a place. Returns the points' radii.
    #[inline(always)]
    pub(super) fn gather<S: Simd>(
        &self,
        simd: S,
        gathered: &mut Gathered,
        p: Vec3<S>,
        valid: Mask<S>,
        place: usize,
    ) -> S::f32s {
        let radius = load_radius(simd, self.radii, place);
        // The distance where the gate reaches zero, and the smaller one where it begins to fade.
        let outer = valid.select(radius * splat(simd, (1.0 + 0.5 / GATE_FADE).sqrt()), splat(simd, f32::NAN));
        let inner = match self.radii {
            Radii::Fixed(_) | Radii::Known(_) => radius * splat(simd, 0.999 * (1.0 - 0.5 / GATE_FADE).sqrt()),
            // The limited radius is known only after the candidates have been gathered.
            Radii::Of(_) => splat(simd, 0.0),
        };
        gathered.fill(simd, self.index, p, Reach { outer, inner });
        let radius = match self.radii {
            Radii::Fixed(_) | Radii::Known(_) => radius,
            Radii::Of(radii) => {
                radius.min(mean_radius(simd, gathered, radii, p, radius) * splat(simd, MAX_RADIUS_RATIO))
            }
        };
        valid.select(radius, splat(simd, 1.0)).max(splat(simd, MIN_GATE_M))
    }
}

/// Returns the radii of the vector of points that starts at a place.
#[inline(always)]
pub(super) fn load_radius<S: Simd>(simd: S, radii: Radii<'_>, place: usize) -> S::f32s {
    match radii {
        Radii::Fixed(radius_m) => splat(simd, radius_m),
        Radii::Of(radii) | Radii::Known(radii) => S::f32s::from_slice(simd, &radii[place..place + S::f32s::LEN]),
    }
}

/// Returns the mean radius of the other points around each point; infinite without other points. For an isolated
/// point it is much smaller than the point's own radius.
#[inline(always)]
fn mean_radius<S: Simd>(simd: S, gathered: &Gathered, radii: &[f32], p: Vec3<S>, radius: S::f32s) -> S::f32s {
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let (mut total, mut sum) = (zero, zero);
    let slope = -one / (radius * radius).max(splat(simd, f32::MIN_POSITIVE));
    gathered.for_each_offset(
        simd,
        p,
        #[inline(always)]
        |offset, place| {
            let square = offset.length_squared();
            // The point itself does not count.
            let other: Mask<S> = square.simd_gt(zero);
            let weight = other.select(square.mul_add(slope, one).max(zero), zero);
            total += weight;
            sum = weight.mul_add(splat(simd, radii[place]), sum);
        },
    );
    let alone: Mask<S> = total.simd_le(zero);
    alone.select(splat(simd, f32::INFINITY), sum / total.max(splat(simd, f32::MIN_POSITIVE)))
}
