//! The queue between the capture thread and the smoothing thread.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::source::OwnedFrame;
use planish_core::Error;

/// A frame that has arrived from the source.
pub(super) struct Arrived {
    pub(super) frame: OwnedFrame,
    /// Name of the frame, if its source provides one.
    pub(super) name: Option<String>,
    pub(super) since: Instant,
}

/// A frame, or an error with a flag that is true if the error ends the source.
pub(super) type Item = Result<Arrived, (Error, bool)>;

/// Accumulated time that one thread increases and another one reads.
#[derive(Default)]
pub(crate) struct TimeSpent(AtomicU64);

impl TimeSpent {
    /// Adds the time that `work` takes.
    pub(crate) fn on<T>(&self, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.0.fetch_add(start.elapsed().as_nanos() as u64, Ordering::Relaxed);
        result
    }

    pub(crate) fn total(&self) -> Duration {
        Duration::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// Policy for a frame that arrives while another waits.
#[derive(Debug, Clone, Copy)]
pub(super) enum Policy {
    /// The new frame replaces the waiting one.
    NewestWins,
    /// The new frame is queued; while the queue has this length, the source waits.
    Every(usize),
}

pub(super) enum Taken {
    Item(Box<Item>),
    /// No item yet.
    Nothing,
    /// The source has ended, and all items were taken.
    End,
}

pub(super) struct Mailbox {
    policy: Policy,
    state: Mutex<State>,
    changed: Condvar,
    /// Time spent in the source, including the wait for a live frame.
    pub(super) capture_time: TimeSpent,
}

#[derive(Default)]
struct State {
    items: VecDeque<Box<Item>>,
    /// Whether the source has ended.
    ended: bool,
    /// Whether the receiver is gone.
    closed: bool,
    /// Whether the engine is open.
    ready: bool,
    frames: u64,
    dropped: u64,
    dropped_by_source: u64,
    unreadable: u64,
}

impl Mailbox {
    pub(super) fn new(policy: Policy) -> Self {
        Self { policy, state: Mutex::default(), changed: Condvar::new(), capture_time: TimeSpent::default() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // The state is consistent even after a panic.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds an item; waits for room if no frame may be dropped.
    pub(super) fn put(&self, item: Item) {
        let mut state = self.lock();
        match self.policy {
            Policy::NewestWins => {
                // Errors are never replaced.
                let before = state.items.len();
                if item.is_ok() {
                    state.items.retain(|item| item.is_err());
                }
                state.dropped += (before - state.items.len()) as u64;
            }
            Policy::Every(most) => {
                while state.items.len() >= most && !state.closed {
                    state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
        if state.closed {
            return;
        }
        state.frames += u64::from(item.is_ok());
        state.items.push_back(Box::new(item));
        self.changed.notify_all();
    }

    /// Takes the oldest item, waiting at most `patience`; `None` does not wait.
    pub(super) fn take(&self, patience: Option<Duration>) -> Taken {
        let mut state = self.lock();
        if let Some(patience) = patience.filter(|patience| !patience.is_zero()) {
            let waiting = |state: &mut State| state.items.is_empty() && !state.ended;
            let waited = self.changed.wait_timeout_while(state, patience, waiting);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        match state.items.pop_front() {
            Some(item) => {
                // Unreadable frames are counted when taken: those that are never taken are beyond the stream's end.
                state.unreadable += u64::from(item.is_err());
                self.changed.notify_all();
                Taken::Item(item)
            }
            None if state.ended => Taken::End,
            None => Taken::Nothing,
        }
    }

    /// Records that the source has ended.
    pub(super) fn end(&self) {
        self.lock().ended = true;
        self.changed.notify_all();
    }

    /// Closes the receiving end, which wakes the source.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    /// Signals that the engine is open and frames are taken from now on.
    pub(super) fn set_ready(&self) {
        let mut state = self.lock();
        if !state.ready {
            state.ready = true;
            self.changed.notify_all();
        }
    }

    /// Waits until the engine is open or the receiver is gone.
    pub(super) fn wait_ready(&self) {
        let waiting = |state: &mut State| !state.ready && !state.closed;
        drop(self.changed.wait_while(self.lock(), waiting).unwrap_or_else(PoisonError::into_inner));
    }

    pub(super) fn is_closed(&self) -> bool {
        self.lock().closed
    }

    /// Sets the number of frames dropped by the source.
    pub(super) fn set_dropped_by_source(&self, dropped: u64) {
        self.lock().dropped_by_source = dropped;
    }

    /// Returns the numbers of frames received, replaced by newer ones, and unreadable.
    pub(super) fn counts(&self) -> (u64, u64, u64) {
        let state = self.lock();
        let came = state.frames + state.dropped_by_source;
        (came, state.dropped + state.dropped_by_source, state.unreadable)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::thread;

    use super::*;
    use planish_core::{OrganizedCloud, Xyz};

    fn item(number: usize) -> Item {
        let positions: Xyz = [[number as f32; 3]].into_iter().collect();
        let cloud = OrganizedCloud::from_positions(1, 1, positions).unwrap();
        Ok(Arrived { frame: OwnedFrame::Cloud { cloud, timestamp_s: None }, name: None, since: Instant::now() })
    }

    fn number(item: Item) -> usize {
        match item {
            Ok(Arrived { frame: OwnedFrame::Cloud { cloud, .. }, .. }) => cloud.positions().x()[0] as usize,
            _ => panic!("a cloud"),
        }
    }

    /// Returns everything taken while a thread adds `count` items.
    fn taken(policy: Policy, count: usize, put_every: Duration, take_every: Duration) -> (Vec<usize>, (u64, u64, u64)) {
        let mailbox = Arc::new(Mailbox::new(policy));
        let producer = {
            let mailbox = Arc::clone(&mailbox);
            thread::spawn(move || {
                for i in 0..count {
                    mailbox.put(item(i));
                    thread::sleep(put_every);
                }
                mailbox.end();
            })
        };
        let mut numbers = Vec::new();
        loop {
            match mailbox.take(Some(Duration::from_secs(5))) {
                Taken::Item(item) => numbers.push(number(*item)),
                Taken::Nothing => panic!("nothing in 5 s"),
                Taken::End => break,
            }
            thread::sleep(take_every);
        }
        producer.join().unwrap();
        (numbers, mailbox.counts())
    }

    const SHORT: Duration = Duration::from_micros(50);
    const LONG: Duration = Duration::from_millis(2);

    #[test]
    fn every_frame_comes_in_order_whoever_is_slow() {
        for (put, take) in [(SHORT, LONG), (LONG, SHORT), (Duration::ZERO, Duration::ZERO)] {
            let (numbers, counts) = taken(Policy::Every(4), 200, put, take);
            assert!(numbers.into_iter().eq(0..200));
            assert_eq!(counts, (200, 0, 0));
        }
    }

    #[test]
    fn the_newest_wins_and_what_is_dropped_is_counted() {
        for (put, take) in [(SHORT, LONG), (LONG, SHORT), (Duration::ZERO, Duration::ZERO)] {
            let (numbers, (frames, dropped, _)) = taken(Policy::NewestWins, 200, put, take);
            assert!(numbers.is_sorted());
            assert_eq!(numbers.last(), Some(&199));
            assert_eq!(frames, 200);
            assert_eq!(dropped as usize, 200 - numbers.len());
        }
    }

    #[test]
    fn a_source_that_waits_for_room_is_let_go_when_nobody_takes() {
        let mailbox = Arc::new(Mailbox::new(Policy::Every(1)));
        let producer = {
            let mailbox = Arc::clone(&mailbox);
            thread::spawn(move || (0..3).for_each(|i| mailbox.put(item(i))))
        };
        thread::sleep(LONG);
        mailbox.close();
        producer.join().unwrap();
        assert!(mailbox.is_closed());
    }
}
