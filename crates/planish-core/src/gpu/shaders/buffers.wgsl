// The buffers that the kernels read and write as words (layout.rs).

struct Batch {
    width: u32,
    height: u32,
    // Distance between input frames in words.
    input_words: u32,
    // Distance between results in words.
    output_words: u32,
}

@group(0) @binding(0) var<uniform> batch: Batch;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
