// Joins runs of hole pixels with those of the row above that they touch, also at a corner.

fn unite(frame: u32, one: u32, other: u32) {
    var a = first_pixel(frame, one);
    var b = first_pixel(frame, other);
    while a != b {
        let later = max(a, b);
        let earlier = min(a, b);
        let before = atomicMin(&holes[hole_word(frame, LABEL, later)], earlier);
        if before == later {
            return;
        }
        // Another thread joined `later` to a third run in the meantime, which is now joined as well.
        a = first_pixel(frame, before);
        b = first_pixel(frame, earlier);
    }
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn join_rows(@builtin(global_invocation_id) id: vec3<u32>) {
    let frame = id.z;
    let at = vec2<i32>(id.xy);
    let i = id.y * batch.width + id.x;
    if id.x >= batch.width || id.y >= batch.height || id.y == 0u || !is_hole(frame, at) {
        return;
    }
    let above = i - batch.width;
    let has_left = id.x > 0u && is_hole(frame, at - vec2<i32>(1, 0));
    let has_above_left = id.x > 0u && is_hole(frame, at - vec2<i32>(1, 1));
    if is_hole(frame, at - vec2<i32>(0, 1)) {
        // Otherwise the pixel to the left, or one of its neighbours, joins the same runs.
        if !(has_left && has_above_left) {
            unite(frame, i, above);
        }
        return;
    }
    if !has_left && has_above_left {
        unite(frame, i, above - 1u);
    }
    let is_last = id.x + 1u == batch.width;
    if !is_last && !is_hole(frame, at + vec2<i32>(1, 0)) && is_hole(frame, at + vec2<i32>(1, -1)) {
        unite(frame, i, above + 1u);
    }
}
