// Replaces each count by the sum of all preceding counts, in one workgroup. There are `part.number` counts per tile.

const SCAN_THREADS: u32 = 256u;

var<workgroup> sums: array<u32, SCAN_THREADS>;

@compute @workgroup_size(SCAN_THREADS)
fn scan_counts(@builtin(local_invocation_index) thread: u32) {
    let length = part.number * cloud.tiles;
    let run = (length + SCAN_THREADS - 1u) / SCAN_THREADS;
    let first = min(thread * run, length);
    let end = min(first + run, length);
    var own = 0u;
    for (var i = first; i < end; i++) {
        own += counts[i];
    }
    sums[thread] = own;
    workgroupBarrier();
    for (var reach = 1u; reach < SCAN_THREADS; reach *= 2u) {
        let before = select(0u, sums[max(thread, reach) - reach], thread >= reach);
        workgroupBarrier();
        sums[thread] += before;
        workgroupBarrier();
    }
    var sum = sums[thread] - own;
    for (var i = first; i < end; i++) {
        let count = counts[i];
        counts[i] = sum;
        sum += count;
    }
}
