// Returns the distance in cells from the middle of a window to one of its columns (docs/method.md, section 10).
fn offset_of(column: u32) -> i32 {
    let from_middle = i32(column) - i32(WINDOW);
    return sign(from_middle) * ((abs(from_middle) * i32(STRIDE) + i32(CELL) - 1) / i32(CELL));
}
