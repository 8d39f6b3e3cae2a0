// The smallest eigenvector of a symmetric 3x3 matrix (docs/method.md, section 4).
//
// The eigenvalues are the trigonometric roots of the characteristic polynomial. Near a double root, these lose half
// their digits, so the isolated root is computed first: the smallest for planar points, the largest for points along
// a line. In the second case, the other two are computed from the matrix restricted to the plane perpendicular to the
// line (after Eberly, "A robust eigensolver for 3x3 symmetric matrices"). A zero matrix gives zeros and an arbitrary
// unit vector.

// Threshold of det(B)/2 above which the largest root is isolated and the smaller two are close.
const LINE_LIKE: f32 = 0.9;

struct Symmetric {
    xx: f32,
    xy: f32,
    xz: f32,
    yy: f32,
    yz: f32,
    zz: f32,
}

// Eigenvalues in ascending order and the unit eigenvector of the smallest.
struct Smallest {
    values: vec3<f32>,
    vector: vec3<f32>,
}

fn symmetric_times(m: Symmetric, v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        dot(vec3<f32>(m.xx, m.xy, m.xz), v),
        dot(vec3<f32>(m.xy, m.yy, m.yz), v),
        dot(vec3<f32>(m.xz, m.yz, m.zz), v),
    );
}

// Returns cos(acos(x)/3) for x in [-1, 1], with an absolute error under 5e-7. The built-in acos and cos may be off by
// 1e-3.
fn cos_third_acos(x: f32) -> f32 {
    // acos(|x|) = sqrt(1 - |x|) p(|x|): Abramowitz & Stegun 4.4.46.
    let magnitude = abs(x);
    var p = -0.0012624911;
    p = fma(p, magnitude, 0.0066700901);
    p = fma(p, magnitude, -0.0170881256);
    p = fma(p, magnitude, 0.0308918810);
    p = fma(p, magnitude, -0.0501743046);
    p = fma(p, magnitude, 0.0889789874);
    p = fma(p, magnitude, -0.2145988016);
    p = fma(p, magnitude, 1.5707963268);
    let acute = sqrt(max(1.0 - magnitude, 0.0)) * p;
    let angle = select(acute, 3.1415926536 - acute, x < 0.0);
    // cos on [0, pi/3] by its series in the square: the next term is below 2e-8.
    let s = (angle * (1.0 / 3.0)) * (angle * (1.0 / 3.0));
    var c = 2.4801587e-5;
    c = fma(c, s, -1.3888889e-3);
    c = fma(c, s, 4.1666667e-2);
    c = fma(c, s, -0.5);
    return fma(c, s, 1.0);
}

// Returns a b - c d.
fn minor(a: f32, b: f32, c: f32, d: f32) -> f32 {
    return fma(a, b, -(c * d));
}

// Returns a unit vector in the null space of B - value I: the longest cross product of two of its rows.
fn null_vector(b: Symmetric, value: f32) -> vec3<f32> {
    let x = vec3<f32>(b.xx - value, b.xy, b.xz);
    let y = vec3<f32>(b.xy, b.yy - value, b.yz);
    let z = vec3<f32>(b.xz, b.yz, b.zz - value);
    var longest = cross(x, y);
    var length_squared = dot(longest, longest);
    for (var i = 0; i < 2; i++) {
        let other = cross(select(y, x, i == 0), z);
        let other_squared = dot(other, other);
        if other_squared > length_squared {
            longest = other;
            length_squared = other_squared;
        }
    }
    // The rows of a zero matrix have no direction; any unit vector is valid.
    if length_squared > MIN_POSITIVE {
        return longest * (1.0 / sqrt(length_squared));
    }
    return vec3<f32>(0.0, 0.0, 1.0);
}

// Two unit vectors that complete n to an orthonormal frame (Duff et al. 2017), as in the reference.
struct Tangents {
    u: vec3<f32>,
    v: vec3<f32>,
}

fn tangents_of(n: vec3<f32>) -> Tangents {
    let sign = bitcast<f32>((bitcast<u32>(n.z) & 0x80000000u) | 0x3f800000u);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    return Tangents(
        vec3<f32>(fma(sign * n.x * n.x, a, 1.0), sign * b, -(sign * n.x)),
        vec3<f32>(b, fma(n.y * n.y, a, sign), -n.y),
    );
}

// Returns the smaller two eigenvalues, from B restricted to the plane perpendicular to `axis`, the eigenvector of the
// largest.
fn across_line(b: Symmetric, axis: vec3<f32>) -> Smallest {
    let tangents = tangents_of(axis);
    let bu = symmetric_times(b, tangents.u);
    let bv = symmetric_times(b, tangents.v);
    let uu = dot(tangents.u, bu);
    let uv = dot(tangents.u, bv);
    let vv = dot(tangents.v, bv);
    let half_sum = (uu + vv) * 0.5;
    let half_difference = (uu - vv) * 0.5;
    let spread = sqrt(fma(half_difference, half_difference, uv * uv));
    // The eigenvector of the smaller eigenvalue: the longer of the normals of the two rows.
    let reach = abs(half_difference) + spread;
    let along = select(vec2<f32>(-reach, uv), vec2<f32>(uv, -reach), half_difference >= 0.0);
    let length_squared = dot(along, along);
    var vector = tangents.u;
    if length_squared > MIN_POSITIVE {
        vector = (along.x * tangents.u + along.y * tangents.v) * (1.0 / sqrt(length_squared));
    }
    return Smallest(vec3<f32>(half_sum - spread, half_sum + spread, half_sum + spread), vector);
}

fn smallest_eigenvector(m: Symmetric) -> Smallest {
    // M = mean I + p B: B has trace 0, eigenvalues between -2 and 2, and the characteristic polynomial x³ - 3x - det(B).
    let mean = (m.xx + m.yy + m.zz) * (1.0 / 3.0);
    let d = vec3<f32>(m.xx, m.yy, m.zz) - mean;
    let off = vec3<f32>(m.xy, m.xz, m.yz);
    let p = sqrt((dot(d, d) + 2.0 * dot(off, off)) * (1.0 / 6.0));
    let inverse_p = 1.0 / max(p, MIN_POSITIVE);
    let b = Symmetric(
        d.x * inverse_p,
        m.xy * inverse_p,
        m.xz * inverse_p,
        d.y * inverse_p,
        m.yz * inverse_p,
        d.z * inverse_p,
    );
    let det = fma(
        b.xx,
        minor(b.yy, b.zz, b.yz, b.yz),
        fma(b.xz, minor(b.xy, b.yz, b.yy, b.xz), -(b.xy * minor(b.xy, b.zz, b.yz, b.xz))),
    );
    let half_det = clamp(det * 0.5, -1.0, 1.0);

    // The isolated root: -2 cos(acos(-r)/3) or 2 cos(acos(r)/3).
    let is_line_like = half_det > LINE_LIKE;
    let sign = select(-1.0, 1.0, is_line_like);
    let half_alone = sign * cos_third_acos(half_det * sign);
    let axis = null_vector(b, 2.0 * half_alone);
    let alone = fma(p, 2.0 * half_alone, mean);
    if is_line_like {
        let across = across_line(b, axis);
        return Smallest(vec3<f32>(fma(p, across.values.x, mean), fma(p, across.values.y, mean), alone), across.vector);
    }
    // The other two roots are -half_alone ± sqrt(3 (1 - half_alone²)), since half_alone is a cosine.
    let spread = sqrt(max(3.0 * fma(-half_alone, half_alone, 1.0), 0.0));
    return Smallest(vec3<f32>(alone, fma(p, -half_alone - spread, mean), fma(p, -half_alone + spread, mean)), axis);
}
