//! The thread that waits for the frames in flight on a queue and copies out their results, so that the submitting
//! thread does not have to.

use std::hint::spin_loop;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use super::device::GpuDevice;
use super::flight::Flight;
use super::view::MappedView;
use crate::error::EngineError;
use crate::smoothed::Smoothed;
use crate::threads::Threads;
use crate::timings::FrameTimings;

/// Number of threads that help the copying thread, which alone is slower than the bus.
const HELPERS: usize = 3;

type CopyResult = Result<(Smoothed, Option<FrameTimings>), EngineError>;

struct Job {
    flight: Flight,
    buffer: Smoothed,
    done: Sender<CopyResult>,
}

/// The copying thread. Dropping it waits for the queued jobs.
pub(super) struct Copier {
    /// The job queue. It is dropped before the thread is joined, so that the thread ends.
    jobs: Option<Sender<Box<Job>>>,
    thread: Option<JoinHandle<()>>,
}

/// A result that is being copied.
pub(super) struct Copied(Receiver<CopyResult>);

impl Copier {
    pub(super) fn start() -> Result<Self, EngineError> {
        let (jobs, queue) = channel::<Box<Job>>();
        // The thread has its own pool: all workers of rayon's global pool may be blocked, one of them waiting for
        // this copy.
        let pool = Threads::open(Some(HELPERS))?;
        let work = move || {
            for job in queue {
                let Job { flight, mut buffer, done } = *job;
                let result = MappedView::of(flight).map(|view| {
                    view.copy_frame_to(0, &mut buffer, &pool);
                    (buffer, view.timings())
                });
                // If the smoother was dropped, the receiver is gone.
                let _ = done.send(result);
            }
        };
        let failed = |error: std::io::Error| EngineError::Threads { threads: 1, reason: error.to_string() };
        let thread = thread::Builder::new().name("planish-copy".into()).spawn(work).map_err(failed)?;
        Ok(Self { jobs: Some(jobs), thread: Some(thread) })
    }

    /// Copies the result of a submission into a buffer when it is ready.
    pub(super) fn copy(&self, flight: Flight, buffer: Smoothed) -> Copied {
        let (done, result) = channel();
        // Without the thread nothing is sent, and waiting for the result reports the error.
        if let Some(jobs) = &self.jobs {
            let _ = jobs.send(Box::new(Job { flight, buffer, done }));
        }
        Copied(result)
    }
}

impl Drop for Copier {
    fn drop(&mut self) {
        self.jobs = None;
        // A thread that panicked has nothing left to do.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

impl Copied {
    /// Waits for the copy.
    pub(super) fn wait(self, gpu: &GpuDevice) -> CopyResult {
        let spin_until = Instant::now() + gpu.spin;
        let received = loop {
            match self.0.try_recv() {
                Ok(result) => break Some(result),
                Err(TryRecvError::Empty) if Instant::now() < spin_until => spin_loop(),
                _ => break self.0.recv().ok(),
            }
        };
        received.unwrap_or_else(|| Err(gpu.failed("the thread that copies results has ended")))
    }
}
