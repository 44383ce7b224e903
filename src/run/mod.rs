//! The outside of a run: its folder, its logs, the terminal, signals. Knows neither environments nor learning.

mod chart;
mod checkpoints;
mod events;
mod file;
#[cfg(feature = "video")]
mod film;
mod folder;
mod interrupt;
mod lock;
mod meshes;
mod metrics;
mod output;
mod pip;
mod progress;
mod report;

pub use chart::{Chart, Curve, Panel};
pub use checkpoints::Checkpoints;
pub use file::{read_bytes, read_text, same_file};
#[cfg(feature = "video")]
pub use film::{FilmFormat, FilmWriter, write_png};
pub use folder::{RunFolder, newest_checkpoint, resolve_checkpoint};
pub use interrupt::Requests;
pub use lock::Locked;
pub use meshes::hand_meshes;
pub use metrics::read_metrics;
pub use output::{OutputFile, expect_folder, write_whole};
pub use progress::{Bar, Progress, Status};
pub use report::Report;

use std::io::{ErrorKind, Write};
use std::path::Path;

use anyhow::{Context, Result, anyhow, ensure};

/// Prints text on stdout; a reader that has gone away is no error.
///
/// # Errors
/// A place that cannot be written to, as a full disk.
pub fn print(text: &str) -> Result<()> {
    let mut stdout = std::io::stdout();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to stdout"),
        _ => Ok(()),
    }
}

/// Prints a line on stderr. What it quotes may come from a file of somebody else, and must not steer the terminal.
pub fn say(line: &str) {
    let mut harmless = String::with_capacity(line.len() + 1);
    for c in line.chars() {
        match c {
            '\n' | '\t' => harmless.push(c),
            c if c.is_control() => harmless.extend(c.escape_default()),
            c => harmless.push(c),
        }
    }
    let _ = std::io::stderr().write_all((harmless + "\n").as_bytes());
}

/// A text as one word for a shell.
pub fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@%".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', "'\\''"))
    }
}

/// A path as one word for a shell, also where its name is no text.
pub fn quoted_path(path: &Path) -> String {
    path.to_str().map_or_else(
        || {
            let escaped = path.as_os_str().as_encoded_bytes().escape_ascii().to_string();
            // Of the escapes only this one means something else there.
            format!("$'{}'", escaped.replace("\\\"", "\""))
        },
        quoted,
    )
}

/// Whether there is a display that a window could open on.
pub fn has_display() -> bool {
    ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()))
}

/// More worker threads for each core than this only take turns.
const MOST_THREADS: usize = 16;

/// Gives rayon, and with it every part of the program, this many worker threads (0: one for every core); once.
///
/// # Errors
/// More of them than make sense; threads that the system refuses.
pub fn start_threads(threads: usize) -> Result<()> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let most = MOST_THREADS * cores;
    ensure!(
        threads <= most,
        "{threads} worker threads: at most {most} here, {MOST_THREADS} for each core; --threads sets them"
    );
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    // Its text has the one of its source in it.
    pool.build_global().map_err(|error| anyhow!("cannot start {threads} worker threads: {error}"))
}

#[cfg(test)]
mod tests {
    use std::os::unix::ffi::OsStrExt;

    use super::*;

    #[test]
    fn words_with_a_meaning_for_a_shell_are_quoted() {
        assert_eq!(quoted("runs/a-1"), "runs/a-1");
        assert_eq!(quoted("my run"), "'my run'");
        assert_eq!(quoted("$(it's)"), "'$(it'\\''s)'");
        assert_eq!(quoted_path(Path::new("my run")), "'my run'");
        let odd = std::ffi::OsStr::from_bytes(b"a \xff'\"\\");
        assert_eq!(quoted_path(Path::new(odd)), r#"$'a \xff\'"\\'"#);
    }
}
