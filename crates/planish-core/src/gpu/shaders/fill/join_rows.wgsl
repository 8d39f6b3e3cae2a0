// Joins runs of hole pixels with those of the row above that they touch, also at a corner.
//
// A run is joined with one farther up in the same column, where all pixels between are holes. The runs between are
// joined with it too, directly or through others: by induction from the first row, each run is connected with every run
// that one of its columns reaches. If each run were joined with the next, tall holes would be long chains of labels,
// which are slow to follow.

// Number of rows to climb.
const CLIMB_PX: i32 = 32;
// Number of rows that are looked up at once.
const TOGETHER_PX: i32 = 8;

// Returns the highest pixel, up to CLIMB_PX rows above a hole pixel, with only holes between in the column.
fn climb(frame: u32, at: vec2<i32>) -> u32 {
    var rows = 0;
    while rows < CLIMB_PX {
        var bits = 0u;
        for (var k = 1; k <= TOGETHER_PX; k++) {
            let above = at - vec2<i32>(0, rows + k);
            let is_connected = above.y >= 0 && is_hole(frame, max(above, vec2<i32>(0)));
            bits |= select(1u << u32(k - 1), 0u, is_connected);
        }
        if bits != 0u {
            rows += i32(firstTrailingBit(bits));
            break;
        }
        rows += TOGETHER_PX;
    }
    return index(at - vec2<i32>(0, rows));
}

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
fn join_rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    if thread >= list_holes(frame, group.xy, thread) {
        return;
    }
    let at = listed_hole(group.xy, thread);
    if at.y == 0 {
        return;
    }
    let i = index(at);
    let has_left = at.x > 0 && is_hole(frame, at - vec2<i32>(1, 0));
    let has_above_left = at.x > 0 && is_hole(frame, at - vec2<i32>(1, 1));
    if is_hole(frame, at - vec2<i32>(0, 1)) {
        // Otherwise the pixel to the left, or one of its neighbours, joins the same runs.
        if !(has_left && has_above_left) {
            unite(frame, i, climb(frame, at - vec2<i32>(0, 1)));
        }
        return;
    }
    if !has_left && has_above_left {
        unite(frame, i, climb(frame, at - vec2<i32>(1, 1)));
    }
    let is_last = at.x + 1 == i32(batch.width);
    if !is_last && !is_hole(frame, at + vec2<i32>(1, 0)) && is_hole(frame, at + vec2<i32>(1, -1)) {
        unite(frame, i, climb(frame, at + vec2<i32>(1, -1)));
    }
}
