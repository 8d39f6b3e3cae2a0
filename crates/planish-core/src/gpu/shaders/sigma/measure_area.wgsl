// Computes the area of correlation, the number of pixels whose noise counts as one sample (equation 17.3), from the
// sums of all segments.

// Number of groups of threads; each adds up every PARTS-th segment.
const PARTS: u32 = 10u;
const THREADS: u32 = PARTS * SEGMENT_WORDS;

var<workgroup> totals: array<f32, THREADS>;

// Returns the sum of correlations over the lags in both directions along an axis, up to the first small correlation.
fn along(axis: u32) -> f32 {
    var sum = 1.0;
    for (var k = 0u; k < MOST_LAG_PX; k++) {
        let product = totals[4u * k + 2u * axis];
        let square = totals[4u * k + 2u * axis + 1u];
        let correlation = select(0.0, product / max(square, MIN_POSITIVE), square > 0.0);
        if correlation < LEAST_CORRELATION {
            break;
        }
        sum += 2.0 * correlation;
    }
    return sum;
}

@compute @workgroup_size(THREADS)
fn measure_area(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    let which = thread % SEGMENT_WORDS;
    var total = 0.0;
    for (var k = thread / SEGMENT_WORDS; k < segments().x * segments().y; k += PARTS) {
        total += scratch[sums_at(frame, k) + which];
    }
    totals[thread] = total;
    workgroupBarrier();
    if thread < SEGMENT_WORDS {
        for (var part = 1u; part < PARTS; part++) {
            totals[thread] += totals[part * SEGMENT_WORDS + thread];
        }
    }
    workgroupBarrier();
    if thread == 0u {
        scratch[area_at(frame)] = max(along(0u) * along(1u), batch.least_area);
    }
}
