// Where the sensor stands in the cloud's frame (docs/method.md, section 11).
//
// Points stay as they were measured, so that offsets between them are exact; a point turned into the sensor's frame would be
// rounded once more. A ray leads from the sensor to a point, in the cloud's frame. Where that is the sensor's own, the same
// operations change no bit (up to 1e18 m).

fn header_vec3(frame: u32, field: u32) -> vec3<f32> {
    return vec3<f32>(header(frame, field), header(frame, field + 1u), header(frame, field + 2u));
}

fn ray_to(frame: u32, p: vec3<f32>) -> vec3<f32> {
    if !IS_POINTS {
        return p;
    }
    // Clamped, so that what is computed from it stays finite.
    return clamp(p, vec3<f32>(-1e18), vec3<f32>(1e18)) - header_vec3(frame, POSITION);
}

// How far a ray reaches along the sensor's axis.
fn depth_of(frame: u32, ray: vec3<f32>) -> f32 {
    if !IS_POINTS {
        return ray.z;
    }
    return dot(header_vec3(frame, AXIS), ray);
}
