// Sums products of pairs of pixels within a row, and between a row and those below it (equation 17.3). One workgroup
// per segment of several sampled rows, one thread per column.

// Number of groups of threads; each adds up every PARTS-th column.
const PARTS: u32 = SEGMENT_PX / SEGMENT_WORDS;
// Distance between columns in `terms`; odd, so that threads do not compete for the same bank of memory.
const TERMS_STEP: u32 = SEGMENT_WORDS + 1u;

var<workgroup> residuals: array<f32, SEGMENT_PX + MOST_LAG_PX>;
var<workgroup> terms: array<f32, SEGMENT_PX * TERMS_STEP>;
var<workgroup> totals: array<f32, PARTS * SEGMENT_WORDS>;

// Returns the product and the mean square of two residuals; 0 if one is missing.
fn pair(a: f32, b: f32) -> vec2<f32> {
    let counts = a != NO_RESIDUAL && b != NO_RESIDUAL;
    return select(vec2<f32>(0.0), vec2<f32>(a * b, 0.5 * fma(a, a, b * b)), counts);
}

// Adds the terms of each pixel of a row.
fn add_row(frame: u32, row: u32, first: u32, thread: u32) {
    for (var k = thread; k < SEGMENT_PX + MOST_LAG_PX; k += SEGMENT_PX) {
        var residual = NO_RESIDUAL;
        if first + k < batch.width {
            residual = scratch_at(frame, row * batch.width + first + k);
        }
        residuals[k] = residual;
    }
    workgroupBarrier();
    let column = first + thread;
    let has_row = column + MOST_LAG_PX < batch.width;
    let has_column = column < batch.width && row + MOST_LAG_PX < batch.height;
    for (var k = 0u; k < MOST_LAG_PX; k++) {
        var below = NO_RESIDUAL;
        if has_column {
            below = scratch_at(frame, (row + k + 1u) * batch.width + column);
        }
        let along_row = pair(residuals[thread], select(NO_RESIDUAL, residuals[thread + k + 1u], has_row));
        let along_column = pair(residuals[thread], below);
        let at = thread * TERMS_STEP + 4u * k;
        terms[at] += along_row.x;
        terms[at + 1u] += along_row.y;
        terms[at + 2u] += along_column.x;
        terms[at + 3u] += along_column.y;
    }
    // The residuals are used until here.
    workgroupBarrier();
}

@compute @workgroup_size(SEGMENT_PX)
fn correlate_rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    for (var k = 0u; k < SEGMENT_WORDS; k++) {
        terms[thread * TERMS_STEP + k] = 0.0;
    }
    for (var k = 0u; k < SEGMENT_ROWS; k++) {
        let row = (group.y * SEGMENT_ROWS + k) * ROW_STRIDE_PX;
        if row < batch.height {
            add_row(frame, row, group.x * SEGMENT_PX, thread);
        }
    }
    if thread < PARTS * SEGMENT_WORDS {
        var total = 0.0;
        for (var column = thread / SEGMENT_WORDS; column < SEGMENT_PX; column += PARTS) {
            total += terms[column * TERMS_STEP + thread % SEGMENT_WORDS];
        }
        totals[thread] = total;
    }
    workgroupBarrier();
    if thread < SEGMENT_WORDS {
        var total = 0.0;
        for (var part = 0u; part < PARTS; part++) {
            total += totals[part * SEGMENT_WORDS + thread];
        }
        scratch[sums_at(frame, group.y * segments().x + group.x) + thread] = total;
    }
}
