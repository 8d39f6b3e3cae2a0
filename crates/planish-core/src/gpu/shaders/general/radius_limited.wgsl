// Returns the point's radius, limited to a multiple of the mean radius around it, since the radius of an isolated
// point is much larger.
fn radius_at(place: u32, p: vec3<f32>) -> f32 {
    let radius = radii[place];
    let slope = -1.0 / max(radius * radius, MIN_POSITIVE);
    var total = 0.0;
    var sum = 0.0;
    var walk = new_walk();
    while next_leaf(&walk, p, radius * radius) {
        for (var other = LEAF * walk.leaf; other < LEAF * (walk.leaf + 1u); other++) {
            let squared = square(positions[other].xyz - p);
            // The point itself does not count.
            let weight = select(0.0, max(fma(squared, slope, 1.0), 0.0), squared > 0.0);
            if weight > 0.0 {
                total += weight;
                sum = fma(weight, radii[other], sum);
            }
        }
    }
    check_done(walk);
    return select(radius, min(radius, MAX_RADIUS_RATIO * sum / max(total, MIN_POSITIVE)), total > 0.0);
}
