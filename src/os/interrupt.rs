//! Signals and the time limit, which request the program to save and stop, or to save and continue. A second request to stop, or
//! one while there is nothing to save, ends the program at once.

#![expect(
    unsafe_code,
    reason = "only the C library reports what a signal does without changing it"
)]

use std::fmt;
use std::mem::MaybeUninit;
use std::process::ExitCode;
use std::ptr::null;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1, SIGXFSZ};
use signal_hook::iterator::Signals;
use signal_hook::low_level::{emulate_default_handler, exit};

use super::output::remove_unfinished;
use super::pip;
use super::stderr::drain;

/// Signals within this time are one request to stop: a terminal that is closed sends SIGHUP twice, and some schedulers send both
/// SIGTERM and SIGHUP.
const ONE_REQUEST: Duration = Duration::from_secs(1);

/// The same time for SIGINT. Wrappers that forward Ctrl-C to a program and to its group send it twice. A user who presses it
/// twice takes longer.
const ONE_KEY: Duration = Duration::from_millis(200);

/// The time after a request to stop in which a program that saves nothing ends by itself.
const LONGEST_END: Duration = Duration::from_secs(8);

/// The requests since the program began to listen.
#[derive(Clone)]
pub struct Requests {
    since: Instant,
    /// Whether the program ends by itself after the first request to stop. Until this is set, a request ends it at once.
    patient: Arc<AtomicBool>,
    /// The flag that is set when the program is requested to stop.
    pub stop: Arc<AtomicBool>,
    /// The signal that requested the stop, or 0.
    signal: Arc<AtomicI32>,
    save: Arc<AtomicBool>,
}

impl Requests {
    /// Requests that never arrive.
    pub fn none() -> Self {
        let (patient, stop, signal, save) = Default::default();
        Self {
            since: Instant::now(),
            patient,
            stop,
            signal,
            save,
        }
    }

    /// Catches SIGINT, SIGTERM and SIGHUP from now on, and, if the program `saves`, SIGUSR1 as a request to save. Signals that
    /// were ignored when the program started stay ignored, e.g. SIGHUP under `nohup`. A file that grows beyond its limit
    /// (SIGXFSZ) is an error like a full disk.
    ///
    /// # Errors
    /// Fails if the system refuses a handler or a thread.
    pub fn listen(saves: bool) -> Result<Self> {
        let requests = Self::none();
        let caught = [SIGINT, SIGTERM, SIGHUP]
            .into_iter()
            .chain(saves.then_some(SIGUSR1));
        let caught = caught.filter(|signal| !is_ignored(*signal));
        signal_hook::flag::register(SIGXFSZ, Arc::default()).context("cannot catch signals")?;
        let mut signals = Signals::new(caught).context("cannot catch signals")?;
        let shared = requests.clone();
        let listen = move || shared.listen_loop(&mut signals, saves);
        thread::Builder::new()
            .spawn(listen)
            .context("cannot start a thread for signals")?;
        Ok(requests)
    }

    /// Declares that from now on the program checks for requests and ends by itself.
    pub fn wait_for_end(&self) {
        self.patient.store(true, Ordering::Relaxed);
    }

    fn listen_loop(&self, signals: &mut Signals, saves: bool) {
        let mut first: Option<Instant> = None;
        for signal in signals.forever() {
            if signal == SIGUSR1 {
                self.save.store(true, Ordering::Relaxed);
                continue;
            }
            let together = if signal == SIGINT {
                ONE_KEY
            } else {
                ONE_REQUEST
            };
            let again = first.is_some_and(|first| first.elapsed() > together);
            if again || !self.patient.load(Ordering::Relaxed) {
                end(signal, saves);
            }
            if first.is_none() {
                first = Some(Instant::now());
                self.signal.store(signal, Ordering::Relaxed);
                self.stop.store(true, Ordering::Relaxed);
                if !saves {
                    // It may be waiting for the reader of a pipe.
                    let _ = thread::Builder::new().spawn(move || {
                        thread::sleep(LONGEST_END);
                        end(signal, saves)
                    });
                }
            }
        }
    }

    /// The signal that requested the stop, or 0 if none did.
    pub fn signal(&self) -> i32 {
        self.signal.load(Ordering::Relaxed)
    }

    /// Requests a stop when the program has listened for this time.
    ///
    /// # Errors
    /// Fails if the system refuses a thread.
    pub fn stop_after(&self, limit: Duration) -> Result<()> {
        let stop = self.stop.clone();
        let left = limit.saturating_sub(self.since.elapsed());
        let clock = thread::Builder::new().spawn(move || {
            thread::sleep(left);
            stop.store(true, Ordering::Relaxed);
        });
        clock
            .map(drop)
            .context("cannot start a thread for the time limit")
    }

    /// Whether a save was requested since the last call.
    pub fn take_save(&self) -> bool {
        self.save.swap(false, Ordering::Relaxed)
    }
}

/// Whether this signal is ignored, e.g. SIGHUP under `nohup`.
fn is_ignored(signal: i32) -> bool {
    let mut action = MaybeUninit::<libc::sigaction>::uninit();
    // SAFETY: without a new action nothing changes, and the old one is read only if it was written.
    unsafe {
        libc::sigaction(signal, null(), action.as_mut_ptr()) == 0
            && action.assume_init().sa_sigaction == libc::SIG_IGN
    }
}

/// Ends the program at once. One that saves nothing ends like a program that never caught the signal, so that the parent process
/// sees the cause. The kernel does not let a signal end the first process of a container in this way.
fn end(signal: i32, saves: bool) -> ! {
    pip::stop();
    remove_unfinished();
    drain();
    if !saves && std::process::id() != 1 {
        let _ = emulate_default_handler(signal);
    }
    exit(128 + signal)
}

/// The exit code for a stop that this signal requested: 128 plus its number, or 0 for no signal.
pub fn exit_code(signal: i32) -> ExitCode {
    if signal == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(128 + signal as u8)
    }
}

/// The error of work that a request to stop has cut short.
#[derive(Debug)]
pub struct Interrupted;

impl fmt::Display for Interrupted {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("interrupted")
    }
}

/// Checks that no stop is requested.
///
/// # Errors
/// Fails with [`Interrupted`] if one is.
pub fn expect_no_stop(stop: &AtomicBool) -> Result<()> {
    ensure!(!stop.load(Ordering::Relaxed), Interrupted);
    Ok(())
}
