// The buffers that the kernels read and write, by the word (layout.rs).
//
// Points that are not finite or outside the image are NO_POINT in every coordinate: a finite number so far away that no
// radius reaches it. Vulkan lets shaders assume that NaN never occurs, so they never compute with it; finiteness is
// read from the bits.

struct Batch {
    width: u32,
    height: u32,
    // Distance between frames.
    input_words: u32,
    output_words: u32,
}

@group(0) @binding(0) var<uniform> batch: Batch;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

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
