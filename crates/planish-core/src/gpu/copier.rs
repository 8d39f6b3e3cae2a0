//! The thread that waits for the frames in flight on a queue and copies out their results, so that the submitting
//! thread does not have to.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{self, JoinHandle};

use super::device::GpuDevice;
use super::flight::Flight;
use super::view::MappedView;
use crate::error::EngineError;
use crate::smoothed::Smoothed;
use crate::threads::Threads;
use crate::timings::FrameTimings;

/// Number of threads that copy the channels of the points in parallel; one thread is slower than the bus.
const COPY_THREADS: usize = 3;

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
        let pool = Threads::open(Some(COPY_THREADS))?;
        let work = move || {
            for job in queue {
                let Job { flight, mut buffer, done } = *job;
                let result = MappedView::of(flight).map(|view| {
                    pool.install(|| view.copy_frame_to(0, &mut buffer));
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
    pub(super) fn wait(self, gpu: &GpuDevice) -> CopyResult {
        self.0.recv().unwrap_or_else(|_| Err(gpu.failed("the thread that copies results has ended")))
    }
}
