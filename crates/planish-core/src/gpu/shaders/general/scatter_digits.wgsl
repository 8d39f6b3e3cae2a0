// Sorts by one digit: moves a tile's keys and points to their sorted positions. Equal digits keep their order.

// Number of keys by digit, then thread; later the number of preceding keys.
var<workgroup> ranks: array<u32, DIGITS * SORT_THREADS>;
var<workgroup> sums: array<u32, SORT_THREADS>;
var<workgroup> starts: array<u32, DIGITS>;

@compute @workgroup_size(SORT_THREADS)
fn scatter_digits(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = number_of(group, groups);
    let first = tile * TILE + thread * RUN;
    for (var digit = 0u; digit < DIGITS; digit++) {
        ranks[digit * SORT_THREADS + thread] = 0u;
    }
    for (var i = first; i < min(first + RUN, cloud.points); i++) {
        ranks[digit_of(keys[i]) * SORT_THREADS + thread] += 1u;
    }
    workgroupBarrier();
    var own = 0u;
    for (var k = 0u; k < DIGITS; k++) {
        own += ranks[thread * DIGITS + k];
    }
    sums[thread] = own;
    workgroupBarrier();
    for (var reach = 1u; reach < SORT_THREADS; reach *= 2u) {
        let before = select(0u, sums[max(thread, reach) - reach], thread >= reach);
        workgroupBarrier();
        sums[thread] += before;
        workgroupBarrier();
    }
    var sum = sums[thread] - own;
    for (var k = 0u; k < DIGITS; k++) {
        let count = ranks[thread * DIGITS + k];
        ranks[thread * DIGITS + k] = sum;
        sum += count;
    }
    workgroupBarrier();
    if thread < DIGITS {
        starts[thread] = ranks[thread * SORT_THREADS];
    }
    workgroupBarrier();
    for (var i = first; i < min(first + RUN, cloud.points); i++) {
        let key = keys[i];
        let digit = digit_of(key);
        let rank = digit * SORT_THREADS + thread;
        let to = counts[digit * cloud.tiles + tile] + ranks[rank] - starts[digit];
        ranks[rank] += 1u;
        keys_out[to] = key;
        order_out[to] = order[i];
    }
}
