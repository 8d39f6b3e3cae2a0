//! How far each pixel of a hole is from the first point in each direction.

use rayon::prelude::*;

use super::pixel::DIRECTIONS;

/// No point in a direction, or one farther away than this.
pub(super) const NONE: u8 = u8::MAX;

/// Steps from each pixel to the first point in each of the eight directions; 0 for points.
#[derive(Default)]
pub(super) struct Distances {
    steps: [Vec<u8>; 8],
}

impl Distances {
    /// Finds the distances in an image of which holes have the value 0.
    pub(super) fn find(&mut self, inverse: &[f32], width: usize) {
        let [right, left, down, up, down_right, up_left, up_right, down_left] = &mut self.steps;
        let pixels = inverse.len();
        for steps in [&mut *right, left, down, up, down_right, up_left, up_right, down_left] {
            steps.resize(pixels, NONE);
        }
        let height = pixels / width.max(1);
        let along_rows = || {
            let rows = right.par_chunks_mut(width).zip(left.par_chunks_mut(width)).zip(inverse.par_chunks(width));
            rows.for_each(|((right, left), inverse)| {
                let mut last = NONE;
                for (steps, inverse) in left.iter_mut().zip(inverse) {
                    last = if *inverse == 0.0 { last.saturating_add(1) } else { 0 };
                    *steps = last;
                }
                last = NONE;
                for (steps, inverse) in right.iter_mut().zip(inverse).rev() {
                    last = if *inverse == 0.0 { last.saturating_add(1) } else { 0 };
                    *steps = last;
                }
            });
        };
        // Each row follows from the one before it, downwards and upwards.
        let (upper, lower) = ([up, up_left, up_right], [down, down_left, down_right]);
        let downwards =
            || upper.into_iter().zip([0, -1, 1]).for_each(|(steps, x)| sweep(steps, inverse, width, x, 0..height, -1));
        let upwards = || {
            for (steps, x) in lower.into_iter().zip([0, -1, 1]) {
                sweep(steps, inverse, width, x, (0..height).rev(), 1);
            }
        };
        rayon::join(along_rows, || rayon::join(downwards, upwards));
    }

    /// Returns the steps from a pixel in each of [`DIRECTIONS`].
    pub(super) fn at(&self, i: usize) -> [u8; DIRECTIONS.len()] {
        std::array::from_fn(|k| self.steps[k][i])
    }
}

/// Follows one direction through the rows in an order in which the row towards it is done first.
fn sweep(steps: &mut [u8], inverse: &[f32], width: usize, x: isize, rows: impl Iterator<Item = usize>, towards: isize) {
    let mut before = vec![NONE; width];
    for (k, v) in rows.enumerate() {
        if k > 0 {
            let last = v.wrapping_add_signed(towards) * width;
            let last = &steps[last..last + width];
            // Shifted by a column; pixels outside the image count as holes.
            match x {
                0 => before.copy_from_slice(last),
                1 => {
                    before[..width - 1].copy_from_slice(&last[1..]);
                    before[width - 1] = NONE;
                }
                _ => {
                    before[1..].copy_from_slice(&last[..width - 1]);
                    before[0] = NONE;
                }
            }
        }
        let row = v * width..(v + 1) * width;
        for ((steps, before), inverse) in steps[row.clone()].iter_mut().zip(&before).zip(&inverse[row]) {
            *steps = if *inverse == 0.0 { before.saturating_add(1) } else { 0 };
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
        distances.find(&inverse, width);
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
