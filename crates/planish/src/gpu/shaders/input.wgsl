// The frame as the kernel reads it: depth or points, one struct of words a frame (layout.rs).
//
// Stage: copy or deproject (docs/method.md, section 1), in metres. What is not finite, or outside the image, becomes NO_POINT
// in every coordinate: a finite number so far away that no radius reaches it. Shaders need not keep NaN by the rules of
// Vulkan, so none is ever computed with; finiteness is read from the bits.
// What depth becomes is finite, since Camera::validate keeps rays and units within bounds.

struct Batch {
    width: u32,
    height: u32,
    // From one frame to the next.
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

fn is_finite(bits: u32) -> bool {
    return (bits & 0x7f800000u) != 0x7f800000u;
}

fn point_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return vec3<f32>(NO_POINT);
    }
    let base = frame * batch.input_words + HEADER_WORDS;
    let pixel = u32(y) * batch.width + u32(x);
    if IS_DEPTH {
        let samples = base + batch.width + batch.height;
        let raw = (input[samples + (pixel >> 1u)] >> ((pixel & 1u) * 16u)) & 0xffffu;
        if raw == 0u || raw == SATURATED_DEPTH {
            return vec3<f32>(NO_POINT);
        }
        let z = f32(raw) * header(frame, METRES_PER_UNIT);
        let ray_x = bitcast<f32>(input[base + u32(x)]);
        let ray_y = bitcast<f32>(input[base + batch.width + u32(y)]);
        return vec3<f32>(ray_x * z, ray_y * z, z);
    }
    let pixels = batch.width * batch.height;
    let samples = base + batch.width + batch.height;
    let bits = vec3<u32>(input[samples + pixel], input[samples + pixels + pixel], input[samples + 2u * pixels + pixel]);
    if is_finite(bits.x) && is_finite(bits.y) && is_finite(bits.z) {
        return bitcast<vec3<f32>>(bits);
    }
    return vec3<f32>(NO_POINT);
}
