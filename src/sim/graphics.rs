//! Error handling shared by the window and the renderer, whose underlying libraries fail in their own ways.

use std::error::Error;
use std::panic;

use anyhow::{Chain, Result, anyhow};

use crate::schedule::caught;

/// Runs `f` and turns a panic into an error without printing it: the windowing libraries panic e.g. if a shared library is
/// missing.
pub fn attempt<T, E: Error + 'static>(f: impl FnOnce() -> Result<T, E>) -> Result<T> {
    let hook = panic::take_hook();
    panic::set_hook(Box::new(|_| {}));
    let result = caught(f);
    panic::set_hook(hook);
    result
        .map_err(anyhow::Error::msg)?
        .map_err(|error| described(&error))
}

/// Formats an error and its causes on one line, without consecutive duplicates.
pub fn described(error: &(dyn Error + 'static)) -> anyhow::Error {
    let mut causes: Vec<String> = Chain::new(error).map(ToString::to_string).collect();
    causes.dedup();
    anyhow!("{}", without_place(&causes.join(": ")))
}

/// Removes the location in winit's source code that winit puts before an error's description.
fn without_place(text: &str) -> String {
    let shortened = || {
        let (before, place) = text.split_once("os error at ")?;
        let (_, line) = place.split_once(".rs:")?;
        let (_, what) = line.split_once(": ")?;
        Some(format!("{before}{what}"))
    };
    shortened().unwrap_or_else(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_an_error_that_says_what_it_said() {
        let panicking: fn() -> Result<(), std::fmt::Error> =
            || panic!("Library {} could not be loaded.", "libx.so");
        assert_eq!(
            attempt(panicking).unwrap_err().to_string(),
            "Library libx.so could not be loaded."
        );
        assert_eq!(attempt(|| Ok::<_, std::fmt::Error>(3)).unwrap(), 3);
    }

    #[test]
    fn places_in_the_source_of_libraries_are_left_out() {
        let text = "event loop failed: os error at /somewhere/winit/src/linux/mod.rs:788: Failed to open connection";
        assert_eq!(
            without_place(text),
            "event loop failed: Failed to open connection"
        );
        assert_eq!(
            without_place("glutin operation failed"),
            "glutin operation failed"
        );
    }
}
