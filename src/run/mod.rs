//! The outside of a run: its folder, its logs, the terminal, signals. Knows neither environments nor learning.

mod checkpoints;
mod events;
mod file;
#[cfg(feature = "video")]
mod film;
mod folder;
mod interrupt;
mod meshes;
mod metrics;
mod pip;
mod report;

pub use checkpoints::Checkpoints;
pub use file::{OutputFile, read_bytes, read_text, write_whole};
#[cfg(feature = "video")]
pub use film::{FilmFormat, FilmWriter, write_png};
pub use folder::{Locked, RunFolder, newest_checkpoint, resolve_checkpoint};
pub use interrupt::Requests;
pub use meshes::hand_meshes;
pub use report::{Bar, Report, Status};

use anyhow::{Context, Result};

/// Prints text on stdout; a reader that has gone away is no error.
pub fn print(text: &str) {
    let _ = std::io::Write::write_all(&mut std::io::stdout(), text.as_bytes());
}

/// Prints a line on stderr.
pub fn say(line: &str) {
    let _ = std::io::Write::write_all(&mut std::io::stderr(), format!("{line}\n").as_bytes());
}

/// Whether there is a display that a window could open on.
pub fn has_display() -> bool {
    ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()))
}

/// Gives rayon, and with it every part of the program, this many worker threads (0: one for every core); once.
///
/// # Errors
/// Threads that the system refuses.
pub fn start_threads(threads: usize) -> Result<()> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    pool.build_global().with_context(|| format!("cannot start {threads} worker threads"))
}
