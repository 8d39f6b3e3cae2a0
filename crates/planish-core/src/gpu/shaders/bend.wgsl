// How surfaces bend: tensors H in 1/m, of a surface that is x·Hx/2 above its tangent plane at an offset x along it
// (docs/method.md, section 10). Those of windows have six components in space; that of a surface has uu, uv and vv along
// the tangents of its normal.

// H (a, b).
fn bend_times(h: vec3<f32>, at: vec2<f32>) -> vec2<f32> {
    return vec2<f32>(fma(h.x, at.x, h.y * at.y), fma(h.y, at.x, h.z * at.y));
}

fn place_along(frame: Tangents, x: vec3<f32>) -> vec2<f32> {
    return vec2<f32>(dot(x, frame.u), dot(x, frame.v));
}

// The sum of the squares of all entries.
fn bend_square(h: vec3<f32>) -> f32 {
    return fma(h.x, h.x, fma(h.z, h.z, 2.0 * h.y * h.y));
}

fn along(frame: Tangents, m: Symmetric) -> vec3<f32> {
    let by_u = symmetric_times(m, frame.u);
    let by_v = symmetric_times(m, frame.v);
    return vec3<f32>(dot(frame.u, by_u), dot(frame.u, by_v), dot(frame.v, by_v));
}

// The same tensor along other tangents.
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
    // Of the distances from the point to the surface, along the normals.
    height: f32,
    normal: vec3<f32>,
    // Of the offsets x of their centroids from the point, and of x x^T.
    offset: vec3<f32>,
    offsets: Symmetric,
    // Of n x^T + x n^T, with the normals n.
    slopes: Symmetric,
    // Of the bends in their windows.
    windows: Symmetric,
}

// A sum plus a factor times x y^T + y x^T.
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

struct Measured {
    bend: vec3<f32>,
    // Mean place of the planes along the tangents.
    centre: vec2<f32>,
}

// The bend of a surface along the tangents `frame` of its normal.
fn bend_around(around: Around, frame: Tangents, radius: f32, noise: f32) -> Measured {
    if !(around.total > LEAST_BEND_WEIGHT) {
        return Measured(vec3<f32>(0.0), vec2<f32>(0.0));
    }
    let per_total = 1.0 / around.total;
    // In units of the radius, whose square may be as small as 1e-24 m².
    let per_radius = 1.0 / radius;
    let scale = per_total * per_radius;
    // A plane's place t, and its slope s, the sine of its angle: on a circle the slope grows with the place by 1/r.
    let t = place_along(frame, around.offset) * scale;
    let s = place_along(frame, around.normal) * -per_total;
    let places = along(frame, around.offsets) * (scale * per_radius);
    let slopes = along(frame, around.slopes) * -scale;
    // The symmetric H that minimises the mean of |s - H t|² plus damping |H|², by Cramer's rule for
    // [[a, b, 0], [b, a + c, b], [0, b, c]] (uu, uv, vv) = (p, q, r).
    let a = max(places.x - t.x * t.x, 0.0) + BEND_DAMPING;
    let b = places.y - t.x * t.y;
    let c = max(places.z - t.y * t.y, 0.0) + BEND_DAMPING;
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
    let size = sqrt(square);
    let within = along(frame, around.windows) * (radius * per_total);
    let product = fma(bend.x, within.x, fma(bend.z, within.z, 2.0 * bend.y * within.y));
    let ratio = product / max(square, MIN_POSITIVE);
    let counts = clamp((ratio - BEND_SHARED_FROM) / (BEND_SHARED_TO - BEND_SHARED_FROM), 0.0, 1.0);
    let certain = clamp(size * radius / (noise * (8.0 * LEAST_RISE)) - 1.0, 0.0, 1.0);
    let limit = min(MOST_BEND / max(size, MIN_POSITIVE), 1.0);
    return Measured(bend * (counts * certain * limit * per_radius), t * radius);
}
