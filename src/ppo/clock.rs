//! Where the threads wait in a gradient step, measured only for a benchmark.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::Instant;

/// The parts of a gradient step. All threads wait for each other at the end of each part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// The weights are arranged for products in bf16.
    Packing,
    /// The samples of each group pass forward and backward through the nets.
    Samples,
    /// The gradients of the groups are added up.
    Sums,
    /// The parameters move.
    Adam,
}

impl Part {
    /// All of them, in order, with their names.
    pub(super) const ALL: [(Self, &str); 4] =
        [(Self::Packing, "packing"), (Self::Samples, "samples"), (Self::Sums, "sums"), (Self::Adam, "adam")];
}

/// A clock of all threads. It stands still until it is started.
#[derive(Debug, Default)]
pub(super) struct Clock {
    runs: AtomicBool,
    /// For each part: nanoseconds from its begin to its end, and the nanoseconds that all threads together worked.
    parts: [[AtomicU64; 2]; Part::ALL.len()],
}

impl Clock {
    /// Starts the clock.
    pub(super) fn start(&self) {
        self.runs.store(true, Relaxed);
    }

    /// Returns the seconds of each part, and the seconds that all threads together worked in it.
    pub(super) fn seconds(&self) -> [[f64; 2]; Part::ALL.len()] {
        self.parts.each_ref().map(|part| part.each_ref().map(|time| 1e-9 * time.load(Relaxed) as f64))
    }

    /// Runs a whole part, at whose end all threads wait for each other.
    pub(super) fn part<T>(&self, part: Part, run: impl FnOnce() -> T) -> T {
        self.timed(&self.parts[part as usize][0], run)
    }

    /// Runs the work of one thread in a part.
    pub(super) fn work<T>(&self, part: Part, run: impl FnOnce() -> T) -> T {
        self.timed(&self.parts[part as usize][1], run)
    }

    fn timed<T>(&self, time: &AtomicU64, run: impl FnOnce() -> T) -> T {
        if !self.runs.load(Relaxed) {
            return run();
        }
        let started = Instant::now();
        let result = run();
        time.fetch_add(started.elapsed().as_nanos() as u64, Relaxed);
        result
    }
}
