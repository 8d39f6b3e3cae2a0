// The digits of the keys; `part.number` selects one, starting from the lowest.

const DIGITS: u32 = 16u;

fn digit_of(key: vec2<u32>) -> u32 {
    let shift = 4u * part.number;
    return (select(key.y, key.x, shift >= 32u) >> (shift % 32u)) & (DIGITS - 1u);
}
