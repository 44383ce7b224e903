//! Signals and the time limit: what asks the program to save and stop, or to save and go on. The second that asks to stop ends
//! it at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1};
use signal_hook::flag;

/// What has been asked for since the program began to listen.
#[derive(Clone, Debug, Default)]
pub struct Requests {
    stop: Arc<AtomicBool>,
    /// Which signal asked to stop, or 0.
    signal: Arc<AtomicUsize>,
    save: Arc<AtomicBool>,
}

impl Requests {
    /// Catches SIGINT, SIGTERM, SIGHUP (unless it is ignored, as under `nohup`) and SIGUSR1 from now on.
    ///
    /// # Errors
    /// A handler that the system refuses.
    pub fn listen() -> Result<Self> {
        let requests = Self::default();
        let signalled = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            if signal == SIGHUP && hangup_is_ignored() {
                continue;
            }
            // In this order: the first signal finds its flag unset, passes by, and sets it.
            flag::register_conditional_shutdown(signal, 128 + signal, signalled.clone())
                .and_then(|_| flag::register(signal, signalled.clone()))
                .and_then(|_| flag::register_usize(signal, requests.signal.clone(), signal as usize))
                .and_then(|_| flag::register(signal, requests.stop.clone()))
                .context("cannot catch signals")?;
        }
        flag::register(SIGUSR1, requests.save.clone()).context("cannot catch signals")?;
        Ok(requests)
    }

    /// Set when the program was asked to stop.
    pub fn stop(&self) -> &AtomicBool {
        &self.stop
    }

    /// The exit code that tells what asked to stop: 128 and the signal's number, or 0 for the time limit.
    pub fn exit_code(&self) -> u8 {
        match self.signal.load(Ordering::Relaxed) {
            0 => 0,
            signal => 128 + signal as u8,
        }
    }

    /// Asks to stop when this time has passed.
    pub fn stop_after(&self, limit: Duration) {
        let stop = self.stop.clone();
        std::thread::spawn(move || {
            std::thread::sleep(limit);
            stop.store(true, Ordering::Relaxed);
        });
    }

    /// Whether it was asked to save since the last call.
    pub fn take_save(&self) -> bool {
        self.save.swap(false, Ordering::Relaxed)
    }
}

/// Whoever starts a program with SIGHUP ignored wants it to outlive the terminal.
fn hangup_is_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask >> (SIGHUP - 1) & 1 == 1)
}
