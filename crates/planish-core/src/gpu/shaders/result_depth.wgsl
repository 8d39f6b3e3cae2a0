// The depth of a result in metres and in raw units.

// Returns the rounding error of a product in f32: x y minus `product`. The products of the upper and lower halves of
// x and y are exact. A driver may compute fma() as a product and a sum, which would return 0 here.
fn product_error(x: f32, y: f32, product: f32) -> f32 {
    let upper = vec2<f32>(bitcast<f32>(bitcast<u32>(x) & 0xfffff000u), bitcast<f32>(bitcast<u32>(y) & 0xfffff000u));
    let lower = vec2<f32>(x, y) - upper;
    return ((upper.x * upper.y - product) + upper.x * lower.y + lower.x * upper.y) + lower.x * lower.y;
}

fn with_depth(frame: u32, depth: f32, without: PixelResult) -> PixelResult {
    var result = without;
    if WANTS_DEPTH || WANTS_DEPTH_M {
        result.depth_m = bitcast<u32>(depth);
        let units = header(frame, UNITS_PER_METRE);
        let product = depth * units;
        // Round halves up, as the host does. round() rounds halves to even, and the product is itself rounded to f32.
        let rounded = round(product);
        let over = product - rounded;
        let error = product_error(depth, units, product);
        let up = select(0.0, 1.0, over == 0.5 && error >= 0.0);
        let down = select(0.0, 1.0, over == -0.5 && error < 0.0);
        let raw = rounded + up - down;
        if raw >= 1.0 && raw < f32(SATURATED_DEPTH) {
            result.codes |= u32(raw) << 16u;
        }
    }
    return result;
}
