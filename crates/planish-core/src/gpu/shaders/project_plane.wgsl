// The point on the surface, its normal and its status (docs/method.md, section 7).

struct Projected {
    point: vec3<f32>,
    normal: vec3<f32>,
    // Code of `Status`.
    status: u32,
    // Ratio of the depth at which the ray meets the surface to the measured depth.
    depth_scale: f32,
}

// Returns whether points move along their rays. The points of cells move along the normals of their planes.
fn is_on_ray(frame: u32) -> bool {
    return !KEEPS_RESULTS && (header_bits(frame, FLAGS) & ON_RAY) != 0u;
}

// Moves p onto the surface `height` away along the plane's normal; `normal` is the normal of that surface.
fn put_on_surface(frame: u32, p: vec3<f32>, plane_normal: vec3<f32>, height: f32, normal: vec3<f32>, radius: f32, status: u32) -> Projected {
    let on_ray = is_on_ray(frame);
    var point = fma(vec3<f32>(height), plane_normal, p);
    var along = 0.0;
    if WANTS_DEPTH || WANTS_DEPTH_M || on_ray {
        let ray = ray_to(frame, p);
        along = along_ray(height * dot(plane_normal, normal), normal, ray, radius);
        if on_ray {
            point = fma(vec3<f32>(along), ray, p);
        }
    }
    return Projected(point, normal, status, 1.0 + along);
}

// Returns the distance along the ray, in ray lengths, to the tangent plane, which is `height` from the ray's end along
// its normal. At grazing incidence, 1/c is replaced by c/max(c², 0.2²), with c the cosine of the angle of incidence.
fn along_ray(height: f32, normal: vec3<f32>, ray: vec3<f32>, radius: f32) -> f32 {
    let square = max(dot(ray, ray), MIN_POSITIVE);
    let across = dot(ray, normal);
    let divisor = max(max(across * across, square * (GRAZING_COSINE * GRAZING_COSINE)), MIN_POSITIVE);
    let along = height * across / divisor;
    let limit = min(radius / sqrt(square), MAX_ALONG);
    return clamp(along, -limit, limit);
}

fn project_on_plane(frame: u32, p: vec3<f32>, plane: Plane, radius: f32) -> Projected {
    return put_on_surface(frame, p, plane.normal, plane.height, plane.normal, radius, STATUS_PLANE);
}
