//! Edge preservation in unorganized clouds: finds the surface of each point from the first planes of the positions
//! around it (docs/method.md, section 10).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::super::plane::{self, Surface};
use super::super::vector::{Mask, Vec3, share, splat};
use super::super::window::{Candidates, Gate};
use super::first_planes::{FirstPlane, FirstPlaneRows, FirstPlanes};
use super::gather::load;
use super::gather::{Gathered, Reach};
use super::kernel::{Kernel, Radii, load_radius};
use crate::constants::{
    DOUBT_WEIGHT, FACING_COSINE, GATE_FADE, GENERAL_DISTANCE_WEIGHT, GENERAL_MEAN_REACH, MIN_NOISE, MIN_TOTAL,
    NARROW_WIDTH, OWN_NORMAL_WEIGHT, PLANE_REACH, STAY_WEIGHT,
};
use crate::neighbours::LEAF;

/// Fits the first planes of some leaves.
#[inline(always)]
pub(super) fn fit_first_planes<S: Simd>(simd: S, kernel: &Kernel<'_>, rows: &mut FirstPlaneRows<'_>) {
    let mut gathered = Gathered::default();
    for at in (0..rows.radii.len()).step_by(S::f32s::LEN) {
        let place = LEAF * rows.first + at;
        let p = load(simd, kernel.index, place);
        let valid: Mask<S> = p.x.simd_eq(p.x);
        if !valid.any_true() {
            break;
        }
        let radius = kernel.gather(simd, &mut gathered, p, valid, place);
        let sums = (&gathered).sums(simd, p, radius);
        let plane = plane::fit(simd, kernel.sensor.ray(simd, p), &sums);
        let (enough, off_line) = (share(simd, sums.total - splat(simd, MIN_TOTAL)), share(simd, plane.off_line));
        let least = radius * splat(simd, MIN_NOISE);
        let variance = least.mul_add(least, plane.residual);
        let doubtful = variance * plane.doubt.mul_add(splat(simd, DOUBT_WEIGHT), splat(simd, 1.0));
        let usable = enough * off_line;
        let is_usable: Mask<S> = usable.simd_gt(splat(simd, 0.0));
        let residual = is_usable.select(doubtful / usable, splat(simd, f32::INFINITY));
        let count = plane.degenerate.select(-sums.n, sums.n);
        radius.store_slice(&mut rows.radii[at..at + S::f32s::LEN]);
        for (lane, first) in rows.planes[at..at + S::f32s::LEN].iter_mut().enumerate() {
            *first = FirstPlane {
                normal: [
                    plane.normal.x.as_slice()[lane],
                    plane.normal.y.as_slice()[lane],
                    plane.normal.z.as_slice()[lane],
                ],
                height: plane.height.as_slice()[lane],
                residual: residual.as_slice()[lane],
                curvature: plane.curvature.as_slice()[lane],
                count: count.as_slice()[lane],
                extent_squared: plane.extent_squared.as_slice()[lane],
            };
        }
    }
}

/// Finds the surfaces of the points p, the first of which is at `place`. `gathered` is a buffer for the positions
/// around them.
#[inline(always)]
pub(super) fn find_surfaces<S: Simd>(
    simd: S,
    kernel: &Kernel<'_>,
    first_planes: &FirstPlanes,
    gathered: &mut Gathered,
    p: Vec3<S>,
    valid: Mask<S>,
    place: usize,
) -> Surface<S> {
    let (zero, one, infinity) = (splat(simd, 0.0), splat(simd, 1.0), splat(simd, f32::INFINITY));
    let (mut plane, n) = first_planes.own(simd, place);
    let radius = valid.select(load_radius(simd, Radii::Known(&first_planes.radii), place), one);
    let plane_reach = radius * splat(simd, PLANE_REACH);
    let outer = valid.select(plane_reach * splat(simd, (1.0 + 0.5 / GATE_FADE).sqrt()), splat(simd, f32::NAN));
    gathered.fill(simd, kernel.index, p, Reach { outer, inner: zero });
    let gate = Gate::new(simd, plane_reach);
    let mean_gate = Gate::new(simd, radius * splat(simd, GENERAL_MEAN_REACH));
    let radius_squared = radius * radius;
    // The noise is the harmonic mean of the residuals, which is dominated by planes that fit well.
    let (mut total, mut inverse, mut near, mut mean) = (zero, zero, zero, Vec3::splat(simd, 0.0));
    gathered.for_each_offset(
        simd,
        p,
        #[inline(always)]
        |offset, place| {
            let first = &first_planes.planes[place];
            if first.count != 0.0 {
                let (_, nearness, _) = gate.apply(simd, offset);
                total += nearness;
                inverse = (nearness * radius_squared / splat(simd, first.residual)) + inverse;
            }
            let (offset, nearness, _) = mean_gate.apply(simd, offset);
            near += nearness;
            mean = mean.add_scaled(nearness, offset);
        },
    );
    let has_plane: Mask<S> = valid & n.simd_ge(splat(simd, 3.0)) & inverse.simd_gt(zero) & !plane.degenerate;
    let mean = mean.scale(one / near.max(splat(simd, f32::MIN_POSITIVE)));
    let most = splat(simd, 1.0 / (MIN_NOISE * MIN_NOISE));
    let per_variance = has_plane.select((inverse / total).min(most) / radius_squared, one);
    let per_facing = splat(simd, 1.0 / FACING_COSINE);
    let (mut normal, mut height, mut total) =
        (plane.normal.scale(splat(simd, OWN_NORMAL_WEIGHT)), zero, splat(simd, STAY_WEIGHT));
    gathered.for_each_offset(
        simd,
        p,
        #[inline(always)]
        |offset, place| {
            let first = &first_planes.planes[place];
            // The normal of a collinear neighbourhood is undefined.
            if first.residual == f32::INFINITY || first.count == 0.0 {
                return;
            }
            let (offset, nearness, near) = gate.apply(simd, offset);
            let n = Vec3::<S>::new(
                splat(simd, first.normal[0]),
                splat(simd, first.normal[1]),
                splat(simd, first.normal[2]),
            );
            // Distances to the plane along its normal, from p and from the mean.
            let to_plane = offset.dot(n) + splat(simd, first.height);
            let from_mean = to_plane - mean.dot(n);
            let residual =
                (from_mean * from_mean).mul_add(splat(simd, GENERAL_DISTANCE_WEIGHT), splat(simd, first.residual));
            let root = one / residual.mul_add(per_variance, one);
            let square = root * root;
            let weight = near.select(square * square * nearness, zero);
            // Normals that oppose the normal of p's own plane are flipped.
            let facing = (plane.normal.dot(n) * per_facing).max(-one).min(one);
            let turned = weight * facing;
            normal = normal.add_scaled(turned, n);
            height = turned.mul_add(to_plane, height);
            total = weight.mul_add(facing.abs(), total);
        },
    );
    // The mean of disagreeing planes may be farther away than a point may move.
    let height = (height / total).max(-radius).min(radius);
    let length = has_plane.select(normal.dot(normal), one).sqrt();
    // A flipped normal with the opposite height describes the same plane.
    let away: Mask<S> = normal.dot(kernel.sensor.ray(simd, p)).simd_gt(zero);
    let sign = away.select(-one, one);
    plane.normal = normal.scale(sign / length).or(has_plane, plane.normal);
    plane.height = has_plane.select(sign * height, plane.height);
    let noise = (one / per_variance).sqrt();
    let width = has_plane.select(splat(simd, NARROW_WIDTH) * noise, infinity);
    Surface { plane, n, width: Some(width), bend: None, no_plane_fits: None }
}
