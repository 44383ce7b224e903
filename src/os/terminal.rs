//! What the program says: on stdout, on stderr, and as commands for a shell.

use std::io::{BufWriter, Error, ErrorKind, IsTerminal, Write};
use std::path::Path;
use std::sync::OnceLock;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result};

use super::stderr::{drain, say_text};

/// Prints text to stdout. A closed pipe is not an error.
///
/// # Errors
/// Fails if stdout cannot be written to, e.g. on a full disk.
pub fn print(text: &str) -> Result<()> {
    is_read(text).map(drop)
}

/// Prints text to stdout, and returns whether somebody reads it: a pipe may be closed.
///
/// # Errors
/// Fails as [`print()`] does.
pub fn is_read(text: &str) -> Result<bool> {
    // On a terminal, what was said before comes before.
    drain();
    // It keeps what has not been written yet.
    let mut stdout = BufWriter::with_capacity(text.len() + 1, std::io::stdout());
    stdout.write_all(text.as_bytes())?;
    loop {
        let written = stdout.flush();
        match written.as_ref().map_err(Error::kind) {
            // A pipe that does not block takes nothing for now.
            Err(ErrorKind::WouldBlock) => thread::sleep(Duration::from_millis(5)),
            Err(ErrorKind::BrokenPipe) => return Ok(false),
            _ => return written.map(|()| true).context("cannot write to stdout"),
        }
    }
}

/// The most characters of a foreign text that a message quotes.
const LONGEST_QUOTE: usize = 100;

/// A text from an untrusted file, short enough for a message and on one line.
pub fn shortened(text: &str) -> String {
    let start: String = text.chars().take(LONGEST_QUOTE).collect();
    let start = start.replace(char::is_control, "\u{fffd}");
    if text.chars().nth(LONGEST_QUOTE).is_some() {
        format!("{start}…")
    } else {
        start
    }
}

/// A number with these decimals, or `-` if it is not known (NaN).
pub fn number(value: f64, decimals: usize) -> String {
    let text = if value.is_nan() {
        "-".into()
    } else {
        format!("{value:.decimals$}")
    };
    // Not `-0.00`.
    let is_zero = text.contains('0') && text.chars().all(|c| "-0.".contains(c));
    if is_zero {
        text.trim_start_matches('-').to_owned()
    } else {
        text
    }
}

/// What each line of [`say_line`] begins with.
static SPEAKER: OnceLock<String> = OnceLock::new();

/// From now on, lines to stderr begin with this name, because several processes print to the same place.
pub fn speak_as(name: &str) {
    let _ = SPEAKER.set(format!("{name}: "));
}

/// Whether a character controls the terminal, is invisible, or changes the direction or the lines of the text around it.
fn is_steering(c: char) -> bool {
    let unseen =
        matches!(c, '\u{ad}' | '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}');
    c.is_control()
        || unseen
        || matches!(c, '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{e0000}'..='\u{e007f}')
}

/// A text of one line. Characters that control a terminal are escaped as in JSON, so that JSON stays valid.
pub fn harmless(text: &str) -> String {
    let escape = |c: char| {
        c.encode_utf16(&mut [0; 2])
            .iter()
            .map(|unit| format!("\\u{unit:04x}"))
            .collect()
    };
    escaped(text, "", escape)
}

/// A text in which the characters that control a terminal, but for those in `kept`, are escaped.
fn escaped(text: &str, kept: &str, escape: impl Fn(char) -> String) -> String {
    let shown = |c: char| {
        if is_steering(c) && !kept.contains(c) {
            escape(c)
        } else {
            c.to_string()
        }
    };
    text.chars().map(shown).collect()
}

/// Prints a line to stderr, which is written as for `println!`.
macro_rules! say {
    ($($text:tt)*) => {
        $crate::os::say_line(&format!($($text)*))
    };
}
pub(crate) use say;

/// Prints a line to stderr, and does not wait for a reader. Characters that control the terminal are escaped, since the line may quote an untrusted file.
pub fn say_line(line: &str) {
    let speaker = SPEAKER.get().map_or("", String::as_str);
    let harmless = escaped(line, "\n\t", |c| c.escape_unicode().to_string());
    say_text(format!("{speaker}{harmless}\n"));
}

/// A text as a single shell word, quoted if necessary.
pub fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@%".contains(c);
    let is_word = !text.is_empty() && text.chars().all(plain);
    if is_word {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', "'\\''"))
    }
}

/// A path as a single shell word, even if it is not valid UTF-8.
pub fn quoted_path(path: &Path) -> String {
    if let Some(text) = path.to_str() {
        return quoted(text);
    }
    let escaped = path
        .as_os_str()
        .as_encoded_bytes()
        .escape_ascii()
        .to_string();
    // The only one of these escapes that means something else in a shell.
    format!("$'{}'", escaped.replace("\\\"", "\""))
}

/// How the user has called this program, for commands that are printed: by cargo, by a path, or by its name.
pub fn called_as() -> String {
    let exe = std::env::current_exe().unwrap_or_default();
    if std::env::var_os("CARGO_PKG_NAME").is_some_and(|name| name == env!("CARGO_PKG_NAME")) {
        let is_release = exe.components().any(|part| part.as_os_str() == "release");
        return format!("cargo run {}--", if is_release { "--release " } else { "" });
    }
    std::env::args_os()
        .next()
        .map_or("shadow-repose".into(), |name| quoted_path(Path::new(&name)))
}

/// Whether somebody reads stderr as it is written.
pub fn is_terminal() -> bool {
    std::io::stderr().is_terminal()
}

/// Whether there is a display on which a window could open.
pub fn has_display() -> bool {
    cfg!(target_os = "macos")
        || ["DISPLAY", "WAYLAND_DISPLAY"]
            .iter()
            .any(|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::ffi::OsStrExt;

    use super::*;

    #[test]
    fn what_steers_a_terminal_is_escaped_and_json_stays_the_same_json() {
        let name = "a\u{1b}[2J\n\u{9b}m\u{202e}\u{e0041}ü";
        assert_eq!(
            harmless(name),
            r"a\u001b[2J\u000a\u009bm\u202e\udb40\udc41ü"
        );
        let text = harmless(&serde_json::json!([name]).to_string());
        assert_eq!(serde_json::from_str::<[String; 1]>(&text).unwrap(), [name]);
        assert!(!text.chars().any(is_steering));
    }

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
