// The weighted polynomial over the plane (docs/method.md, section 5): the moments of the normal equations.
//
// The weight is g 2^-(a² + b² + f²), with the gate g, and narrower across the surface if edges are kept. a and b are
// the in-plane coordinates and f the height over the plane, in units of the bandwidth over sqrt(log2 e). Moments: m_ij
// = sum w a^i b^j for i + j <= 2 DEGREE, t_ij = sum w f a^i b^j for i + j <= DEGREE, summed as outer products of the
// powers of a and b. kernel.rs generates the struct Moments. It replaces the lines in capital letters by the loop over
// the candidates (e is a candidate's offset from p, count its number of points) and by the sums, one statement per
// moment. Loops are not unrolled: the kernel would exceed the instruction cache.

struct Fit {
    moments: Moments,
    // sum w f²; 0 if BENDS is false.
    squares: f32,
    // In-plane axes, of unit length.
    u: vec3<f32>,
    v: vec3<f32>,
    // Number of units of a, b and f per metre.
    per_metre: f32,
    // The square of the extent in units of a and b.
    extent_squared: f32,
}

// Second pass over the window. Uses the gate of the first pass, in the units of the fit. Neighbours count within
// `width` of the surface.
fn fit_of(window: WindowOrigin, p: vec3<f32>, radius_squared: f32, surface: LocalSurface, width: f32, bandwidth: f32) -> Fit {
    let plane = surface.plane;
    let tangents = tangents_of(plane.normal);
    let per_metre = SQRT_LOG2_E / bandwidth;
    let a_axis = tangents.u * per_metre;
    let b_axis = tangents.v * per_metre;
    let f_axis = plane.normal * per_metre;
    let f_offset = plane.height * per_metre;
    let gate = Gate(-GATE_FADE / (radius_squared * per_metre * per_metre));
    // Factor of f² in the weight of section 10.
    let narrowing = (bandwidth / width) * (bandwidth / width);
    // Half the bend in the units of the fit, subtracted from f.
    let half_bend = surface.bend * (0.5 / per_metre);
    var s: Moments;
    var squares = 0.0;
    FOR_EACH_CANDIDATE
        let a = fma(e.x, a_axis.x, fma(e.y, a_axis.y, e.z * a_axis.z));
        let b = fma(e.x, b_axis.x, fma(e.y, b_axis.y, e.z * b_axis.z));
        let above_p = fma(e.x, f_axis.x, fma(e.y, f_axis.y, e.z * f_axis.z));
        let in_plane = fma(a, a, b * b);
        let squared = fma(above_p, above_p, in_plane);
        let nearness = unclamped(gate, squared);
        if nearness > 0.0 {
            var f = above_p - f_offset;
            var exponent = fma(f, f, in_plane);
            if BENDS {
                f -= fma(a * a, half_bend.x, fma(b * b, half_bend.z, 2.0 * a * b * half_bend.y));
            }
            if KEEPS_EDGES {
                exponent += min(f * f * narrowing, MAX_OFF_SURFACE);
            }
            let w = count * (min(nearness, 1.0) * exp2(-exponent));
            if BENDS {
                squares = fma(w * f, f, squares);
            }
            SUM_MOMENTS
        }
    END_OF_CANDIDATES
    let extent_squared = min(plane.extent_squared, radius_squared) * per_metre * per_metre;
    return Fit(s, squares, tangents.u, tangents.v, per_metre, extent_squared);
}
