// Sets 1/z and its extent, the labels and sizes of runs of hole pixels within a row, and the votes for the side of
// shadows. One workgroup per row.

// One bit per pixel of the row, set for holes.
var<workgroup> row_holes: array<atomic<u32>, WIDEST_PX / 32u>;
// The row's LARGEST and SMALLEST.
var<workgroup> row_extent: array<atomic<u32>, 2>;

// Returns 1/z of a smoothed point; 0 for a hole.
fn smoothed_inverse(frame: u32, i: u32) -> f32 {
    let bits = output[frame * batch.output_words + (POINTS_CHANNEL + 2u) * pixels() + i];
    if !is_finite(bits) || status_at(frame, i) < STATUS_DEGENERATE {
        return 0.0;
    }
    let z = bitcast<f32>(bits);
    // Drivers may treat subnormal numbers as 0.
    let inverse = select(0.0, 1.0 / z, z > 0.0);
    return select(0.0, inverse, inverse >= MIN_POSITIVE);
}

fn is_hole_of_row(column: u32) -> bool {
    return extractBits(atomicLoad(&row_holes[column / 32u]), column % 32u, 1u) != 0u;
}

// Returns the first column of the run of hole pixels that contains a column.
fn run_start(column: u32) -> u32 {
    var word = column / 32u;
    var points = ~atomicLoad(&row_holes[word]) & ((1u << (column % 32u)) - 1u);
    while points == 0u && word > 0u {
        word -= 1u;
        points = ~atomicLoad(&row_holes[word]);
    }
    return select(0u, 32u * word + firstLeadingBit(points) + 1u, points != 0u);
}

@compute @workgroup_size(ROW_THREADS)
fn begin_rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    let first = group.x * batch.width;
    for (var word = thread; word < (batch.width + 31u) / 32u; word += ROW_THREADS) {
        atomicStore(&row_holes[word], 0u);
    }
    if thread < 2u {
        atomicStore(&row_extent[thread], 0u);
    }
    workgroupBarrier();
    var largest = 0u;
    var smallest = 0u;
    for (var column = thread; column < batch.width; column += ROW_THREADS) {
        let i = first + column;
        let inverse = bitcast<u32>(smoothed_inverse(frame, i));
        scratch[scratch_word(frame, INVERSE, i)] = inverse;
        if inverse == 0u {
            atomicOr(&row_holes[column / 32u], 1u << (column % 32u));
            scratch[scratch_word(frame, FITTED, i)] = 0u;
            scratch[scratch_word(frame, FILLED, i)] = 0u;
            atomicStore(&holes[hole_word(frame, TALLY, i)], 0u);
        } else {
            largest = max(largest, inverse);
            smallest = max(smallest, INFINITE_BITS - inverse);
        }
    }
    atomicMax(&row_extent[LARGEST], largest);
    atomicMax(&row_extent[SMALLEST], smallest);
    workgroupBarrier();
    for (var word = thread; word < (batch.width + 31u) / 32u; word += ROW_THREADS) {
        scratch[hole_bits_word(frame, group.x, word)] = atomicLoad(&row_holes[word]);
    }
    if thread < 2u {
        atomicMax(&holes[frame_word(frame, thread)], atomicLoad(&row_extent[thread]));
    }
    let shift = shadow_shift(frame);
    for (var column = thread; column < batch.width; column += ROW_THREADS) {
        if !is_hole_of_row(column) {
            continue;
        }
        let start = run_start(column);
        let i = first + column;
        atomicStore(&holes[hole_word(frame, LABEL, i)], first + start);
        let is_end = column + 1u == batch.width || !is_hole_of_row(column + 1u);
        let length = column + 1u - start;
        // The last pixel of a run knows its length.
        if is_end {
            atomicStore(&holes[hole_word(frame, SIZE, first + start)], length);
        }
        // Only the first pixel of a run has a size.
        if column != start {
            atomicStore(&holes[hole_word(frame, SIZE, i)], 0u);
        }
        if is_end && length > 1u && start > 0u && column + 1u < batch.width && shift > 0.0 {
            let left = smoothed_inverse(frame, first + start - 1u);
            let right = smoothed_inverse(frame, i + 1u);
            if is_shadow(shift, right, left, length) {
                atomicAdd(&holes[frame_word(frame, VOTES_LEFT)], length);
            }
            if is_shadow(shift, left, right, length) {
                atomicAdd(&holes[frame_word(frame, VOTES_RIGHT)], length);
            }
        }
    }
}
