//! The worker threads of the program, and what threads share.

use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::{Result, anyhow, ensure};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

/// The most worker threads per core. More would only take turns.
const MOST_THREADS: usize = 16;

/// Starts rayon's global pool, which the whole program uses, with this number of worker threads (0: one per core).
///
/// # Errors
/// Fails if the number is too large, if the system refuses the threads, or on a second call.
pub fn start_threads(threads: usize) -> Result<()> {
    start(threads, ThreadPoolBuilder::build_global)
}

/// A pool of its own with this number of worker threads (0: one per core), in which a caller can install work.
///
/// # Errors
/// Fails if the number is too large, or if the system refuses the threads.
pub fn thread_pool(threads: usize) -> Result<ThreadPool> {
    start(threads, ThreadPoolBuilder::build)
}

fn start<T>(
    threads: usize,
    build: fn(ThreadPoolBuilder) -> Result<T, ThreadPoolBuildError>,
) -> Result<T> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let most = MOST_THREADS * cores;
    ensure!(
        threads <= most,
        "{threads} worker threads: at most {most} on this machine, {MOST_THREADS} per core"
    );
    // The text of this error already contains the text of its source.
    let started = build(ThreadPoolBuilder::new().num_threads(threads));
    started.map_err(|error| anyhow!("cannot start {threads} worker threads: {error}"))
}

/// What threads share, for one of them at a time. It must be consistent even where a thread that had it panics.
pub fn locked<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}
