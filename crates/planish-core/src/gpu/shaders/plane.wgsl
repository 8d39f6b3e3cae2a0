// The plane of a neighbourhood by principal component analysis (docs/method.md, section 4). Metres, relative to p.

struct Plane {
    // Unit normal, towards the sensor.
    normal: vec3<f32>,
    // Height of the plane over p, c·n; the foot of p on the plane is the height times the normal.
    height: f32,
    // The mean of the neighbours, c.
    centroid: vec3<f32>,
    // The sum of the variances along the plane, l1 + l2, in m².
    spread: f32,
    // Variance along the normal, l0, in m².
    residual: f32,
    // Uncertainty of the normal, l2/(l1 - l0), at most MAX_DOUBT.
    doubt: f32,
    // Four times the largest variance, 4 l2, in m²: the square of the neighbourhood's in-plane extent.
    extent_squared: f32,
    // Surface variation l0/(l0+l1+l2).
    curvature: f32,
    // Excess of l1 over its limit for a line, relative to the limit: l1/(1e-4 l2) - 1.
    off_line: f32,
    // True if the neighbours are collinear; the other fields are then meaningless.
    is_degenerate: bool,
}

// The plane of a point, as found by one of the passes.
struct LocalSurface {
    plane: Plane,
    // Number of neighbours.
    n: f32,
    // Maximum distance of a neighbour from the plane in metres; undefined if KEEPS_EDGES is false.
    width: f32,
    // Bend along the tangents of the plane's normal: uu, uv, vv; undefined if BENDS is false.
    bend: vec3<f32>,
    // From 0, if planes around the point fit, to 1, if none does; undefined if BENDS is false.
    no_plane_fits: f32,
}

// Returns the plane of the neighbours of p; `ray` leads from the sensor to p.
fn plane_of(ray: vec3<f32>, sums: Sums) -> Plane {
    let inverse_total = 1.0 / max(sums.total, MIN_POSITIVE);
    let c = sums.e * inverse_total;
    // Means of products minus products of means. All values are as small as the neighbourhood, so cancellation is
    // mild.
    let x_row = fma(sums.x_row, vec3<f32>(inverse_total), -(c.x * c));
    let rest = fma(sums.rest, vec3<f32>(inverse_total), -(c.yyz * c.yzz));
    let eigen = smallest_eigenvector(Symmetric(x_row.x, x_row.y, x_row.z, rest.x, rest.y, rest.z));
    let normal = select(eigen.vector, -eigen.vector, dot(eigen.vector, ray) > 0.0);
    let l = eigen.values;
    let residual = max(l.x, 0.0);
    let curvature = residual / max(l.x + l.y + l.z, MIN_POSITIVE);
    let doubt = min(l.z / max(l.y - residual, MIN_POSITIVE), MAX_DOUBT);
    let line = l.z * DEGENERATE_RATIO;
    let off_line = l.y / max(line, MIN_POSITIVE) - 1.0;
    return Plane(normal, dot(c, normal), c, l.y + l.z, residual, doubt, 4.0 * l.z, curvature, off_line, l.y <= line);
}
