//! The worker threads of the program.

use anyhow::{Result, anyhow, ensure};

/// The most worker threads per core; more would only take turns.
const MOST_THREADS: usize = 16;

/// Starts rayon's global pool, which the whole program uses, with this number of worker threads (0: one per core).
///
/// # Errors
/// Fails if the number is too large, if the system refuses the threads, or on a second call.
pub fn start_threads(threads: usize) -> Result<()> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let most = MOST_THREADS * cores;
    ensure!(
        threads <= most,
        "{threads} worker threads: at most {most} on this machine, {MOST_THREADS} per core; set --threads"
    );
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    // The text of this error already contains that of its source.
    pool.build_global().map_err(|error| anyhow!("cannot start {threads} worker threads: {error}"))
}
