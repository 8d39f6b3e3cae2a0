//! Rows dealt out among threads: halved until they are few.

use std::ops::RangeInclusive;

/// Rows of one task: enough that a task costs nothing beside them, and that its rows find most candidates in its core's cache;
/// few enough that many threads end together.
const ROWS_A_TASK: RangeInclusive<usize> = 4..=8;

/// Tasks for each thread, where there are rows enough.
const TASKS_A_THREAD: usize = 8;

/// Some rows of something, which can be split.
pub(super) trait Halves: Send + Sized {
    fn count(&self) -> usize;

    /// The first so many rows, and the rest.
    fn split_at(self, rows: usize) -> (Self, Self);
}

/// `work` on all rows; if `parallel`, a few at a time, on the threads of the pool that it is called in.
pub(super) fn over<R: Halves>(rows: R, parallel: bool, work: &(impl Fn(R) + Sync)) {
    if !parallel {
        work(rows);
        return;
    }
    let tasks = TASKS_A_THREAD * rayon::current_num_threads();
    halve(rows.count().div_ceil(tasks).clamp(*ROWS_A_TASK.start(), *ROWS_A_TASK.end()), rows, work);
}

fn halve<R: Halves>(most: usize, rows: R, work: &(impl Fn(R) + Sync)) {
    if rows.count() <= most {
        work(rows);
        return;
    }
    let half = rows.count() / 2;
    let (upper, lower) = rows.split_at(half);
    rayon::join(|| halve(most, upper, work), || halve(most, lower, work));
}
