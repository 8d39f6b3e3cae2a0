//! Rows dealt out among threads: halved until they are few.

/// Rows of one task: enough that a task costs nothing beside them, few enough that sixteen threads end together.
const ROWS_A_TASK: usize = 4;

/// Some rows of something, which can be split.
pub(super) trait Halves: Send + Sized {
    fn count(&self) -> usize;

    /// The first so many rows, and the rest.
    fn split_at(self, rows: usize) -> (Self, Self);
}

/// `work` on all rows; if `parallel`, a few at a time, on the threads of the pool that it is called in.
pub(super) fn over<R: Halves>(rows: R, parallel: bool, work: &(impl Fn(R) + Sync)) {
    if !parallel || rows.count() <= ROWS_A_TASK {
        work(rows);
        return;
    }
    let half = rows.count() / 2;
    let (upper, lower) = rows.split_at(half);
    rayon::join(|| over(upper, parallel, work), || over(lower, parallel, work));
}
