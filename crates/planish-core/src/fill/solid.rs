//! Makes the filled parts of holes solid, because pixels are filled independently of their neighbours.

use rayon::prelude::*;

use super::constants::{DIRECTIONS, LEAST_FILLED, LEAST_NEIGHBOURS, LEAST_SHARE, LEAST_STRIPE_PX, ROUNDS};
use super::labels::Labels;
use super::pixel::{Holes, Patch};

/// Discards the patches of holes that could be filled only in part although their rim is one surface.
pub(super) fn keep_whole_holes(rows: &mut [Vec<Patch>], labels: &Labels) {
    let hole_of = |u: usize, v: usize| Some(labels.hole((u, v))).filter(|&hole| !labels.has_step(hole));
    let sizes = labels.sizes();
    let mut filled = vec![0; sizes.len()];
    for (v, row) in rows.iter().enumerate() {
        row.iter().filter_map(|patch| hole_of(patch.u, v)).for_each(|hole| filled[hole] += 1);
    }
    let is_kept = |hole: usize| filled[hole] as f64 >= LEAST_SHARE * sizes[hole] as f64;
    rows.par_iter_mut().enumerate().for_each(|(v, row)| row.retain(|patch| hole_of(patch.u, v).is_none_or(is_kept)));
}

/// Removes narrow filled stripes, and closes gaps.
pub(super) fn make_solid(holes: &Holes<'_>, rows: &mut [Vec<Patch>]) {
    let run_px = |v: usize, patch: &Patch, [x, y]: [isize; 2]| {
        let is_there = |k: &isize| Neighbour::of(holes, rows, (patch.u, v), [k * x, k * y]).is_some();
        (1..LEAST_STRIPE_PX as isize).take_while(is_there).count()
    };
    let is_solid = |v: usize, patch: &Patch| {
        [[[1, 0], [-1, 0]], [[0, 1], [0, -1]]]
            .iter()
            .all(|axis| 1 + axis.iter().map(|direction| run_px(v, patch, *direction)).sum::<usize>() >= LEAST_STRIPE_PX)
    };
    let narrow = |v: usize| rows[v].iter().map(|patch| !is_solid(v, patch)).collect::<Vec<bool>>();
    let narrow: Vec<Vec<bool>> = (0..rows.len()).into_par_iter().map(narrow).collect();
    rows.par_iter_mut().zip(narrow).for_each(|(row, narrow)| {
        let mut narrow = narrow.into_iter();
        row.retain(|_| narrow.next() != Some(true));
    });
    for _ in 0..ROUNDS {
        let gaps: Vec<Vec<Patch>> = (0..rows.len()).into_par_iter().map(|v| closed_gaps(holes, rows, v)).collect();
        for (row, gaps) in rows.iter_mut().zip(gaps).filter(|(_, gaps)| !gaps.is_empty()) {
            row.extend(gaps);
            row.sort_unstable_by_key(|patch| patch.u);
        }
    }
}

/// A pixel that is not a hole.
enum Neighbour<'a> {
    Measured(f32),
    Filled(&'a Patch),
}

impl<'a> Neighbour<'a> {
    fn of(holes: &Holes<'_>, rows: &'a [Vec<Patch>], (u, v): (usize, usize), [x, y]: [isize; 2]) -> Option<Self> {
        let (u, v) = (u.wrapping_add_signed(x), v.wrapping_add_signed(y));
        if u >= holes.image.shape.0 || v >= holes.image.shape.1 {
            return None;
        }
        match holes.image.inverse[v * holes.image.shape.0 + u] {
            0.0 => Some(Self::Filled(&rows[v][rows[v].binary_search_by_key(&u, |patch| patch.u).ok()?])),
            inverse => Some(Self::Measured(inverse)),
        }
    }
}

/// Returns the patches that close gaps in a row, where surrounding pixels are filled.
fn closed_gaps(holes: &Holes<'_>, rows: &[Vec<Patch>], v: usize) -> Vec<Patch> {
    let beside = rows[v.saturating_sub(1)..(v + 2).min(rows.len())].iter().flatten();
    let mut candidates: Vec<usize> = beside.flat_map(|patch| [patch.u.wrapping_sub(1), patch.u, patch.u + 1]).collect();
    candidates.sort_unstable();
    candidates.dedup();
    let width = holes.image.shape.0;
    let is_gap = |&u: &usize| {
        u < width
            && holes.image.inverse[v * width + u] == 0.0
            && rows[v].binary_search_by_key(&u, |patch| patch.u).is_err()
    };
    candidates.into_iter().filter(is_gap).filter_map(|u| close(holes, rows, (u, v))).collect()
}

/// Returns a patch that fills a pixel with the mean of its filled neighbours' surfaces; `None` unless enough
/// neighbours are on one surface.
fn close(holes: &Holes<'_>, rows: &[Vec<Patch>], at: (usize, usize)) -> Option<Patch> {
    let (mut neighbours, mut filled) = (0, Vec::with_capacity(8));
    let (mut least, mut most) = (f32::INFINITY, 0.0f32);
    for direction in DIRECTIONS {
        let inverse = match Neighbour::of(holes, rows, at, direction) {
            None => continue,
            Some(Neighbour::Measured(inverse)) => inverse,
            Some(Neighbour::Filled(patch)) => {
                filled.push((patch, direction));
                patch.inverse as f32
            }
        };
        neighbours += 1;
        (least, most) = (least.min(inverse), most.max(inverse));
    }
    if neighbours < LEAST_NEIGHBOURS || filled.len() < LEAST_FILLED || holes.image.is_step(least, most) {
        return None;
    }
    let mean = |value: &dyn Fn(&Patch, [f64; 2]) -> f64| {
        let sum: f64 = filled.iter().map(|(patch, direction)| value(patch, direction.map(|d| d as f64))).sum();
        sum / filled.len() as f64
    };
    let inverse = mean(&|patch, [x, y]| patch.inverse - x * patch.slopes[0] - y * patch.slopes[1]);
    let slopes = [0, 1].map(|axis| mean(&|patch, _| patch.slopes[axis]));
    let sigma_m = filled.iter().map(|(patch, _)| patch.sigma_m).fold(0.0, f64::max);
    let (first, _) = filled.first()?;
    holes.is_possible(at, inverse).then(|| Patch { u: at.0, inverse, slopes, sigma_m, ..(*first).clone() })
}
