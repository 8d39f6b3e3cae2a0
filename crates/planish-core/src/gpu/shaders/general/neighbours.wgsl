// Sums over the positions within the radius of a position (docs/method.md, sections 4 and 8).

// Maximum number of neighbours; results store it in 24 bits.
const MOST_COUNTED: f32 = 16777215.0;

// Counterpart of a pixel's window; here, only the point is needed.
alias WindowOrigin = u32;

// Returns the squared distance at which the gate reaches zero.
fn reach_squared_of(radius_squared: f32) -> f32 {
    return radius_squared * (1.0 + 0.5 / GATE_FADE);
}

fn sums_of(p: vec3<f32>, radius: f32) -> Sums {
    let gate = gate_of(radius);
    let reach_squared = reach_squared_of(radius * radius);
    var sums: Sums;
    var walk = new_walk();
    while next_leaf(&walk, p, reach_squared) {
        for (var place = LEAF * walk.leaf; place < LEAF * (walk.leaf + 1u); place++) {
            let q = positions[place];
            let offset = q.xyz - p;
            let nearness = unclamped(gate, square(offset));
            let is_neighbour = nearness > 0.0;
            let e = select(vec3<f32>(0.0), offset, is_neighbour);
            let weight = clamp(nearness, 0.0, 1.0) * q.w;
            let weighted = weight * e;
            sums.n += select(0.0, q.w, is_neighbour);
            sums.total += weight;
            sums.e += weighted;
            sums.x_row = fma(vec3<f32>(weighted.x), e, sums.x_row);
            sums.rest = fma(weighted.yyz, e.yzz, sums.rest);
        }
    }
    check_done(walk);
    return sums;
}
