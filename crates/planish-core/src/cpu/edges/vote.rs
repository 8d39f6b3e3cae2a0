//! The nine planes around a point vote on its surface (docs/method.md, section 10).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::{CENTROID, FirstPlanes, HEIGHT, NORMAL, RESIDUAL, SPREAD, WINDOW_BEND};
use crate::constants::{DISTANCE_WEIGHT, FITTING, MISSING_PLANE, NEAR_ENOUGH, TURNING};
use crate::cpu::bend::Around;
use crate::cpu::padded::PaddedFrame;
use crate::cpu::vector::{Mask, Vec3, rises, splat};
use crate::cpu::window::Gate;

/// The vote of the planes around a point: weighted sums, not yet divided by the total.
pub(super) struct Vote<S: Simd> {
    pub(super) normal: Vec3<S>,
    pub(super) height: S::f32s,
    pub(super) total: S::f32s,
    weights: [S::f32s; 9],
    /// Gate weights of the planes by their distance from the point. Only valid for planes with a nonzero weight.
    nearness: [S::f32s; 9],
    /// Sum of the planes' fits to their own points, F of (10.17) in docs/method.md.
    pub(super) fitting: S::f32s,
}

/// The points whose surfaces are to be found, and the quantities that weight the planes around them.
pub(super) struct Voting<'a, S: Simd> {
    pub(super) measured: &'a PaddedFrame,
    /// Index of the first point.
    pub(super) here: usize,
    pub(super) p: Vec3<S>,
    /// Offset from p to its block mean, whose distance from a plane determines how well the plane fits.
    pub(super) to_mean: Vec3<S>,
    pub(super) per_variance: S::f32s,
    pub(super) gate: Gate<S>,
}

impl FirstPlanes {
    /// Returns the index of the k-th of the nine planes around a point.
    fn nearby(&self, here: usize, k: usize) -> usize {
        let row_len = self.planes.row_len;
        here + self.shift * (k / 3 * row_len + k % 3) - self.shift * (row_len + 1)
    }

    /// Weights the planes around points by how well they fit.
    #[inline(always)]
    pub(super) fn vote<S: Simd>(&self, simd: S, voting: &Voting<'_, S>) -> Vote<S> {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let normal = Vec3::splat(simd, 0.0);
        let mut vote =
            Vote { normal, height: zero, total: zero, weights: [zero; 9], nearness: [zero; 9], fitting: zero };
        for k in 0..9 {
            let at = self.nearby(voting.here, k);
            let offset = voting.measured.load(simd, at).sub(voting.p);
            let (nearness, near) = voting.gate.weight(simd, offset);
            let n = self.planes.vector(simd, NORMAL, at);
            // Distance from p to the plane along the plane's normal.
            let to_plane = offset.dot(n) + self.planes.load(simd, HEIGHT, at);
            let from_mean = to_plane - voting.to_mean.dot(n);
            let variance = self.planes.load(simd, RESIDUAL, at);
            let residual = (from_mean * from_mean).mul_add(splat(simd, DISTANCE_WEIGHT), variance);
            let weight = |variance: S::f32s| {
                let badness = variance.mul_add(voting.per_variance, one);
                let square = badness * badness;
                // An unusable plane has an infinite residual and thus no weight. The values of a plane that is not
                // near are arbitrary, and masked out.
                near.select(nearness / (square * square), zero)
            };
            vote.fitting += weight(variance);
            let weight = weight(residual);
            vote.normal = vote.normal.add_scaled(weight, n).or(near, vote.normal);
            vote.height = near.select(weight.mul_add(to_plane, vote.height), vote.height);
            vote.total += weight;
            vote.weights[k] = weight;
            vote.nearness[k] = nearness;
        }
        vote
    }

    /// Returns the degree to which no plane fits: from 0, if the planes fit or their normals hardly differ, to 1.
    #[inline(always)]
    pub(super) fn no_plane_fits<S: Simd>(&self, simd: S, voting: &Voting<'_, S>, vote: &Vote<S>) -> S::f32s {
        let zero = splat(simd, 0.0);
        let lacking = splat(simd, 1.0) - rises(simd, vote.fitting, FITTING);
        let lacks: Mask<S> = lacking.simd_gt(zero);
        // Most surfaces are flat, so planes fit.
        if lacks.any_true() { lacking * self.turning(simd, voting.here, vote) } else { zero }
    }

    /// Returns the degree, from 0 to 1, to which the planes around points have different normals or are missing.
    #[inline(never)]
    fn turning<S: Simd>(&self, simd: S, here: usize, vote: &Vote<S>) -> S::f32s {
        simd.vectorize(
            #[inline(always)]
            || {
                let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
                let (mut normals, mut count) = (Vec3::splat(simd, 0.0), zero);
                for k in 0..9 {
                    let counts: Mask<S> = vote.weights[k].simd_gt(zero);
                    let near = counts.select((vote.nearness[k] * splat(simd, 1.0 / NEAR_ENOUGH)).min(one), zero);
                    let n = self.planes.vector(simd, NORMAL, self.nearby(here, k));
                    normals = normals.add_scaled(near, n).or(counts, normals);
                    count += near;
                }
                let mean = normals.dot(normals).sqrt() / count.max(splat(simd, NEAR_ENOUGH));
                let missing = (splat(simd, 9.0) - count) * splat(simd, MISSING_PLANE);
                rises(simd, one - mean + missing, TURNING)
            },
        )
    }

    /// Returns the sums over the planes, weighted by a vote, from which the bend between the planes is computed.
    #[inline(always)]
    pub(super) fn around<S: Simd>(&self, simd: S, voting: &Voting<'_, S>, vote: &Vote<S>) -> Around<S> {
        let (zero, none) = (splat(simd, 0.0), Vec3::splat(simd, 0.0));
        let mut around = Around::nothing(simd);
        for (k, &weight) in vote.weights.iter().enumerate() {
            let at = self.nearby(voting.here, k);
            let counts: Mask<S> = weight.simd_gt(zero);
            let offset = voting.measured.load(simd, at).sub(voting.p);
            let x = offset.add(self.planes.vector(simd, CENTROID, at)).or(counts, none);
            let n = self.planes.vector(simd, NORMAL, at).or(counts, none);
            let spread = counts.select(self.planes.load(simd, SPREAD, at), zero);
            let window_bend = counts.select(self.planes.load(simd, WINDOW_BEND, at), zero);
            around.add(weight, x, n, (spread, window_bend));
        }
        around
    }
}
