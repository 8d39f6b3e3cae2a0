// Returns true for the first of each run of equal positions among the sorted points.

fn is_head(i: u32) -> bool {
    if i >= cloud.points || all(keys[i] == HOLE_KEY) {
        return false;
    }
    return i == 0u || any(keys[i] != keys[i - 1u])
        || any(position_bits(order[i]) != position_bits(order[i - 1u]));
}

fn position_bits(i: u32) -> vec3<u32> {
    let bits = sample_bits(i);
    return select(bits, vec3<u32>(0u), bits == vec3<u32>(0x80000000u));
}
