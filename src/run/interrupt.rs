//! Signals and the time limit: what asks the program to save and stop, or to save and go on. Whoever asks twice to stop, or where
//! there is nothing to be saved, ends it at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1, SIGXFSZ};
use signal_hook::iterator::Signals;
use signal_hook::low_level::{emulate_default_handler, exit};

use super::output::remove_unfinished;
use super::pip;

/// A terminal that is closed sends SIGHUP twice, and some schedulers send SIGTERM and SIGHUP: within this time they are one
/// request.
const ONE_REQUEST: Duration = Duration::from_secs(1);

/// Who forwards Ctrl-C to a program and to its group sends it twice; who presses it twice takes longer.
const ONE_KEY: Duration = Duration::from_millis(200);

/// What has been asked for since the program began to listen.
#[derive(Clone, Debug)]
pub struct Requests {
    since: Instant,
    /// The first request to stop is waited for; before that is said, it ends the program at once.
    patient: Arc<AtomicBool>,
    stop: Arc<AtomicBool>,
    /// Which signal asked to stop, or 0.
    signal: Arc<AtomicI32>,
    save: Arc<AtomicBool>,
}

impl Requests {
    /// What nobody can ask anything of.
    pub fn none() -> Self {
        let (patient, stop, signal, save) = Default::default();
        Self { since: Instant::now(), patient, stop, signal, save }
    }

    /// Catches SIGINT, SIGTERM and SIGHUP from now on, and SIGUSR1 where it is a request to save; not what was ignored when the
    /// program began, as SIGHUP is under `nohup`. A file that grows beyond its limit (SIGXFSZ) is an error like a full disk.
    ///
    /// # Errors
    /// A handler or a thread that the system refuses.
    pub fn listen(saves: bool) -> Result<Self> {
        let requests = Self::none();
        let mut caught = vec![SIGINT, SIGTERM, SIGHUP];
        caught.extend(saves.then_some(SIGUSR1));
        let ignored = ignored();
        caught.retain(|signal| ignored >> (signal - 1) & 1 == 0);
        signal_hook::flag::register(SIGXFSZ, Arc::default()).context("cannot catch signals")?;
        let mut signals = Signals::new(caught).context("cannot catch signals")?;
        let shared = requests.clone();
        let listener = thread::Builder::new().name("signals".into());
        listener.spawn(move || shared.take(&mut signals, saves)).context("cannot start a thread for signals")?;
        Ok(requests)
    }

    /// From now on the program looks for requests, and ends by itself.
    pub fn wait_for_end(&self) {
        self.patient.store(true, Ordering::Relaxed);
    }

    fn take(&self, signals: &mut Signals, saves: bool) {
        let mut first: Option<Instant> = None;
        for signal in signals.forever() {
            if signal == SIGUSR1 {
                self.save.store(true, Ordering::Relaxed);
                continue;
            }
            let together = if signal == SIGINT { ONE_KEY } else { ONE_REQUEST };
            let again = first.is_some_and(|first| first.elapsed() > together);
            if again || !self.patient.load(Ordering::Relaxed) {
                pip::stop();
                remove_unfinished();
                if !saves {
                    // As a program that never caught it: who started it sees what ended it.
                    let _ = emulate_default_handler(signal);
                }
                exit(128 + signal);
            }
            if first.is_none() {
                first = Some(Instant::now());
                self.signal.store(signal, Ordering::Relaxed);
                self.stop.store(true, Ordering::Relaxed);
            }
        }
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

    /// Asks to stop when the program has listened for this time.
    ///
    /// # Errors
    /// A thread that the system refuses.
    pub fn stop_after(&self, limit: Duration) -> Result<()> {
        let (stop, left) = (self.stop.clone(), limit.saturating_sub(self.since.elapsed()));
        let clock = thread::Builder::new().name("time limit".into()).spawn(move || {
            thread::sleep(left);
            stop.store(true, Ordering::Relaxed);
        });
        clock.map(drop).context("cannot start a thread for the time limit")
    }

    /// Whether it was asked to save since the last call.
    pub fn take_save(&self) -> bool {
        self.save.swap(false, Ordering::Relaxed)
    }
}

/// The signals that were ignored when the program began, as bits: whoever starts it so means it to be left alone by them.
fn ignored() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}
