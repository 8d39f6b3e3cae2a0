// The labels of holes. Labels only become smaller, so searches end.

// Returns the first pixel of a hole, and shortens the path to it.
fn first_pixel(frame: u32, from_pixel: u32) -> u32 {
    var at = from_pixel;
    loop {
        let parent = atomicLoad(&holes[hole_word(frame, LABEL, at)]);
        if parent == at {
            return at;
        }
        let next = atomicLoad(&holes[hole_word(frame, LABEL, parent)]);
        if next != parent {
            atomicMin(&holes[hole_word(frame, LABEL, at)], next);
        }
        at = next;
    }
    return at;
}

// Returns true if a hole has two surfaces at its rim.
fn has_step(frame: u32, hole: u32) -> bool {
    return (atomicLoad(&holes[hole_word(frame, TALLY, hole)]) & HAS_STEP) != 0u;
}
