// Results back in the frame of the cloud, which may be another than the sensor's (docs/method.md, section 11).

fn rotate_to_cloud(frame: u32, v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        dot(vec3<f32>(header(frame, ROTATION), header(frame, ROTATION + 1u), header(frame, ROTATION + 2u)), v),
        dot(vec3<f32>(header(frame, ROTATION + 3u), header(frame, ROTATION + 4u), header(frame, ROTATION + 5u)), v),
        dot(vec3<f32>(header(frame, ROTATION + 6u), header(frame, ROTATION + 7u), header(frame, ROTATION + 8u)), v),
    );
}

// The point as it was measured, moved by the displacement from p to its place on the surface.
fn point_in_cloud(frame: u32, pixel: vec2<u32>, p: vec3<f32>, on_surface: vec3<f32>) -> vec3<f32> {
    if (header_bits(frame, FLAGS) & TURNED) == 0u {
        return on_surface;
    }
    let pixels = batch.width * batch.height;
    let at = frame * batch.input_words + HEADER_WORDS + batch.width + batch.height + pixel.y * batch.width + pixel.x;
    let measured = bitcast<vec3<f32>>(vec3<u32>(input[at], input[at + pixels], input[at + 2u * pixels]));
    return measured + rotate_to_cloud(frame, on_surface - p);
}

fn direction_in_cloud(frame: u32, v: vec3<f32>) -> vec3<f32> {
    if (header_bits(frame, FLAGS) & TURNED) == 0u {
        return v;
    }
    return rotate_to_cloud(frame, v);
}

// The ray of a pixel through a distorted lens is that of its point.
fn has_ray_of_point(frame: u32) -> bool {
    return (header_bits(frame, FLAGS) & RAYS_OF_POINTS) != 0u;
}
