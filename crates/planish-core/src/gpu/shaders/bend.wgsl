// The curvature of surfaces (docs/method.md, section 10). A tensor H in 1/m describes a surface whose height above
// its tangent plane is x·Hx/2 at the in-plane offset x. Its components uu, uv and vv refer to the tangents of the
// normal. For a window, only the trace of H is known.

// Returns H (a, b).
fn bend_times(h: vec3<f32>, at: vec2<f32>) -> vec2<f32> {
    return vec2<f32>(fma(h.x, at.x, h.y * at.y), fma(h.y, at.x, h.z * at.y));
}

fn place_along(frame: Tangents, x: vec3<f32>) -> vec2<f32> {
    return vec2<f32>(dot(x, frame.u), dot(x, frame.v));
}

// Returns the sum of the squares of all entries.
fn bend_square(h: vec3<f32>) -> f32 {
    return fma(h.x, h.x, fma(h.z, h.z, 2.0 * h.y * h.y));
}

fn along(frame: Tangents, m: Symmetric) -> vec3<f32> {
    let by_u = symmetric_times(m, frame.u);
    let by_v = symmetric_times(m, frame.v);
    return vec3<f32>(dot(frame.u, by_u), dot(frame.u, by_v), dot(frame.v, by_v));
}

// Returns the same tensor along the tangents `to`.
fn turned(h: vec3<f32>, frame: Tangents, to: Tangents) -> vec3<f32> {
    let u = place_along(frame, to.u);
    let v = place_along(frame, to.v);
    let by_u = bend_times(h, u);
    let by_v = bend_times(h, v);
    return vec3<f32>(dot(u, by_u), dot(u, by_v), dot(v, by_v));
}

// Weighted sums over the planes around a point.
struct Around {
    total: f32,
    // Sum of the distances from the point to the planes, along their normals.
    height: f32,
    normal: vec3<f32>,
    // Sums of x and of x x^T, where x is the offset of a plane's centroid from the point.
    offset: vec3<f32>,
    offsets: Symmetric,
    // Sum of n x^T + x n^T, where n is the normal.
    slopes: Symmetric,
    // Sum of the bends of the windows.
    windows: f32,
    // Sum of the variances along the planes.
    spreads: f32,
    // Sum of the planes' fits to their own points, regardless of the distance from p to the planes.
    fitting: f32,
    // Sum of the normals of the nearby planes, and their number.
    normals: vec3<f32>,
    count: f32,
}

// Returns a sum plus a factor times x y^T + y x^T.
fn plus_products(sum: Symmetric, x: vec3<f32>, y: vec3<f32>, factor: f32) -> Symmetric {
    let x_row = factor * fma(vec3<f32>(x.x), y, y.x * x);
    let rest = factor * fma(x.yyz, y.yzz, y.yyz * x.yzz);
    return Symmetric(
        sum.xx + x_row.x,
        sum.xy + x_row.y,
        sum.xz + x_row.z,
        sum.yy + rest.x,
        sum.yz + rest.y,
        sum.zz + rest.z,
    );
}

// The variation of the normals of the planes around a point.
struct Turn {
    per_total: f32,
    mean_normal: vec3<f32>,
    // The variance of the normals.
    variance: f32,
    // How far the variation exceeds that of noise, from 0 to 1.
    certain: f32,
}

fn turn_of(around: Around, radius: f32, noise: f32) -> Turn {
    if !(around.total > LEAST_BEND_WEIGHT) {
        return Turn(0.0, vec3<f32>(0.0), 0.0, 0.0);
    }
    let per_total = 1.0 / around.total;
    let mean_normal = around.normal * per_total;
    let variance = max(1.0 - dot(mean_normal, mean_normal), 0.0);
    let turns = sqrt(variance) * radius / (noise * LEAST_TURN);
    return Turn(per_total, mean_normal, variance, clamp(turns - 1.0, 0.0, 1.0));
}

struct Measured {
    bend: vec3<f32>,
    // Mean position of the planes along the tangents, where the vote's normal applies.
    centre: vec2<f32>,
    // Weighted sum of the heights of the surface at the point above the planes fitted to it.
    rise: f32,
}

// Returns the bend of a surface along the tangents `frame` of its normal.
fn bend_around(around: Around, turn: Turn, frame: Tangents, radius: f32) -> Measured {
    let per_total = turn.per_total;
    // In units of the radius, since its square may be as small as 1e-24 m².
    let per_radius = 1.0 / radius;
    let scale = per_total * per_radius;
    // The planes' mean position t, and their mean slope s. A slope is the sine of an angle; on a circle of radius r,
    // it is the position divided by r.
    let t = place_along(frame, around.offset) * scale;
    let s = -place_along(frame, turn.mean_normal);
    let squares = along(frame, around.offsets);
    let places = squares * (scale * per_radius);
    let slopes = along(frame, around.slopes) * -scale;
    // The symmetric H that minimises the mean of |s - H t|² plus damping |H|², by Cramer's rule for
    // [[a, b, 0], [b, a + c, b], [0, b, c]] (uu, uv, vv) = (p, q, r).
    let variances = max(places.xz - t * t, vec2<f32>(0.0));
    let a = variances.x + BEND_DAMPING;
    let b = places.y - t.x * t.y;
    let c = variances.y + BEND_DAMPING;
    let p = fma(slopes.x, 0.5, -(s.x * t.x));
    let q = slopes.y - s.x * t.y - s.y * t.x;
    let r = fma(slopes.z, 0.5, -(s.y * t.y));
    let bb = b * b;
    let sum = a + c;
    // H times the radius.
    let bend = vec3<f32>(
        (sum * c - bb) * p - b * c * q + bb * r,
        a * c * q - b * c * p - a * b * r,
        bb * p - a * b * q + (sum * a - bb) * r,
    ) / (sum * (a * c - bb));
    let square = bend_square(bend);
    // Covariance of H t with the slopes, and the variance of H t.
    let trace = bend.x + bend.z;
    let with_slopes = fma(bend.x, p, fma(bend.y, q, bend.z * r));
    let of_places = dot(variances, bend.xz * bend.xz + bend.y * bend.y) + 2.0 * b * bend.y * trace;
    let explained = with_slopes * with_slopes / max(of_places * turn.variance, MIN_POSITIVE);
    let within = around.windows * (radius * per_total);
    let agreed = within * trace / max(max(trace * trace, 0.5 * square), MIN_POSITIVE);
    let size = sqrt(square);
    let counts = turn.certain
        * clamp((explained - BEND_EXPLAINED_FROM) / (BEND_EXPLAINED_TO - BEND_EXPLAINED_FROM), 0.0, 1.0)
        * clamp((agreed - BEND_SHARED_FROM) / (BEND_SHARED_TO - BEND_SHARED_FROM), 0.0, 1.0);
    let limit = min(MOST_BEND / max(size, MIN_POSITIVE), 1.0);
    let found = bend * (counts * limit * per_radius);
    let twice = fma(found.x, squares.x, fma(found.z, squares.z, 2.0 * found.y * squares.y));
    return Measured(found, t * radius, 0.5 * twice - 0.25 * around.spreads * (found.x + found.z));
}
