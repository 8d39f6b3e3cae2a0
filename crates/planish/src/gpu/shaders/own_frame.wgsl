// Depth images: the frame of the results is the sensor's own.

fn point_in_cloud(frame: u32, pixel: vec2<u32>, p: vec3<f32>, on_surface: vec3<f32>) -> vec3<f32> {
    return on_surface;
}

fn direction_in_cloud(frame: u32, v: vec3<f32>) -> vec3<f32> {
    return v;
}

fn has_ray_of_point(frame: u32) -> bool {
    return false;
}
