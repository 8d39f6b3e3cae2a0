// Measures the change of each pixel in sigmas, and sums the changes over tiles (equations 16.1 and 16.3). Each
// workgroup handles one tile.

var<workgroup> sums: array<vec2<f32>, TILE * TILE>;

// Limit of a change in sigmas: far beyond every test, and finite.
const MOST_CHANGE: f32 = 1e9;

@compute @workgroup_size(TILE, TILE)
fn measure_changes(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(global_invocation_id) at: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    var counted = vec2<f32>(0.0);
    if at.x < batch.width && at.y < batch.height {
        let i = at.y * batch.width + at.x;
        let range = range_at(i);
        let old = old_pixel(i);
        var change = NO_CHANGE;
        var sign = 0.0;
        if range > 0.0 && old.frames > 0.0 {
            let value = measured(range);
            let uncertainty = sqrt(1.0 + 1.0 / max(old.frames, 1.0));
            change = clamp((value.x - old.mean) / (value.y * uncertainty), -MOST_CHANGE, MOST_CHANGE);
            if abs(change) > CANDIDATE * single_deviation(old.variance) {
                sign = select(1.0, -1.0, change < 0.0);
            } else {
                counted = vec2<f32>(clamp(change, -CLIP_OF_TILE, CLIP_OF_TILE), 1.0);
            }
        }
        memory[batch.changes_at + i] = bitcast<u32>(change);
        memory[batch.changes_at + pixels() + i] = bitcast<u32>(sign);
    }
    sums[thread] = counted;
    for (var left = TILE * TILE / 2u; left > 0u; left /= 2u) {
        workgroupBarrier();
        if thread < left {
            sums[thread] += sums[thread + left];
        }
    }
    if thread == 0u {
        let tile = group.y * tiles_across() + group.x;
        memory[batch.tiles_at + tile] = bitcast<u32>(sums[0].x);
        memory[batch.tiles_at + tiles() + tile] = bitcast<u32>(sums[0].y);
    }
}
