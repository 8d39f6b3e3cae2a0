//! Measures the distances from each hole pixel to the first point in each direction.

use rayon::prelude::*;

use super::constants::DIRECTIONS;

/// Value for a direction without a point within 254 steps.
pub(super) const NONE: u8 = u8::MAX;

/// Numbers of steps from each pixel to the first point in each of the eight directions; 0 for points.
#[derive(Default)]
pub(super) struct Distances {
    steps: [Vec<u8>; 8],
    /// All bits set for holes, none for points.
    holes: Vec<u8>,
}

impl Distances {
    /// Finds the distances in an image whose holes have the value 0.
    pub(super) fn find(&mut self, inverse: &[f32], (width, height): (usize, usize)) {
        let Self { steps, holes } = self;
        steps.iter_mut().chain([&mut *holes]).for_each(|buffer| buffer.resize(inverse.len(), NONE));
        let [right, left, down, up, down_right, up_left, up_right, down_left] = steps;
        let rows = right.par_chunks_mut(width).zip(left.par_chunks_mut(width));
        rows.zip(holes.par_chunks_mut(width)).zip(inverse.par_chunks(width)).for_each(
            |(((right, left), holes), inverse)| {
                holes
                    .iter_mut()
                    .zip(inverse)
                    .for_each(|(hole, inverse)| *hole = if *inverse == 0.0 { NONE } else { 0 });
                let next = |last: &mut u8, hole: &u8| {
                    *last = last.saturating_add(1) & hole;
                    Some(*last)
                };
                let leftmost = holes.iter().scan(NONE, next);
                left.iter_mut().zip(leftmost).for_each(|(steps, last)| *steps = last);
                let rightmost = holes.iter().rev().scan(NONE, next);
                right.iter_mut().rev().zip(rightmost).for_each(|(steps, last)| *steps = last);
            },
        );
        // Each row follows from the one before it, downwards and upwards.
        let downwards = || sweep([up, up_left, up_right], holes, width, 0..height);
        let upwards = || sweep([down, down_left, down_right], holes, width, (0..height).rev());
        rayon::join(downwards, upwards);
    }

    /// Returns the number of steps from a pixel to the first point in each of [`DIRECTIONS`].
    pub(super) fn at(&self, i: usize) -> [u8; DIRECTIONS.len()] {
        std::array::from_fn(|k| self.steps[k][i])
    }
}

/// Finds the numbers of steps in the three directions towards the previous row: straight, to the left and to the
/// right. `rows` is the order of the rows, downwards or upwards.
fn sweep(directions: [&mut Vec<u8>; 3], holes: &[u8], width: usize, rows: impl Iterator<Item = usize> + Clone) {
    for (steps, x) in directions.into_iter().zip([0, -1, 1]) {
        // Padded by a pixel on both sides: pixels outside the image count as holes.
        let mut before = vec![NONE; width + 2];
        for v in rows.clone() {
            let row = v * width..(v + 1) * width;
            let shifted = &before[1usize.wrapping_add_signed(x)..][..width];
            for ((steps, before), hole) in steps[row.clone()].iter_mut().zip(shifted).zip(&holes[row.clone()]) {
                *steps = before.saturating_add(1) & hole;
            }
            before[1..=width].copy_from_slice(&steps[row]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_lead_to_the_first_point() {
        let (width, height) = (13, 9);
        let inverse: Vec<f32> = (0..width * height).map(|i| f32::from(u8::from(i * i % 11 < 2))).collect();
        let mut distances = Distances::default();
        distances.find(&inverse, (width, height));
        for i in 0..width * height {
            for (k, [x, y]) in DIRECTIONS.into_iter().enumerate() {
                let at = |steps: isize| {
                    let (u, v) = ((i % width) as isize + x * steps, (i / width) as isize + y * steps);
                    let is_inside = (0..width as isize).contains(&u) && (0..height as isize).contains(&v);
                    is_inside.then(|| inverse[v as usize * width + u as usize] != 0.0)
                };
                let expected = (0..).map_while(|steps| at(steps).map(|is_point| (steps, is_point)));
                let expected = expected.into_iter().find(|(_, is_point)| *is_point);
                let found = Some(distances.at(i)[k]).filter(|steps| *steps != NONE).map(isize::from);
                assert_eq!(found, expected.map(|(steps, _)| steps), "pixel {i}, direction {k}");
            }
        }
    }
}
