//! The memory of this process and of the machine, as Linux reports it.

use std::fs;

/// How much memory the processes of this container may use.
const LIMIT: &str = "/sys/fs/cgroup/memory.max";

/// The number in kB behind `name` in a file of such lines, in bytes.
fn reported(path: &str, name: &str) -> Option<f64> {
    let text = fs::read_to_string(path).ok()?;
    let mut lines = text.lines();
    let line = lines.find_map(|line| line.strip_prefix(name))?;
    let number: f64 = line.split_whitespace().next()?.parse().ok()?;
    Some(1024.0 * number)
}

/// The most memory that this process has used at once, bytes. `None` on other systems.
pub fn used() -> Option<f64> {
    reported("/proc/self/status", "VmHWM:")
}

/// The memory that all processes of the machine may use, or of this container, bytes. `None` on other systems.
pub fn of_machine() -> Option<f64> {
    let all = reported("/proc/meminfo", "MemTotal:")?;
    let limit = fs::read_to_string(LIMIT).unwrap_or_default();
    Some(limit.trim().parse().map_or(all, |limit| all.min(limit)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_uses_some_of_the_memory_of_its_machine() {
        let Some((before, machine)) = used().zip(of_machine()) else {
            assert!(!fs::exists("/proc/self/status").unwrap());
            return;
        };
        let room = std::hint::black_box(vec![1_u8; 200 << 20]);
        let after = used().unwrap();
        assert!(0.0 < before && room.len() as f64 <= after && after < machine);
    }
}
