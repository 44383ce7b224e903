//! Error handling shared by the window and the renderer, whose underlying libraries fail in their own ways.

use std::error::Error;

use anyhow::{Result, anyhow};

use crate::schedule::caught;

/// Runs `f` and turns a panic into an error without printing it: the windowing libraries panic e.g. if a shared library is
/// missing.
pub(super) fn attempt<T, E: Error + 'static>(f: impl FnOnce() -> Result<T, E>) -> Result<T> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = caught(f);
    std::panic::set_hook(hook);
    result.map_err(anyhow::Error::msg)?.map_err(|error| described(&error))
}

/// Formats an error and its causes on one line, without consecutive duplicates.
pub(super) fn described(error: &(dyn Error + 'static)) -> anyhow::Error {
    let mut causes = vec![error.to_string()];
    let mut cause = error.source();
    while let Some(error) = cause {
        causes.push(error.to_string());
        cause = error.source();
    }
    causes.dedup();
    anyhow!("{}", without_place(&causes.join(": ")))
}

/// Removes the location in winit's source code that winit puts before an error's description.
fn without_place(text: &str) -> String {
    let place = text.split_once("os error at ").and_then(|(before, rest)| Some((before, rest.split_once(".rs:")?.1)));
    match place.and_then(|(before, rest)| Some((before, rest.split_once(": ")?.1))) {
        Some((before, what)) => format!("{before}{what}"),
        None => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_an_error_that_says_what_it_said() {
        let panicking: fn() -> Result<(), std::fmt::Error> = || panic!("Library {} could not be loaded.", "libx.so");
        assert_eq!(attempt(panicking).unwrap_err().to_string(), "Library libx.so could not be loaded.");
        assert_eq!(attempt(|| Ok::<_, std::fmt::Error>(3)).unwrap(), 3);
    }

    #[test]
    fn places_in_the_source_of_libraries_are_left_out() {
        let text = "event loop failed: os error at /somewhere/winit/src/linux/mod.rs:788: Failed to open connection";
        assert_eq!(without_place(text), "event loop failed: Failed to open connection");
        assert_eq!(without_place("glutin operation failed"), "glutin operation failed");
    }
}
