//! What the window and the renderer share: the libraries below them fail in their own ways.

use std::error::Error;
use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::{Result, anyhow};

/// The result of `f`, in which a panic is an error too and is not printed: the windowing libraries panic where, for instance,
/// a shared library is missing.
pub fn attempt<T, E: Error + 'static>(f: impl FnOnce() -> Result<T, E>) -> Result<T> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = catch_unwind(AssertUnwindSafe(f));
    std::panic::set_hook(hook);
    match result {
        Ok(result) => result.map_err(|error| described(&error)),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
            Err(anyhow!("{}", text.unwrap_or("the windowing library failed")))
        }
    }
}

/// An error with its causes, in one line, each said once.
pub fn described(error: &(dyn Error + 'static)) -> anyhow::Error {
    let mut causes = vec![error.to_string()];
    let mut cause = error.source();
    while let Some(error) = cause {
        causes.push(error.to_string());
        cause = error.source();
    }
    causes.dedup();
    anyhow!("{}", causes.join(": "))
}
