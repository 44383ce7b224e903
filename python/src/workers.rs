//! Worker threads that survive a fork, and long work that Ctrl-C interrupts.

use std::process;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use rayon::ThreadPool;
use shadow_repose::os;

use crate::errors::{panicked, refused};

/// How long Ctrl-C waits at most.
const PATIENCE: Duration = Duration::from_millis(50);

/// A pool of worker threads of one process.
pub(crate) struct Workers {
    threads: usize,
    /// The process that started them. A fork of it has none of its threads.
    pool: Option<(u32, ThreadPool)>,
}

impl Workers {
    /// Prepares a pool with this number of threads (0: one per core).
    pub(crate) fn new(threads: usize) -> Self {
        Self {
            threads,
            pool: None,
        }
    }

    /// The pool of this process, which is started if need be.
    ///
    /// # Errors
    /// Fails if there are too many threads, or if the system refuses them.
    pub(crate) fn pool(&mut self) -> PyResult<&ThreadPool> {
        let forked = self.forget_of_parent();
        let pool = match self.pool.take() {
            Some((_, pool)) => pool,
            None if forked => os::thread_pool(self.threads)
                .map_err(|error| PyRuntimeError::new_err(error.to_string()))?,
            None => os::thread_pool(self.threads).map_err(refused)?,
        };
        Ok(&self.pool.insert((process::id(), pool)).1)
    }

    /// Forgets the threads of a parent process, and returns whether there were any. To drop them would take locks that a thread of the
    /// parent may have held at the fork.
    fn forget_of_parent(&mut self) -> bool {
        self.pool
            .take_if(|(of, _)| *of != process::id())
            .map(std::mem::forget)
            .is_some()
    }

    /// Does long work in the pool, without Python's lock. Ctrl-C sets the flag that the work gets, waits for its end, and is raised.
    ///
    /// # Errors
    /// Fails if the work panics, or with the exception that a signal raises.
    pub(crate) fn long<T: Send>(
        &mut self,
        py: Python,
        work: impl FnOnce(&AtomicBool) -> T + Send,
    ) -> PyResult<T> {
        let pool = self.pool()?;
        let stop = AtomicBool::new(false);
        let (tell, mut told) = mpsc::channel::<()>();
        std::thread::scope(|scope| {
            let running = std::thread::Builder::new().spawn_scoped(scope, || {
                // Dropped at the end, also by a panic.
                let _tell = tell;
                pool.install(|| work(&stop))
            });
            let running = running.map_err(|error| {
                PyRuntimeError::new_err(format!("cannot start a thread: {error}"))
            })?;
            let mut raised = Ok(());
            loop {
                let waited = py.detach(|| {
                    let told = &mut told;
                    told.recv_timeout(PATIENCE)
                });
                if waited != Err(mpsc::RecvTimeoutError::Timeout) {
                    break;
                }
                if raised.is_ok() {
                    raised = py.check_signals();
                    // The work may have set the flag itself.
                    stop.fetch_or(raised.is_err(), Ordering::Relaxed);
                }
            }
            let done = py
                .detach(|| running.join())
                .map_err(|panic| panicked(&*panic));
            raised.and(done)
        })
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.forget_of_parent();
    }
}
