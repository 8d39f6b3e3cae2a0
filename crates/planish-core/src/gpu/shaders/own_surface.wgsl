// Smooths a point over the surface that the previous pass found (docs/method.md, section 10).

fn smooth_point(frame: u32, cell: vec2<u32>, window: WindowOrigin, p: vec3<f32>) -> PixelResult {
    let at = cell_index(cell);
    let count = planes[plane_word(frame, FIRST_COUNT, at)];
    let n = u32(abs(count));
    if n < 3u {
        return no_result(STATUS_TOO_FEW, n);
    }
    var plane: Plane;
    plane.is_degenerate = count < 0.0;
    plane.curvature = planes[plane_word(frame, FIRST_CURVATURE, at)];
    plane.extent_squared = planes[plane_word(frame, FIRST_EXTENT, at)];
    plane.normal = plane_vector(frame, SURFACE_NORMAL, at);
    plane.height = planes[plane_word(frame, SURFACE_HEIGHT, at)];
    let radius = radius_at(frame, range_of(frame, ray_to(frame, p)));
    let bend = plane_vector(frame, SURFACE_BEND, at);
    let width = planes[plane_word(frame, SURFACE_WIDTH, at)];
    let no_plane_fits = planes[plane_word(frame, SURFACE_NO_PLANE_FITS, at)];
    let surface = LocalSurface(plane, abs(count), width, bend, no_plane_fits);
    return result_of(frame, window, p, radius, surface);
}
