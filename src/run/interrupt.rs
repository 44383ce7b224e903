//! Ctrl-C and its relatives: the first asks the program to save and stop, the second ends it at once.

use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Exit code of a run that was interrupted.
const EXIT_CODE: i32 = 130;

/// Catches SIGINT, SIGTERM and SIGHUP from now on; the flag is set by the first one.
///
/// # Errors
/// A handler that the system refuses.
pub fn on_interrupt() -> Result<&'static AtomicBool> {
    ctrlc::set_handler(|| {
        if INTERRUPTED.swap(true, Ordering::SeqCst) {
            std::process::exit(EXIT_CODE);
        }
    })
    .context("cannot catch Ctrl-C")?;
    Ok(&INTERRUPTED)
}
