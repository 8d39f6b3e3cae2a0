// Degree 1: the plane is the surface (docs/method.md, section 5).

fn surface_of(frame: u32, window: WindowOrigin, p: vec3<f32>, radius: f32, surface: LocalSurface) -> Projected {
    return project_on_plane(frame, p, surface.plane, radius);
}
