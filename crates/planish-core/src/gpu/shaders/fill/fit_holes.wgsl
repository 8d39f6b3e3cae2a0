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

// Number of steps that are looked up at once.
const STEPS_TOGETHER: i32 = 8;

// Largest number of steps to a rim, a multiple of STEPS_TOGETHER, and the largest size of the block of pixels within
// reach of a tile. Tiles are as wide as a word of hole bits.
const FARTHEST: u32 = u32(REACH) * WIDEST_HOLE_PX;
const_assert FARTHEST % u32(STEPS_TOGETHER) == 0u;
const BLOCK_WORDS: u32 = 1u + 2u * ((FARTHEST + 31u) / 32u);
const BLOCK_ROWS: u32 = TILE_HEIGHT + 2u * FARTHEST;

// The hole bits of the block, row by row: the tile's holes, and all within their reach.
var<workgroup> block_bits: array<u32, BLOCK_WORDS * BLOCK_ROWS>;

// The block of a tile.
struct Block {
    // The first pixel, which may be outside the image.
    origin: vec2<i32>,
    // Number of words per row.
    words: u32,
    // Largest number of steps to a rim.
    reach: i32,
    // Number of rows above and below the tile: the reach, rounded up to a multiple of STEPS_TOGETHER.
    margin: i32,
}

fn block_of(tile: vec2<u32>) -> Block {
    let reach = REACH * i32(batch.most_px);
    let margin = (reach + STEPS_TOGETHER - 1) / STEPS_TOGETHER * STEPS_TOGETHER;
    let words_beside = (margin + 31) / 32;
    let origin = vec2<i32>(tile * vec2<u32>(TILE_WIDTH, TILE_HEIGHT)) - vec2<i32>(32 * words_beside, margin);
    return Block(origin, u32(1 + 2 * words_beside), reach, margin);
}

// Returns the hole bits of 32 pixels; 0 outside the image.
fn hole_bits(frame: u32, row: i32, word: i32) -> u32 {
    if row < 0 || row >= i32(batch.height) || word < 0 || word >= i32((batch.width + 31u) / 32u) {
        return 0u;
    }
    return scratch[hole_bits_word(frame, u32(row), u32(word))];
}

fn load_block(frame: u32, block: Block, thread: u32) {
    let rows = TILE_HEIGHT + 2u * u32(block.margin);
    for (var k = thread; k < block.words * rows; k += TILE_WIDTH * TILE_HEIGHT) {
        let row = block.origin.y + i32(k / block.words);
        block_bits[k] = hole_bits(frame, row, block.origin.x / 32 + i32(k % block.words));
    }
    workgroupBarrier();
}

// Returns the number of steps to the first point in a direction; 0 if no point is within reach.
fn steps_to_rim(block: Block, at: vec2<i32>, k: u32) -> i32 {
    let step = direction(k);
    for (var steps = 0; steps < block.margin; steps += STEPS_TOGETHER) {
        var points = 0u;
        for (var next = 1; next <= STEPS_TOGETHER; next++) {
            let in_block = vec2<u32>(at + (steps + next) * step - block.origin);
            let bits = block_bits[in_block.y * block.words + in_block.x / 32u];
            points |= (1u - extractBits(bits, in_block.x % 32u, 1u)) << u32(next - 1);
        }
        if points != 0u {
            let found = steps + i32(firstTrailingBit(points)) + 1;
            // Outside the image, no pixel is a hole.
            return select(0, found, found <= block.reach && is_in_image(at + found * step));
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

const MOST_SAMPLES: i32 = max(SAMPLES, SHADOW_SAMPLES);

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
        // Loaded before the first is used, so that the loads overlap.
        var inverses = array<f32, MOST_SAMPLES>();
        for (var j = 0; j < count; j++) {
            let sample = at + step * ((*rims).steps[k] + j * spacing_px);
            // The pixel itself is a hole.
            inverses[j] = inverse_at(frame, index(select(at, sample, is_in_image(sample))));
        }
        for (var j = 0; j < count; j++) {
            let inverse = inverses[j];
            if inverse == 0.0 || abs(last - inverse) > most {
                break;
            }
            let steps = (*rims).steps[k] + j * spacing_px;
            let xy = vec2<f32>(step * steps) / scale_px;
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
fn fit_holes(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    let count = list_holes(frame, group.xy, thread);
    if count == 0u {
        return;
    }
    let block = block_of(group.xy);
    load_block(frame, block, thread);
    if thread >= count {
        return;
    }
    let at = listed_hole(group.xy, thread);
    let i = index(at);
    var rims = Rims();
    var narrow = 0u;
    for (var axis = 0u; axis < 4u; axis++) {
        let one = steps_to_rim(block, at, 2u * axis);
        let other = steps_to_rim(block, at, 2u * axis + 1u);
        rims.steps[2u * axis] = one;
        rims.steps[2u * axis + 1u] = other;
        narrow |= select(0u, 1u << axis, is_narrow(axis, one, other));
    }
    if narrow == 0u {
        return;
    }
    var is_surrounded = true;
    for (var k = 0u; k < 8u; k++) {
        // Without a rim, this is the pixel itself, whose 1/z is 0.
        rims.inverse[k] = inverse_at(frame, index(at + direction(k) * rims.steps[k]));
        is_surrounded = is_surrounded && rims.steps[k] > 0;
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
