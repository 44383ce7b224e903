//! The extension module of the Python package: environments that step together, and policies.
//!
//! It follows five rules. Every array that goes out is new memory, and every array that comes in is copied. Work runs without
//! Python's lock on threads of its own, except while it calls a function of the user. A fork gets threads of its own. A panic becomes
//! a `RuntimeError`. No call waits for a lock that another thread of the user may hold: the second call fails.

mod episodes;
mod hands;
mod policy;
mod settings;
mod workers;

use std::any::Any;
use std::io::ErrorKind;
use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::Error;
use pyo3::exceptions::{PyFileNotFoundError, PyPermissionError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;

/// The module.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::hands::Hands;
    #[pymodule_export]
    use super::policy::{Policy, evaluate};
    use super::{PyModule, PyResult, flush_before_the_end};

    #[pymodule_init]
    fn init(_module: &super::Bound<'_, PyModule>) -> PyResult<()> {
        flush_before_the_end();
        Ok(())
    }
}

/// Returns an error about the user's input.
fn refused(error: Error) -> PyErr {
    let kinds = error.chain().filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    let kind = kinds.map(std::io::Error::kind).next();
    // The library's messages name options of its command line.
    let text =
        format!("{error:#}").replace("--mirror plays", "set={\"env.mirror\": True} plays").replace("--set ", "set ");
    match kind {
        Some(ErrorKind::NotFound) => PyFileNotFoundError::new_err(text),
        Some(ErrorKind::PermissionDenied) => PyPermissionError::new_err(text),
        _ => PyValueError::new_err(text),
    }
}

/// Does the work. A panic becomes an error that `except Exception` catches.
fn guarded<T>(work: impl FnOnce() -> T) -> PyResult<T> {
    // Unwind safe: what a panic left inconsistent is not used again.
    catch_unwind(AssertUnwindSafe(work)).map_err(|panic| panicked(&*panic))
}

fn panicked(panic: &(dyn Any + Send)) -> PyErr {
    let message = shadow_repose::schedule::panic_message(panic);
    PyRuntimeError::new_err(format!("internal error: {message}"))
}

/// A fatal error of MuJoCo ends the process, so what Python has buffered is written first.
fn flush_before_the_end() {
    shadow_repose::sim::before_fatal_error(|message| {
        Python::attach(|py| {
            let flushed = py.run(c"import sys; sys.stdout.flush(); sys.stderr.flush()", None, None);
            drop(flushed);
        });
        eprintln!("error: {message}");
    });
}
