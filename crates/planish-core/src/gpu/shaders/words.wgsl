// Helpers that kernels share: fields of the input's header, and a test for finite numbers by their bits. They need
// the uniform `batch`.
//
// Points outside the image and points with a non-finite coordinate are NO_POINT in every coordinate, a finite number
// beyond every radius. Vulkan lets shaders assume that NaN never occurs, so they never compute with it;
// finiteness is read from the bits.

const NO_POINT: f32 = 4.0e18;

fn header(frame: u32, field: u32) -> f32 {
    return bitcast<f32>(input[frame * batch.input_words + field]);
}

fn header_bits(frame: u32, field: u32) -> u32 {
    return input[frame * batch.input_words + field];
}

fn is_finite(bits: u32) -> bool {
    return (bits & 0x7f800000u) != 0x7f800000u;
}

fn pixels() -> u32 {
    return batch.width * batch.height;
}
