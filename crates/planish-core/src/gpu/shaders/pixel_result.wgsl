// A point's result before it is stored. NaN is written as bits and never computed.

const NAN_BITS: u32 = 0x7fc00000u;

struct PixelResult {
    point: vec3<u32>,
    normal: vec3<u32>,
    curvature: u32,
    depth_m: u32,
    // For frames: status in the low byte, number of neighbours in the next, raw depth in the upper half. For
    // unorganized clouds: status in the low byte, clamped number of neighbours in the upper three.
    codes: u32,
}

fn no_result(status: u32, n: u32) -> PixelResult {
    return PixelResult(vec3<u32>(NAN_BITS), vec3<u32>(NAN_BITS), NAN_BITS, NAN_BITS, status | (n << 8u));
}
