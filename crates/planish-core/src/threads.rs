//! The thread pool for parallel work: the process-wide pool, or one of a given size.

use std::sync::Arc;
use std::thread;

use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::EngineError;

/// True on WebAssembly, which has only the calling thread. Web pages should not have to load code for several threads.
pub(crate) const ONE_THREAD: bool = cfg!(target_family = "wasm");

/// Maximum number of threads in a pool. More threads than any machine has cores would take minutes to start.
const MAX_THREADS: usize = 1024;

/// Starts the threads shared by all parallel work of this process, unless they are already running: one per core, or
/// the number in the environment variable `RAYON_NUM_THREADS`.
///
/// Without this call, the first parallel work starts the threads, and panics if the system allows no more threads.
///
/// # Errors
/// If the system allows no more threads.
pub fn start_shared_threads() -> Result<(), EngineError> {
    // Not compiled for WebAssembly, so that web pages need not load this code.
    #[cfg(not(target_family = "wasm"))]
    if let Err(error) = ThreadPoolBuilder::new().build_global()
        && let Some(reason) = std::error::Error::source(&error)
    {
        // An error without a source means that the threads are already running.
        let threads = thread::available_parallelism().map_or(1, usize::from);
        return Err(EngineError::Threads { threads, reason: reason.to_string() });
    }
    Ok(())
}

/// Runs `work` for each item on a new thread, or on the calling thread if the system allows no more threads. If a new
/// thread panics, the result for its item is an error.
pub(crate) fn on_a_thread_each<T: Send, I: Copy + Send>(
    items: impl IntoIterator<Item = I>,
    work: impl Fn(I) -> T + Sync,
) -> Vec<thread::Result<T>> {
    if ONE_THREAD {
        return items.into_iter().map(|item| Ok(work(item))).collect();
    }
    let work = &work;
    thread::scope(|scope| {
        let start = |item| thread::Builder::new().spawn_scoped(scope, move || work(item)).map_err(|_| item);
        let started: Vec<_> = items.into_iter().map(start).collect();
        started.into_iter().map(|thread| thread.map_or_else(|item| Ok(work(item)), |thread| thread.join())).collect()
    })
}

/// A pool of threads; by default rayon's global one.
#[derive(Clone, Default)]
pub struct Threads(Option<Arc<ThreadPool>>);

impl Threads {
    /// Opens a pool with this number of threads, or the shared pool of the process ([`start_shared_threads`]) if
    /// `None`.
    pub fn open(threads: Option<usize>) -> Result<Self, EngineError> {
        let Some(threads) = threads else { return start_shared_threads().map(|()| Self(None)) };
        // On WebAssembly, Rayon's global pool works on the calling thread.
        if ONE_THREAD {
            return Ok(Self(None));
        }
        if threads > MAX_THREADS {
            return Err(EngineError::Threads { threads, reason: format!("at most {MAX_THREADS} are allowed") });
        }
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("planish-{i}"))
            .build()
            .map_err(|error| EngineError::Threads { threads, reason: error.to_string() })?;
        Ok(Self(Some(Arc::new(pool))))
    }

    /// Runs `work` on this pool while the calling thread runs `here`.
    pub fn beside<'w, T>(&self, work: impl FnOnce() + Send + 'w, here: impl FnOnce() -> T) -> T {
        let both = |scope: &rayon::Scope<'w>| {
            scope.spawn(|_| work());
            here()
        };
        match &self.0 {
            Some(pool) => pool.in_place_scope(both),
            None => rayon::in_place_scope(both),
        }
    }

    /// Runs `work` on the calling thread, and on up to `helpers` threads of this pool.
    pub fn beside_several<'w>(&self, helpers: usize, work: &'w (impl Fn() + Sync)) {
        if ONE_THREAD {
            return work();
        }
        let threads = self.0.as_ref().map_or_else(rayon::current_num_threads, |pool| pool.current_num_threads());
        let all = |scope: &rayon::Scope<'w>| {
            (0..helpers.min(threads)).for_each(|_| scope.spawn(move |_| work()));
            work();
        };
        match &self.0 {
            Some(pool) => pool.in_place_scope(all),
            None => rayon::in_place_scope(all),
        }
    }

    /// Runs `work` with this pool for its parallel iterators.
    pub fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        match &self.0 {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }
}
