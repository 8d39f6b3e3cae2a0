// The samples of the windows are the measured points.

fn sample_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    return point_at(frame, x, y);
}

// Returns the measured point of a pixel.
fn centre_of(frame: u32, pixel: vec2<u32>, window: WindowOrigin) -> vec3<f32> {
    return candidate(window, WINDOW, WINDOW);
}
