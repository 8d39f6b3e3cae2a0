// The point on the surface, its normal and its status (docs/method.md, section 7).

struct Projected {
    point: vec3<f32>,
    normal: vec3<f32>,
    // Codes of Status.
    status: u32,
}

fn project_on_plane(p: vec3<f32>, plane: Plane) -> Projected {
    return Projected(fma(vec3<f32>(plane.height), plane.normal, p), plane.normal, STATUS_PLANE);
}
