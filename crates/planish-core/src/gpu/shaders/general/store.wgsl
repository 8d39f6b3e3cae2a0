// Stores the result of a point: one word per channel, then a word with the status and the number of neighbours.

fn store(i: u32, result: PixelResult) {
    if WANTS_POINTS {
        output[POINTS_CHANNEL * batch.width + i] = result.point.x;
        output[(POINTS_CHANNEL + 1u) * batch.width + i] = result.point.y;
        output[(POINTS_CHANNEL + 2u) * batch.width + i] = result.point.z;
    }
    if WANTS_NORMALS {
        output[NORMALS_CHANNEL * batch.width + i] = result.normal.x;
        output[(NORMALS_CHANNEL + 1u) * batch.width + i] = result.normal.y;
        output[(NORMALS_CHANNEL + 2u) * batch.width + i] = result.normal.z;
    }
    if WANTS_CURVATURE {
        output[CURVATURE_CHANNEL * batch.width + i] = result.curvature;
    }
    if WANTS_STATUS || WANTS_NEIGHBOURS {
        output[CHANNELS * batch.width + i] = result.codes;
    }
}

// Returns the result of a point with too few neighbours.
fn isolated(p: vec3<f32>, n: u32) -> PixelResult {
    if !KEEPS_ISOLATED {
        return no_result(STATUS_TOO_FEW, n);
    }
    var result = no_result(STATUS_ISOLATED, n);
    result.point = bitcast<vec3<u32>>(p);
    return result;
}
