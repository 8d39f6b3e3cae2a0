// Fits the surface at each pixel of a hole to the points at the rim in eight directions, and to points behind them.

// Returns a direction: right, left, down, up, then the diagonals. Opposite directions are adjacent.
fn direction(k: u32) -> vec2<i32> {
    let axis = k / 2u;
    let step = vec2<i32>(select(1, 0, axis == 1u), select(select(1, -1, axis == 3u), 0, axis == 0u));
    return select(step, -step, (k & 1u) != 0u);
}

fn is_used(used: u32, k: u32) -> bool {
    return extractBits(used, k, 1u) != 0u;
}

// The first point in each direction.
struct Rims {
    // Number of steps to the point; 0 if no point is within reach.
    steps: array<i32, 8>,
    // Its 1/z.
    inverse: array<f32, 8>,
}

// Returns the squared distance to the rim in a direction, in pixels.
fn squared_px(k: u32, steps: i32) -> f32 {
    return f32(steps * steps) * select(1.0, 2.0, k >= 4u);
}

// Returns the number of steps to the first point in a direction; 0 if no point is within `most` steps.
fn steps_to_rim(frame: u32, at: vec2<i32>, k: u32, most: i32) -> i32 {
    let step = direction(k);
    var next = at;
    for (var steps = 1; steps <= most; steps++) {
        next += step;
        if !is_in_image(next) {
            return 0;
        }
        if !is_hole(frame, next) {
            return steps;
        }
    }
    return 0;
}

// Returns true if the hole is narrow along an axis, whose two rims are at these numbers of steps.
fn is_narrow(axis: u32, one: i32, other: i32) -> bool {
    // Along diagonals, pixels are farther apart.
    let width_px = f32(one + other - 1) * select(1.0, 1.41421356, axis >= 2u);
    return one > 0 && other > 0 && floor(width_px) <= f32(batch.most_px);
}

fn add_sample(s: ptr<function, Moments>, x: f32, y: f32, w: f32, f: f32) {
    let wx = w * x;
    let wy = w * y;
    let wxx = wx * x;
    let wxy = wx * y;
    let wyy = wy * y;
    (*s).m00 += w;
    (*s).m10 += wx;
    (*s).m01 += wy;
    (*s).m20 += wxx;
    (*s).m11 += wxy;
    (*s).m02 += wyy;
    (*s).m30 += wxx * x;
    (*s).m21 += wxx * y;
    (*s).m12 += wyy * x;
    (*s).m03 += wyy * y;
    (*s).m40 += wxx * x * x;
    (*s).m31 += wxx * x * y;
    (*s).m22 += wxx * y * y;
    (*s).m13 += wyy * x * y;
    (*s).m04 += wyy * y * y;
    (*s).t00 += w * f;
    (*s).t10 += wx * f;
    (*s).t01 += wy * f;
    (*s).t20 += wxx * f;
    (*s).t11 += wxy * f;
    (*s).t02 += wyy * f;
}

// The fitted polynomial around a pixel, relative to `origin`, with coordinates in units of `scale_px`.
struct Surface {
    // Coefficients of 1, x, y, x², xy and y².
    c0: f32,
    c1: f32,
    c2: f32,
    c3: f32,
    c4: f32,
    c5: f32,
    origin: f32,
    scale_px: f32,
    // Variance of the fit at the pixel, relative to that of a weighted mean of the samples.
    leverage: f32,
    // Number of samples.
    samples: u32,
}

fn surface_at(surface: Surface, x_px: f32, y_px: f32) -> f32 {
    let x = x_px / surface.scale_px;
    let y = y_px / surface.scale_px;
    return surface.c0 + x * (surface.c1 + x * surface.c3 + y * surface.c4) + y * (surface.c2 + y * surface.c5);
}

// Fits a surface to the rims whose bit is set in `used`, with up to `count` samples per direction.
fn fit(frame: u32, at: vec2<i32>, rims: ptr<function, Rims>, used: u32, count: i32, spacing_px: i32) -> Surface {
    var farthest = 0.0;
    var origin = 0.0;
    for (var k = 0u; k < 8u; k++) {
        if is_used(used, k) {
            farthest = max(farthest, squared_px(k, (*rims).steps[k]));
            // Sums are relative to the 1/z of one rim: f32 is then precise enough.
            origin = select(origin, (*rims).inverse[k], origin == 0.0);
        }
    }
    let scale_px = sqrt(farthest);
    var sums = Moments();
    var samples = 0u;
    for (var k = 0u; k < 8u; k++) {
        if !is_used(used, k) {
            continue;
        }
        var last = (*rims).inverse[k];
        let most = step_limit(last);
        let step = direction(k);
        for (var j = 0; j < count; j++) {
            let steps = (*rims).steps[k] + j * spacing_px;
            let offset = step * steps;
            if !is_in_image(at + offset) {
                break;
            }
            let inverse = inverse_at(frame, index(at + offset));
            if inverse == 0.0 || abs(last - inverse) > most {
                break;
            }
            let xy = vec2<f32>(offset) / scale_px;
            add_sample(&sums, xy.x, xy.y, 1.0 / squared_px(k, steps), inverse - origin);
            samples += 1u;
            last = inverse;
        }
    }
    return solve(sums, origin, scale_px, samples);
}

// Returns the patch of a surface; one without samples if a rim point is off the surface, or the value is impossible.
fn patch_of(frame: u32, i: u32, at: vec2<i32>, surface: Surface, rims: ptr<function, Rims>, used: u32) -> Patch {
    var squares = 0.0;
    var weights = 0.0;
    var sigma_m = 0.0;
    var nearest = FAR_BEYOND;
    var curvature = 0.0;
    var curvatures = 0.0;
    for (var k = 0u; k < 8u; k++) {
        if !is_used(used, k) {
            continue;
        }
        let offset = direction(k) * (*rims).steps[k];
        let inverse = (*rims).inverse[k];
        let off = surface_at(surface, f32(offset.x), f32(offset.y)) - (inverse - surface.origin);
        if abs(off) > limit(inverse, RIM_DEVIATIONS, RIM_SHARE) {
            return no_patch();
        }
        let squared = squared_px(k, (*rims).steps[k]);
        let weight = 1.0 / squared;
        let off_m = off / inverse / inverse;
        let rim = frame * batch.output_words + index(at + offset);
        squares += weight * off_m * off_m;
        weights += weight;
        nearest = min(nearest, squared);
        if WANTS_SIGMA {
            sigma_m += weight * bitcast<f32>(output[rim + SIGMA_CHANNEL * pixels()]);
        }
        if WANTS_CURVATURE {
            let bits = output[rim + CURVATURE_CHANNEL * pixels()];
            let is_known = is_finite(bits);
            curvature += select(0.0, bitcast<f32>(select(0u, bits, is_known)), is_known);
            curvatures += select(0.0, 1.0, is_known);
        }
    }
    let inverse = surface.origin + surface.c0;
    if !is_possible(frame, i, inverse) {
        return no_patch();
    }
    let mean_m = sigma_m / weights;
    let growth = GROWTH_AT_RIM + GROWTH_PER_PX * sqrt(nearest);
    return Patch(
        inverse,
        vec2<f32>(surface.c1, surface.c2) / surface.scale_px,
        growth * sqrt(squares / weights + mean_m * mean_m),
        select(NAN_BITS, bitcast<u32>(curvature / max(curvatures, 1.0)), curvatures > 0.0),
        surface.samples,
    );
}

// Returns the surface through all rim points.
fn spanned(frame: u32, i: u32, at: vec2<i32>, rims: ptr<function, Rims>) -> Patch {
    // On a plane, lines between opposite points meet at the pixel. This test rejects, without a fit, most rims that
    // span two surfaces.
    var least = FAR_BEYOND;
    var most = 0.0;
    var used = 0u;
    for (var k = 0u; k < 8u; k += 2u) {
        let one = (*rims).steps[k];
        let other = (*rims).steps[k + 1u];
        used |= select(0u, 1u << k, one > 0) | select(0u, 2u << k, other > 0);
        if one > 0 && other > 0 {
            let share = f32(one) / f32(one + other);
            let inverse = fma(share, (*rims).inverse[k + 1u] - (*rims).inverse[k], (*rims).inverse[k]);
            least = min(least, inverse);
            most = max(most, inverse);
        }
    }
    if least < most && is_step(least, most) {
        return no_patch();
    }
    return patch_of(frame, i, at, fit(frame, at, rims, used, SAMPLES, SPACING_PX), rims, used);
}

// Returns the far surface if the pixel is in the shadow of a near one.
fn shadowed(frame: u32, i: u32, at: vec2<i32>, rims: ptr<function, Rims>) -> Patch {
    let votes_left = atomicLoad(&holes[frame_word(frame, VOTES_LEFT)]);
    let votes_right = atomicLoad(&holes[frame_word(frame, VOTES_RIGHT)]);
    if votes_left + votes_right == 0u || (*rims).steps[0] == 0 || (*rims).steps[1] == 0 {
        return no_patch();
    }
    // Direction 0 is to the right, direction 1 to the left.
    let near = select(1u, 0u, votes_left >= votes_right);
    let near_inverse = (*rims).inverse[near];
    let far_inverse = (*rims).inverse[1u - near];
    let shift = shadow_shift(frame);
    let width_px = (*rims).steps[0] + (*rims).steps[1] - 1;
    if !is_shadow(shift, near_inverse, far_inverse, u32(width_px)) {
        return no_patch();
    }
    let excess_px = max(f32(width_px) - shift * (near_inverse - far_inverse), 0.0);
    if f32((*rims).steps[near]) <= SHADOW_MARGIN_PX + excess_px {
        return no_patch();
    }
    // Rim points on the side of the near surface may belong to any surface.
    let towards_near = direction(near).x;
    var used = 0u;
    for (var k = 0u; k < 8u; k++) {
        if (*rims).steps[k] == 0 || direction(k).x == towards_near {
            continue;
        }
        if !is_step((*rims).inverse[k], far_inverse) {
            used |= 1u << k;
        } else if (*rims).inverse[k] < far_inverse {
            // A third surface is farther away: it or the far one may continue behind the near one.
            return no_patch();
        }
    }
    let surface = fit(frame, at, rims, used, SHADOW_SAMPLES, SHADOW_SPACING_PX);
    var found = patch_of(frame, i, at, surface, rims, used);
    if found.samples == 0u {
        return found;
    }
    // The surface must change little, and be behind the one that casts the shadow.
    let is_far = found.inverse < near_inverse && is_step(found.inverse, near_inverse);
    if abs(found.inverse - far_inverse) > SHADOW_CHANGE * far_inverse || !is_far {
        return no_patch();
    }
    found.sigma_m *= sqrt(max(surface.leverage, 1.0));
    return found;
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn fit_holes(@builtin(global_invocation_id) id: vec3<u32>) {
    let frame = id.z;
    let i = id.y * batch.width + id.x;
    if id.x >= batch.width || id.y >= batch.height || !is_hole(frame, vec2<i32>(id.xy)) {
        return;
    }
    let at = vec2<i32>(id.xy);
    let reach = REACH * i32(batch.most_px);
    var rims = Rims();
    var narrow = 0u;
    for (var axis = 0u; axis < 4u; axis++) {
        let one = steps_to_rim(frame, at, 2u * axis, reach);
        let other = steps_to_rim(frame, at, 2u * axis + 1u, reach);
        rims.steps[2u * axis] = one;
        rims.steps[2u * axis + 1u] = other;
        narrow |= select(0u, 1u << axis, is_narrow(axis, one, other));
    }
    if narrow == 0u {
        return;
    }
    var is_surrounded = true;
    for (var k = 0u; k < 8u; k++) {
        let steps = rims.steps[k];
        if steps > 0 {
            rims.inverse[k] = inverse_at(frame, index(at + direction(k) * steps));
        } else {
            is_surrounded = false;
        }
    }
    let hole = atomicLoad(&holes[hole_word(frame, LABEL, i)]);
    var found = no_patch();
    if is_surrounded || !has_step(frame, hole) {
        found = spanned(frame, i, at, &rims);
    }
    if found.samples == 0u && (narrow & 1u) != 0u {
        found = shadowed(frame, i, at, &rims);
    }
    if found.samples > 0u {
        store_patch(frame, i, found);
        scratch[scratch_word(frame, FITTED, i)] = 1u;
        atomicAdd(&holes[hole_word(frame, TALLY, hole)], 1u);
    }
}
