// Where the sensor stands in the cloud's frame (docs/method.md, section 11).
//
// Points stay as they were measured, so that offsets between them are exact; a point turned into the sensor's frame would be
// rounded once more. A ray leads from the sensor to a point, in the cloud's frame.

fn is_turned(frame: u32) -> bool {
    return IS_POINTS && (header_bits(frame, FLAGS) & TURNED) != 0u;
}

fn header_vec3(frame: u32, field: u32) -> vec3<f32> {
    return vec3<f32>(header(frame, field), header(frame, field + 1u), header(frame, field + 2u));
}

fn ray_to(frame: u32, p: vec3<f32>) -> vec3<f32> {
    if !is_turned(frame) {
        return p;
    }
    // Clamped, so that what is computed from it stays finite.
    return clamp(p, vec3<f32>(-1e18), vec3<f32>(1e18)) - header_vec3(frame, TRANSLATION);
}

// How far a ray reaches along the sensor's axis.
fn depth_of(frame: u32, ray: vec3<f32>) -> f32 {
    if !is_turned(frame) {
        return ray.z;
    }
    return dot(header_vec3(frame, AXES + 6u), ray);
}

// A direction along the sensor's axes.
fn along_axes(frame: u32, v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        dot(header_vec3(frame, AXES), v),
        dot(header_vec3(frame, AXES + 3u), v),
        dot(header_vec3(frame, AXES + 6u), v),
    );
}

fn in_cloud(frame: u32, v: vec3<f32>) -> vec3<f32> {
    return fma(vec3<f32>(v.x), header_vec3(frame, AXES),
        fma(vec3<f32>(v.y), header_vec3(frame, AXES + 3u), v.z * header_vec3(frame, AXES + 6u)));
}

// The tangents that the sensor's frame gives a plane: which monomials are dropped (section 6) must not depend on the cloud's.
fn tangents_at(frame: u32, normal: vec3<f32>) -> Tangents {
    if !is_turned(frame) {
        return tangents_of(normal);
    }
    let tangents = tangents_of(along_axes(frame, normal));
    return Tangents(in_cloud(frame, tangents.u), in_cloud(frame, tangents.v));
}
