//! A queue before stderr: what is said waits there for its reader, and nobody waits who says it. A training run goes on when the
//! terminal is suspended, or when nobody reads a pipe.
//!
//! Only what is said goes this way. Data on stdout and in files is never dropped, and waits.

use std::io::{self, Write};
use std::os::fd::{AsRawFd, RawFd};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::mpsc::{Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use console::Term;
use indicatif::ProgressDrawTarget;

/// The most texts that wait. Lines beyond these are dropped and counted.
const MOST_LINES: usize = 1000;

/// The number of waiting texts from which a progress line is not redrawn.
const MOST_DRAWN: usize = 50;

/// The most redraws of a progress line in a second.
const REDRAWS: u8 = 20;

/// The time for which the end of the program, or a result on stdout, waits until what was said is read.
const PATIENCE: Duration = Duration::from_secs(1);

/// The way to the thread that writes. Without it, texts are written at once.
static QUEUE: OnceLock<Sender<String>> = OnceLock::new();
/// The number of texts on their way.
static WAITING: AtomicUsize = AtomicUsize::new(0);
/// The number of lines that were dropped.
static LOST: AtomicUsize = AtomicUsize::new(0);

/// As long as this lives, what is said goes through the queue. When it is dropped, what waits is written if it is read soon.
pub struct Queued;

impl Queued {
    /// Begins to queue what the program says.
    ///
    /// # Errors
    /// Fails if the system refuses a thread.
    pub fn begin() -> Result<Self> {
        let (sender, texts) = channel::<String>();
        let write_all = move || {
            for text in texts {
                write_now(&text);
                if WAITING.fetch_sub(1, Relaxed) == 1 {
                    match LOST.swap(0, Relaxed) {
                        0 => {}
                        lost => write_now(&format!(
                            "warning: {lost} lines were not read and dropped\n"
                        )),
                    }
                }
            }
        };
        thread::Builder::new()
            .spawn(write_all)
            .context("cannot start a thread for stderr")?;
        let _ = QUEUE.set(sender);
        Ok(Self)
    }
}

impl Drop for Queued {
    fn drop(&mut self) {
        drain();
    }
}

/// Waits until what was said is read, but not long.
pub fn drain() {
    let begun = Instant::now();
    while WAITING.load(Relaxed) > 0 && begun.elapsed() < PATIENCE {
        thread::sleep(Duration::from_millis(1));
    }
}

/// Says a line, which ends with a line feed.
pub fn say_text(line: String) {
    if !put(line, MOST_LINES) {
        LOST.fetch_add(1, Relaxed);
    }
}

/// Writes a text, or lets it wait behind fewer than `most` others. Otherwise, returns false.
fn put(text: String, most: usize) -> bool {
    let Some(queue) = QUEUE.get() else {
        write_now(&text);
        return true;
    };
    let fits = WAITING.fetch_add(1, Relaxed) < most;
    if !fits || queue.send(text).is_err() {
        WAITING.fetch_sub(1, Relaxed);
    }
    fits
}

fn write_now(text: &str) {
    // Who has closed stderr wants to hear nothing.
    let _ = io::stderr().write_all(text.as_bytes());
}

/// Where progress is drawn: the terminal behind the queue.
pub fn progress_target() -> ProgressDrawTarget {
    ProgressDrawTarget::term(Term::read_write_pair(io::stdin(), Drawn), REDRAWS)
}

/// What indicatif draws with.
#[derive(Debug)]
struct Drawn;

impl Write for Drawn {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        put(String::from_utf8_lossy(bytes).into_owned(), MOST_DRAWN);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl AsRawFd for Drawn {
    fn as_raw_fd(&self) -> RawFd {
        io::stderr().as_raw_fd()
    }
}
