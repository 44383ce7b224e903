//! The machine that this process runs on: what several processes must know about each other's machines.

use std::fs;

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
            name: text("/proc/sys/kernel/hostname").trim().to_owned(),
            processors: count(&text("/sys/devices/system/cpu/online")),
            allowed: count(&process_status("Cpus_allowed_list:")),
        }
    }
}

/// What the system says of this process in the line that begins with `name`, or nothing if there is none.
pub fn process_status(name: &str) -> String {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    status
        .lines()
        .find_map(|line| line.strip_prefix(name))
        .unwrap_or_default()
        .trim()
        .to_owned()
}

/// The time that the living threads of this process together have spent on processors, s. The kernel brings it up to date every few
/// milliseconds. It is `None` if the system does not report it.
pub fn processor_seconds() -> Option<f64> {
    let mut nanoseconds = 0.0;
    for thread in fs::read_dir("/proc/self/task").ok()?.flatten() {
        let times = fs::read_to_string(thread.path().join("schedstat")).ok()?;
        nanoseconds += times.split(' ').next()?.parse::<f64>().ok()?;
    }
    Some(1e-9 * nanoseconds)
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
        let before = processor_seconds().unwrap();
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_millis(300) {}
        let used = processor_seconds().unwrap() - before;
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
        assert!(
            this.processors >= this.allowed && this.allowed >= 1,
            "{this:?}"
        );
    }
}
