//! Ctrl-C and its relatives: the first asks the program to save and stop, the second ends it at once.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::{Context, Result};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

/// Exit code of a program that was interrupted.
pub const INTERRUPTED: u8 = 130;

/// Catches SIGINT and SIGTERM from now on; the flag is set by the first one.
///
/// # Errors
/// A handler that the system refuses.
pub fn on_interrupt() -> Result<Arc<AtomicBool>> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // In this order: the first signal finds the flag unset, passes by, and sets it.
        flag::register_conditional_shutdown(signal, i32::from(INTERRUPTED), interrupted.clone())
            .and_then(|_| flag::register(signal, interrupted.clone()))
            .context("cannot catch Ctrl-C")?;
    }
    Ok(interrupted)
}
