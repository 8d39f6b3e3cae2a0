// Sums products of pairs of pixels within a row, and between a row and those below it (equation 17.3). One workgroup
// per sampled row.

const THREADS: u32 = 64u;

var<workgroup> shared_sums: array<f32, THREADS * ROW_WORDS>;

// Returns the product and the mean square of two residuals; 0 if one is missing.
fn pair(frame: u32, a: f32, b_at: u32) -> vec2<f32> {
    let b = scratch_at(frame, b_at);
    let counts = a != NO_RESIDUAL && b != NO_RESIDUAL;
    return select(vec2<f32>(0.0), vec2<f32>(a * b, 0.5 * fma(a, a, b * b)), counts);
}

@compute @workgroup_size(THREADS)
fn correlate_rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    let row = group.x * ROW_STRIDE_PX;
    var along_row = array<vec2<f32>, MOST_LAG_PX>();
    var along_column = array<vec2<f32>, MOST_LAG_PX>();
    for (var column = thread; column < batch.width; column += THREADS) {
        let i = row * batch.width + column;
        let a = scratch_at(frame, i);
        for (var k = 0u; k < MOST_LAG_PX; k++) {
            if column + MOST_LAG_PX < batch.width {
                along_row[k] += pair(frame, a, i + k + 1u);
            }
            if row + MOST_LAG_PX < batch.height {
                along_column[k] += pair(frame, a, i + (k + 1u) * batch.width);
            }
        }
    }
    for (var k = 0u; k < MOST_LAG_PX; k++) {
        let at = thread * ROW_WORDS + 4u * k;
        shared_sums[at] = along_row[k].x;
        shared_sums[at + 1u] = along_row[k].y;
        shared_sums[at + 2u] = along_column[k].x;
        shared_sums[at + 3u] = along_column[k].y;
    }
    workgroupBarrier();
    if thread < ROW_WORDS {
        var sum = 0.0;
        for (var other = 0u; other < THREADS; other++) {
            sum += shared_sums[other * ROW_WORDS + thread];
        }
        scratch[sums_at(frame, group.x) + thread] = sum;
    }
}
