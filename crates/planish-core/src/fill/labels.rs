//! Finds connected holes, and determines which of them have two surfaces at their rim.

use std::ops::Range;

use rayon::prelude::*;

use super::constants::RIM_PX;
use super::image::Image;

/// A run of adjacent hole pixels in a row.
#[derive(Debug, Clone)]
struct Run {
    columns: Range<usize>,
    /// An earlier run of the same hole, or the run itself if it is the first.
    parent: usize,
    /// True if the hole has two surfaces at its rim; set only in the hole's first run.
    has_step: bool,
}

/// The holes of a frame: connected pixels without points. Pixels that share only a corner are connected too.
#[derive(Default)]
pub(super) struct Labels {
    runs: Vec<Run>,
    /// Index of the first run of each row, followed by the number of runs.
    rows: Vec<usize>,
}

impl Labels {
    /// Finds the holes.
    pub(super) fn find(&mut self, image: &Image<'_>) {
        let (width, height) = image.shape;
        self.runs.clear();
        self.rows.clear();
        for v in 0..height {
            self.rows.push(self.runs.len());
            let row = &image.inverse[v * width..(v + 1) * width];
            let mut u = 0;
            while let Some(start) = row[u..].iter().position(|inverse| *inverse == 0.0).map(|by| u + by) {
                let end = row[start..].iter().position(|inverse| *inverse != 0.0).map_or(width, |by| start + by);
                self.runs.push(Run { columns: start..end, parent: self.runs.len(), has_step: false });
                u = end;
            }
            if v > 0 {
                self.join_rows(self.rows[v - 1]..self.rows[v]);
            }
        }
        self.rows.push(self.runs.len());
        let labels = &*self;
        let at_step = |v: usize| (labels.rows[v]..labels.rows[v + 1]).filter(move |&k| labels.is_at_step(image, v, k));
        let at_step: Vec<usize> = (0..height).into_par_iter().flat_map_iter(at_step).collect();
        for k in at_step {
            let first = self.first(k);
            self.runs[first].has_step = true;
        }
    }

    /// Joins the runs of the last row with touching runs of the previous row.
    fn join_rows(&mut self, before: Range<usize>) {
        let mut above = before.start;
        for k in before.end..self.runs.len() {
            let columns = self.runs[k].columns.clone();
            // Runs that share only a corner touch too.
            while above < before.end && self.runs[above].columns.end < columns.start {
                above += 1;
            }
            let mut other = above;
            while other < before.end && self.runs[other].columns.start <= columns.end {
                let (a, b) = (self.first(k), self.first(other));
                self.runs[a.max(b)].parent = a.min(b);
                other += 1;
            }
        }
    }

    fn is_at_step(&self, image: &Image<'_>, v: usize, k: usize) -> bool {
        let (width, height) = image.shape;
        let columns = self.runs[k].columns.clone();
        let is_point = |u: usize, v: usize| image.inverse[v * width + u] != 0.0;
        columns.clone().any(|u| {
            let is_end = u == columns.start || u + 1 == columns.end;
            let is_rim = is_end || (v > 0 && is_point(u, v - 1)) || (v + 1 < height && is_point(u, v + 1));
            is_rim && image.has_step_near((u, v), RIM_PX)
        })
    }

    /// Returns the first run of the hole that contains run `k`.
    fn first(&self, k: usize) -> usize {
        let mut at = k;
        while self.runs[at].parent != at {
            at = self.runs[at].parent;
        }
        at
    }

    /// Returns the hole of a pixel, identified by the index of its first run. The pixel must be in a hole.
    pub(super) fn hole(&self, (u, v): (usize, usize)) -> usize {
        let row = self.rows[v]..self.rows[v + 1];
        let within = self.runs[row.clone()].partition_point(|run| run.columns.end <= u);
        self.first((row.start + within).min(row.end.saturating_sub(1)))
    }

    /// Returns the number of pixels of each hole, at the index of its first run; 0 at the indices of other runs.
    pub(super) fn sizes(&self) -> Vec<usize> {
        let mut sizes = vec![0; self.runs.len()];
        for (k, run) in self.runs.iter().enumerate() {
            sizes[self.first(k)] += run.columns.len();
        }
        sizes
    }

    /// Returns true if a hole has two surfaces at its rim.
    pub(super) fn has_step(&self, hole: usize) -> bool {
        self.runs[hole].has_step
    }

    /// Returns the columns of all hole pixels in a row.
    pub(super) fn columns(&self, v: usize) -> impl Iterator<Item = usize> + '_ {
        self.runs[self.rows[v]..self.rows[v + 1]].iter().flat_map(|run| run.columns.clone())
    }
}
