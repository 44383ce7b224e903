//! The memory of this process and of the machine.

#![expect(unsafe_code, reason = "calls of the C library that only report")]

use std::fs;
use std::mem::zeroed;

/// Where Linux says how much memory the processes of this container may use.
const LIMITS: [&str; 2] = [
    "/sys/fs/cgroup/memory.max",
    "/sys/fs/cgroup/memory/memory.limit_in_bytes",
];

/// The most memory that this process has used at once, bytes.
pub fn used() -> f64 {
    // SAFETY: the system fills this structure, which consists of numbers.
    let usage = unsafe {
        let mut usage = zeroed();
        libc::getrusage(libc::RUSAGE_SELF, &raw mut usage);
        usage
    };
    let unit = if cfg!(target_os = "macos") {
        1.0
    } else {
        1024.0
    };
    usage.ru_maxrss as f64 * unit
}

/// The memory that all processes of the machine may use, or of this container, bytes.
pub fn of_machine() -> f64 {
    // SAFETY: these return numbers.
    let [pages, size] = [libc::_SC_PHYS_PAGES, libc::_SC_PAGESIZE]
        .map(|what| unsafe { libc::sysconf(what) } as f64);
    let limits = LIMITS.iter().filter_map(|path| {
        let text = fs::read_to_string(path).ok()?;
        text.trim().parse().ok()
    });
    limits.fold(pages * size, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_uses_some_of_the_memory_of_its_machine() {
        let before = used();
        let room = std::hint::black_box(vec![1_u8; 200 << 20]);
        assert!(used() >= room.len() as f64 && before > 0.0);
        assert!(used() < of_machine());
    }
}
