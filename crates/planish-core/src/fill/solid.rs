//! Makes the filled parts of holes solid: neighbouring rows and columns may have decided differently.

use std::collections::HashMap;

use rayon::prelude::*;

use super::labels::Labels;
use super::pixel::{Holes, Patch};

/// A hole with one surface at its rim is filled if this share of its pixels can be.
const LEAST_SHARE: f64 = 0.7;
/// Rounds in which gaps are closed.
const ROUNDS: usize = 2;
/// A gap is closed if it has at least this number of neighbours (of eight) that are not holes, and that were filled.
const LEAST_NEIGHBOURS: usize = 4;
const LEAST_FILLED: usize = 3;
/// Filled stripes that are narrower than this many pixels, between holes, are removed.
const LEAST_PX: usize = 4;

/// Leaves holes as they are of which only parts could be filled, though their rim is one surface.
pub(super) fn keep_whole_holes(rows: &mut [Vec<Patch>], labels: &Labels) {
    let hole_of = |u: usize, v: usize| Some(labels.hole((u, v))).filter(|&hole| !labels.has_step(hole));
    let mut filled: HashMap<usize, usize> = HashMap::new();
    for (v, row) in rows.iter().enumerate() {
        for hole in row.iter().filter_map(|patch| hole_of(patch.u, v)) {
            *filled.entry(hole).or_default() += 1;
        }
    }
    let sizes = labels.sizes();
    filled.retain(|hole, filled| *filled as f64 >= LEAST_SHARE * sizes[*hole] as f64);
    for (v, row) in rows.iter_mut().enumerate() {
        row.retain(|patch| hole_of(patch.u, v).is_none_or(|hole| filled.contains_key(&hole)));
    }
}

/// Removes narrow filled stripes, and closes gaps.
pub(super) fn make_solid(holes: &Holes<'_>, rows: &mut Vec<Vec<Patch>>) {
    let run_px = |v: usize, patch: &Patch, [x, y]: [isize; 2]| {
        let is_there = |k: &isize| Neighbour::of(holes, rows, (patch.u, v), [k * x, k * y]).is_some();
        (1..LEAST_PX as isize).take_while(is_there).count()
    };
    let is_solid = |v: usize, patch: &Patch| {
        [[[1, 0], [-1, 0]], [[0, 1], [0, -1]]]
            .iter()
            .all(|axis| 1 + axis.iter().map(|direction| run_px(v, patch, *direction)).sum::<usize>() >= LEAST_PX)
    };
    let kept = |(v, row): (usize, &Vec<Patch>)| row.iter().filter(|patch| is_solid(v, patch)).cloned().collect();
    *rows = rows.par_iter().enumerate().map(kept).collect();
    for _ in 0..ROUNDS {
        *rows = (0..rows.len()).into_par_iter().map(|v| with_gaps_closed(holes, rows, v)).collect();
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
        if u >= holes.shape.0 || v >= holes.shape.1 {
            return None;
        }
        match holes.inverse[v * holes.shape.0 + u] {
            0.0 => Some(Self::Filled(&rows[v][rows[v].binary_search_by_key(&u, |patch| patch.u).ok()?])),
            inverse => Some(Self::Measured(inverse)),
        }
    }
}

/// Returns a row with pixels added that are between filled ones.
fn with_gaps_closed(holes: &Holes<'_>, rows: &[Vec<Patch>], v: usize) -> Vec<Patch> {
    let beside = rows[v.saturating_sub(1)..(v + 2).min(rows.len())].iter().flatten();
    let mut candidates: Vec<usize> = beside.flat_map(|patch| [patch.u.wrapping_sub(1), patch.u, patch.u + 1]).collect();
    candidates.sort_unstable();
    candidates.dedup();
    let width = holes.shape.0;
    let is_gap = |&u: &usize| {
        u < width && holes.inverse[v * width + u] == 0.0 && rows[v].binary_search_by_key(&u, |patch| patch.u).is_err()
    };
    let closed = candidates.into_iter().filter(is_gap).filter_map(|u| close(holes, rows, (u, v)));
    let mut row: Vec<Patch> = rows[v].iter().cloned().chain(closed).collect();
    row.sort_unstable_by_key(|patch| patch.u);
    row
}

/// Fills a pixel with the mean of its filled neighbours, if all of its neighbours are on one surface.
fn close(holes: &Holes<'_>, rows: &[Vec<Patch>], at: (usize, usize)) -> Option<Patch> {
    let (mut neighbours, mut filled) = (0, Vec::with_capacity(8));
    let (mut least, mut most) = (f32::INFINITY, 0.0f32);
    for direction in super::pixel::DIRECTIONS {
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
    if neighbours < LEAST_NEIGHBOURS || filled.len() < LEAST_FILLED || holes.is_step(least, most) {
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
