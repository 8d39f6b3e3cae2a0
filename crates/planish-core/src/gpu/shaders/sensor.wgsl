// Position of the sensor in the cloud's frame (docs/method.md, section 11).
//
// Points are not transformed, so offsets between them are exact; transforming them into the sensor's frame would
// round them again. A ray leads from the sensor to a point, in the cloud's frame. For a cloud in the sensor's frame,
// these operations are exact (up to 1e18 m).

fn header_vec3(frame: u32, field: u32) -> vec3<f32> {
    return vec3<f32>(header(frame, field), header(frame, field + 1u), header(frame, field + 2u));
}

fn ray_to(frame: u32, p: vec3<f32>) -> vec3<f32> {
    if !IS_POINTS {
        return p;
    }
    // Clamped, so that derived values stay finite.
    return clamp(p, vec3<f32>(-1e18), vec3<f32>(1e18)) - header_vec3(frame, POSITION);
}

// Returns the length of a ray along the sensor's axis.
fn depth_of(frame: u32, ray: vec3<f32>) -> f32 {
    if !IS_POINTS {
        return ray.z;
    }
    return dot(header_vec3(frame, AXIS), ray);
}
