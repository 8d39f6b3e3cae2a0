//! The first planes of all positions of a cloud.

use fearless_simd::{Simd, SimdBase};

use super::super::plane::Plane;
use super::super::row_tasks::SplitRows;
use super::super::vector::{Vec3, splat};
use crate::neighbours::LEAF;

/// First plane of a position, fitted to its neighbours.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FirstPlane {
    pub(super) normal: [f32; 3],
    /// Height of the plane over the position along the normal, in metres.
    pub(super) height: f32,
    /// Combined misfit and uncertainty of the plane, R of (10.22) in docs/method.md, in m²; infinite for too few or
    /// collinear points.
    pub(super) residual: f32,
    pub(super) curvature: f32,
    /// The number of neighbours; negative if they are collinear, 0 if no plane was fitted.
    pub(super) count: f32,
    /// Square of the neighbourhood's in-plane extent, in m².
    pub(super) extent_squared: f32,
}

/// The first planes of all positions in the order of the index, and the radii used for them.
#[derive(Default)]
pub(super) struct FirstPlanes {
    pub(super) planes: Vec<FirstPlane>,
    pub(super) radii: Vec<f32>,
}

/// The first planes of some leaves.
pub(super) struct FirstPlaneRows<'a> {
    pub(super) first: usize,
    pub(super) planes: &'a mut [FirstPlane],
    pub(super) radii: &'a mut [f32],
}

impl SplitRows for FirstPlaneRows<'_> {
    fn count(&self) -> usize {
        self.radii.len() / LEAF
    }

    fn split_at(self, leaves: usize) -> (Self, Self) {
        let (planes, planes_after) = self.planes.split_at_mut(LEAF * leaves);
        let (radii, radii_after) = self.radii.split_at_mut(LEAF * leaves);
        (
            Self { first: self.first, planes, radii },
            Self { first: self.first + leaves, planes: planes_after, radii: radii_after },
        )
    }
}

impl FirstPlanes {
    /// Allocates the rows of `leaves` leaves.
    pub(super) fn rows(&mut self, leaves: usize) -> FirstPlaneRows<'_> {
        // Reserves no more room than needed, since clouds are large.
        let places = LEAF * leaves;
        self.planes.reserve_exact(places.saturating_sub(self.planes.len()));
        self.planes.resize(places, FirstPlane::default());
        self.radii.reserve_exact(places.saturating_sub(self.radii.len()));
        self.radii.resize(places, f32::NAN);
        FirstPlaneRows { first: 0, planes: &mut self.planes, radii: &mut self.radii }
    }

    /// Returns the radii used for the planes, for all positions.
    pub(super) fn radii(&self) -> &[f32] {
        &self.radii
    }

    pub(super) fn bytes(&self) -> usize {
        size_of::<FirstPlane>() * self.planes.capacity() + 4 * self.radii.capacity()
    }

    /// Returns one quantity of the vector of planes that starts at a place.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, place: usize, number: impl Fn(&FirstPlane) -> f32) -> S::f32s {
        let mut lanes = [0.0; LEAF];
        for (lane, plane) in lanes.iter_mut().zip(&self.planes[place..place + S::f32s::LEN]) {
            *lane = number(plane);
        }
        S::f32s::from_slice(simd, &lanes[..S::f32s::LEN])
    }

    /// Returns, for the vector of positions that starts at a place, the planes fitted to their own neighbours, and
    /// the numbers of neighbours.
    #[inline(always)]
    pub(super) fn own<S: Simd>(&self, simd: S, place: usize) -> (Plane<S>, S::f32s) {
        let normal = Vec3::new(
            self.load(simd, place, |plane| plane.normal[0]),
            self.load(simd, place, |plane| plane.normal[1]),
            self.load(simd, place, |plane| plane.normal[2]),
        );
        let count = self.load(simd, place, |plane| plane.count);
        let plane = Plane {
            normal,
            height: self.load(simd, place, |plane| plane.height),
            centroid: Vec3::splat(simd, 0.0),
            spread: splat(simd, 0.0),
            residual: splat(simd, 0.0),
            doubt: splat(simd, 1.0),
            extent_squared: self.load(simd, place, |plane| plane.extent_squared),
            curvature: self.load(simd, place, |plane| plane.curvature),
            off_line: splat(simd, 0.0),
            degenerate: count.simd_lt(splat(simd, 0.0)),
        };
        (plane, count.abs())
    }
}
