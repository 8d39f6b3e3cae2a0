//! Computes the smallest eigenvector of a symmetric 3x3 matrix in every lane (docs/method.md, section 4), in f32.
//!
//! The eigenvalues are the trigonometric roots of the characteristic polynomial. Near a double root these lose half
//! their digits, so each lane first solves for the isolated root: the smallest for planar points, the largest for
//! points along a line. In the second case the other two come from the matrix restricted to the plane perpendicular
//! to the line (after Eberly, "A robust eigensolver for 3x3 symmetric matrices"). Errors are a few ulp of the largest
//! eigenvalue, similar to the rounding of the matrix. A zero matrix gives zeros and an arbitrary unit vector.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::math::cos_third_acos;
use super::vector::{Mask, Vec3, splat};

/// A symmetric matrix for each lane.
pub(super) struct Symmetric<S: Simd> {
    pub(super) xx: S::f32s,
    pub(super) xy: S::f32s,
    pub(super) xz: S::f32s,
    pub(super) yy: S::f32s,
    pub(super) yz: S::f32s,
    pub(super) zz: S::f32s,
}

impl<S: Simd> Symmetric<S> {
    #[inline(always)]
    fn rows(&self) -> [Vec3<S>; 3] {
        [
            Vec3::new(self.xx, self.xy, self.xz),
            Vec3::new(self.xy, self.yy, self.yz),
            Vec3::new(self.xz, self.yz, self.zz),
        ]
    }

    #[inline(always)]
    pub(super) fn times(&self, v: Vec3<S>) -> Vec3<S> {
        let [x, y, z] = self.rows();
        Vec3::new(x.dot(v), y.dot(v), z.dot(v))
    }
}

/// The eigenvalues in ascending order, and the unit eigenvector of the smallest eigenvalue.
pub(super) struct Smallest<S: Simd> {
    pub(super) values: [S::f32s; 3],
    pub(super) vector: Vec3<S>,
}

/// Value of det(B)/2 above which the largest root is isolated and the smaller two are close.
const LINE_LIKE: f32 = 0.9;

#[inline(always)]
pub(super) fn smallest_eigenvector<S: Simd>(simd: S, m: &Symmetric<S>) -> Smallest<S> {
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));

    // M = mean I + p B: B has trace 0, eigenvalues between -2 and 2, and the characteristic polynomial x³ - 3x -
    // det(B).
    let mean = (m.xx + m.yy + m.zz) * splat(simd, 1.0 / 3.0);
    let (dx, dy, dz) = (m.xx - mean, m.yy - mean, m.zz - mean);
    let off = m.xy.mul_add(m.xy, m.xz.mul_add(m.xz, m.yz * m.yz));
    let diagonal = dx.mul_add(dx, dy.mul_add(dy, dz * dz));
    let p = ((diagonal + off + off) * splat(simd, 1.0 / 6.0)).sqrt();
    let inverse_p = one / p.max(splat(simd, f32::MIN_POSITIVE));
    let b: Symmetric<S> = Symmetric {
        xx: dx * inverse_p,
        xy: m.xy * inverse_p,
        xz: m.xz * inverse_p,
        yy: dy * inverse_p,
        yz: m.yz * inverse_p,
        zz: dz * inverse_p,
    };
    let det = b.xx.mul_add(
        minor::<S>(b.yy, b.zz, b.yz, b.yz),
        b.xz.mul_add(minor::<S>(b.xy, b.yz, b.yy, b.xz), -(b.xy * minor::<S>(b.xy, b.zz, b.yz, b.xz))),
    );
    let half_det = (det * splat(simd, 0.5)).max(splat(simd, -1.0)).min(one);

    // The isolated root: -2 cos(acos(-r)/3) or 2 cos(acos(r)/3).
    let line_like: Mask<S> = half_det.simd_gt(splat(simd, LINE_LIKE));
    let sign = line_like.select(one, splat(simd, -1.0));
    let half_alone = sign * cos_third_acos(simd, half_det * sign);
    let axis = null_vector(simd, &b, half_alone + half_alone);

    // The other two roots are minus half the isolated one, plus or minus sqrt(3) times the sine.
    let spread = (splat(simd, 3.0) * minor::<S>(one, one, half_alone, half_alone)).max(zero).sqrt();
    let plane_like = Smallest {
        values: [
            p.mul_add(half_alone + half_alone, mean),
            p.mul_add(-half_alone - spread, mean),
            p.mul_add(-half_alone + spread, mean),
        ],
        vector: axis,
    };
    if !line_like.any_true() {
        return plane_like;
    }
    let across = across_line(simd, &b, axis);
    let [alone, lower, upper] = plane_like.values;
    Smallest {
        values: [
            line_like.select(p.mul_add(across.values[0], mean), alone),
            line_like.select(p.mul_add(across.values[1], mean), lower),
            line_like.select(alone, upper),
        ],
        vector: across.vector.or(line_like, axis),
    }
}

/// Returns a b - c d.
#[inline(always)]
fn minor<S: Simd>(a: S::f32s, b: S::f32s, c: S::f32s, d: S::f32s) -> S::f32s {
    a.mul_add(b, -(c * d))
}

/// Returns a unit vector in the null space of B - value I: the longest cross product of two of its rows.
#[inline(always)]
fn null_vector<S: Simd>(simd: S, m: &Symmetric<S>, value: S::f32s) -> Vec3<S> {
    let shifted = Symmetric { xx: m.xx - value, yy: m.yy - value, zz: m.zz - value, ..*m };
    let [x, y, z] = shifted.rows();
    let (a, b, c) = (x.cross(y), x.cross(z), y.cross(z));
    let (a2, b2, c2) = (a.dot(a), b.dot(b), c.dot(c));
    let b_longer: Mask<S> = b2.simd_gt(a2);
    let (longest, square) = (b.or(b_longer, a), b2.max(a2));
    let c_longer: Mask<S> = c2.simd_gt(square);
    let (longest, square) = (c.or(c_longer, longest), c2.max(square));
    // A zero matrix has no direction; any direction is valid.
    let usable: Mask<S> = square.simd_gt(splat(simd, f32::MIN_POSITIVE));
    let zero = splat(simd, 0.0);
    let one = splat(simd, 1.0);
    longest.scale(one / usable.select(square, one).sqrt()).or(usable, Vec3::new(zero, zero, one))
}

/// Returns two unit vectors that complete n to an orthonormal frame (Duff et al. 2017), as in the reference.
#[inline(always)]
pub(super) fn tangents<S: Simd>(simd: S, n: Vec3<S>) -> (Vec3<S>, Vec3<S>) {
    let one = splat(simd, 1.0);
    let sign = one.copysign(n.z);
    let a = -(one / (sign + n.z));
    let b = n.x * n.y * a;
    let u = Vec3::new((sign * n.x * n.x).mul_add(a, one), sign * b, -(sign * n.x));
    let v = Vec3::new(b, (n.y * n.y).mul_add(a, sign), -n.y);
    (u, v)
}

/// Returns the smaller two eigenvalues and the eigenvector of the smallest, from B restricted to the plane
/// perpendicular to `axis`, the eigenvector of the largest.
#[inline(always)]
fn across_line<S: Simd>(simd: S, m: &Symmetric<S>, axis: Vec3<S>) -> Smallest<S> {
    let (u, v) = tangents(simd, axis);
    let (mu, mv) = (m.times(u), m.times(v));
    let (uu, uv, vv) = (u.dot(mu), u.dot(mv), v.dot(mv));
    let (half_sum, half_difference) = ((uu + vv) * splat(simd, 0.5), (uu - vv) * splat(simd, 0.5));
    let spread = half_difference.mul_add(half_difference, uv * uv).sqrt();
    // The eigenvector of the smaller eigenvalue, from the longer of the two rows' normals.
    let reach = half_difference.abs() + spread;
    let u_larger: Mask<S> = half_difference.simd_ge(splat(simd, 0.0));
    let (a, b) = (u_larger.select(uv, -reach), u_larger.select(-reach, uv));
    let square = a.mul_add(a, b * b);
    let usable: Mask<S> = square.simd_gt(splat(simd, f32::MIN_POSITIVE));
    let scale = splat(simd, 1.0) / usable.select(square, splat(simd, 1.0)).sqrt();
    let vector = u.scale(a * scale).add_scaled(b * scale, v).or(usable, u);
    let smaller = half_sum - spread;
    Smallest { values: [smaller, half_sum + spread, half_sum + spread], vector }
}
