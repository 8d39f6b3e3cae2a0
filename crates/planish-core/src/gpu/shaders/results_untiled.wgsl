// The results straight from the frame, for blocks whose tile outgrows workgroup memory (docs/method.md, section 10).

// Frame, and column and row of the first result of a pixel's block.
struct BlockOrigin {
    frame: u32,
    x: i32,
    y: i32,
}

fn load_results(frame: u32, origin: vec2<u32>, thread: u32) {
}

fn block_origin_of(frame: u32, pixel: vec2<u32>, local: vec2<u32>) -> BlockOrigin {
    let first = vec2<i32>(pixel) - i32(WINDOW);
    return BlockOrigin(frame, first.x, first.y);
}

fn result_in_block(block: BlockOrigin, column: u32, row: u32) -> KeptResult {
    return kept_result(block.frame, block.x + i32(column), block.y + i32(row));
}
