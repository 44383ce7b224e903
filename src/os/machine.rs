//! The machine that this process runs on: what several processes must know about each other's machines.

use std::fs;

use rustix::system::uname;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use super::file::read_bytes;

/// A machine, and what this process may use of it.
#[derive(Debug, Serialize, Deserialize)]
pub struct Machine {
    /// Its name in the network.
    pub name: String,
    /// The number of processors that the system runs on.
    pub processors: usize,
    /// The number of them that this process may run on.
    pub allowed: usize,
}

impl Machine {
    /// This machine. What the system does not report is empty or 0.
    pub fn this() -> Self {
        let text = |path| fs::read_to_string(path).unwrap_or_default();
        Self {
            name: uname().nodename().to_string_lossy().into_owned(),
            processors: count(&text("/sys/devices/system/cpu/online")),
            allowed: text("/proc/self/status")
                .lines()
                .find_map(|line| line.strip_prefix("Cpus_allowed_list:"))
                .map_or(0, count),
        }
    }
}

/// The time that all threads of this process together have spent on processors, s.
pub fn processor_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Whether other programs use this machine: more threads run or wait than it has processors and than this program has workers. Unknown
/// systems are not shared.
pub fn is_shared() -> bool {
    let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let waiting = load.split(' ').next().and_then(|load| load.parse().ok());
    waiting.is_some_and(|waiting: f64| {
        waiting > 1.5 * Machine::this().processors.max(rayon::current_num_threads()) as f64
    })
}

/// The number of elements of a list as the kernel writes it, e.g. 5 for `0-3,8`.
fn count(list: &str) -> usize {
    let number = |text: &str| text.trim().parse::<usize>().ok();
    let ranges = list
        .split(',')
        .map(|part| part.split_once('-').unwrap_or((part, part)));
    ranges
        .filter_map(|(first, last)| Some((number(last)? + 1).saturating_sub(number(first)?)))
        .sum()
}

/// A checksum (CRC-32) of the file of this program, or 0 if it cannot be read.
pub fn program_checksum() -> u32 {
    let program = std::env::current_exe()
        .ok()
        .and_then(|path| read_bytes(&path).ok());
    program.map_or(0, |bytes| crc32fast::hash(&bytes))
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn a_thread_that_computes_uses_a_processor() {
        let before = processor_seconds();
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_millis(300) {}
        let used = processor_seconds() - before;
        // Other programs may run at the same time.
        assert!(used > 0.03, "{used}");
    }

    #[test]
    fn processors_are_counted_in_the_lists_of_the_kernel() {
        assert_eq!(
            ["0", "0-3", "0-3,8", "1,3,5-6\n", ""].map(count),
            [1, 4, 5, 4, 0]
        );
        let this = Machine::this();
        let reports = fs::exists("/proc/self/status").unwrap();
        assert!(
            this.processors >= this.allowed && (this.allowed >= 1) == reports,
            "{this:?}"
        );
    }
}
