// Moves the state into the view of a camera that has moved (equations 16.9 to 16.11). Each pixel looks up the position
// of its point in the previous frame. It takes the mean of those of the four pixels around that position that are on
// the same surface. Holes use their remembered range for the lookup.

fn rotated(v: vec3<f32>) -> vec3<f32> {
    return batch.rotation_x * v.x + batch.rotation_y * v.y + batch.rotation_z * v.z;
}

fn looked_up(pixel: vec2<u32>, i: u32) -> Pixel {
    var range = range_at(i);
    if range == 0.0 {
        let here = pixel_of(batch.previous_at, i);
        if here.frames <= 0.0 {
            return unknown();
        }
        range = range_of_mean(here.mean);
    }
    let to_ray = vec2<f32>((f32(pixel.x) - batch.cx) / batch.fx, (f32(pixel.y) - batch.cy) / batch.fy);
    // The point in the frame of the previous camera.
    let seen = rotated(vec3<f32>(to_ray, 1.0) * range) + batch.translation;
    if !(seen.z >= NEAREST_M && seen.z < MOST_DEPTH_M) {
        return unknown();
    }
    let ray = seen / seen.z;
    let place = fma(ray.xy, vec2<f32>(batch.fx, batch.fy), vec2<f32>(batch.cx, batch.cy));
    let last = vec2<f32>(f32(batch.width), f32(batch.height)) - 1.0;
    if !(all(place > vec2<f32>(-0.5)) && all(place < last + 0.5)) {
        return unknown();
    }
    let expected = measured(seen.z);
    let first = floor(place);
    let share = place - first;
    var weights = 0.0;
    var sum = vec3<f32>(0.0);
    for (var corner = 0u; corner < 4u; corner++) {
        let after = vec2<f32>(f32(corner & 1u), f32(corner >> 1u));
        let at = vec2<u32>(clamp(first + after, vec2<f32>(0.0), last));
        let other = pixel_of(batch.previous_at, at.y * batch.width + at.x);
        // off < 5 sigma sqrt(1 + 1/n), without a root or division.
        let off = max(abs(other.mean - expected.x) - SLOPE * expected.x, 0.0) / expected.y;
        let known = max(other.frames, 1.0);
        let is_same = other.frames > 0.0 && off * off * known < SAME_SURFACE * SAME_SURFACE * (known + 1.0);
        let shares = select(1.0 - share, share, after == vec2<f32>(1.0));
        let weight = select(0.0, shares.x * shares.y, is_same);
        weights += weight;
        sum = fma(vec3<f32>(weight), vec3<f32>(other.mean, other.frames, other.bias), sum);
    }
    if weights <= LEAST_WEIGHT {
        return unknown();
    }
    let found = sum / weights;
    let closest = vec2<u32>(clamp(floor(place + 0.5), vec2<f32>(0.0), last));
    let nearest = pixel_of(batch.previous_at, closest.y * batch.width + closest.x);
    // Range of the point found there, seen by the current camera.
    let forward = batch.rotation_z;
    let now = range_of_mean(found.x) * dot(forward, ray) - dot(forward, batch.translation);
    if !(now >= NEAREST_M && now < MOST_DEPTH_M) {
        return unknown();
    }
    return Pixel(measured(now).x, found.y, nearest.variance, found.z, nearest.idle);
}

@compute @workgroup_size(TILE, TILE)
fn move_state(@builtin(global_invocation_id) at: vec3<u32>) {
    if at.x < batch.width && at.y < batch.height {
        let i = at.y * batch.width + at.x;
        keep_pixel(i, looked_up(at.xy, i), 0u);
    }
}
