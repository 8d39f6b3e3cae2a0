//! Tasks of a few rows each: rows are split in half recursively until few are left.

use std::ops::RangeInclusive;

use crate::threads::ONE_THREAD;

/// Number of rows per task: enough to make its overhead negligible and to find most candidates in the core's cache,
/// and few enough to keep many threads evenly busy.
const ROWS_PER_TASK: RangeInclusive<usize> = 4..=8;

/// Number of tasks per thread, if there are enough rows.
const TASKS_PER_THREAD: usize = 8;

/// Rows that can be split into two parts.
pub(super) trait SplitRows: Send + Sized {
    fn count(&self) -> usize;

    /// Splits into the first `rows` rows and the rest.
    fn split_at(self, rows: usize) -> (Self, Self);
}

/// Calls `work` on all rows; if `parallel`, on a few rows at a time, on the current thread pool.
pub(super) fn run_on_rows<R: SplitRows>(rows: R, parallel: bool, work: &(impl Fn(R) + Sync)) {
    if ONE_THREAD || !parallel {
        work(rows);
        return;
    }
    let tasks = TASKS_PER_THREAD * rayon::current_num_threads();
    halve(rows.count().div_ceil(tasks).clamp(*ROWS_PER_TASK.start(), *ROWS_PER_TASK.end()), rows, work);
}

/// Calls `work` on at most `most` rows at a time, in parallel.
pub(super) fn halve<R: SplitRows>(most: usize, rows: R, work: &(impl Fn(R) + Sync)) {
    if ONE_THREAD || rows.count() <= most {
        work(rows);
        return;
    }
    let half = rows.count() / 2;
    let (upper, lower) = rows.split_at(half);
    rayon::join(|| halve(most, upper, work), || halve(most, lower, work));
}
