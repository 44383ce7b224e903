//! Errors and panics as exceptions of Python.

use std::any::Any;
use std::io::ErrorKind;
use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::Error;
use pyo3::exceptions::{PyFileNotFoundError, PyPermissionError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;

/// The exception for an error about the user's input.
pub(crate) fn refused(error: Error) -> PyErr {
    let kinds = error
        .chain()
        .filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    let kind = kinds.map(std::io::Error::kind).next();
    let text = format!("{error:#}");
    match kind {
        Some(ErrorKind::NotFound) => PyFileNotFoundError::new_err(text),
        Some(ErrorKind::PermissionDenied) => PyPermissionError::new_err(text),
        _ => PyValueError::new_err(text),
    }
}

/// Does the work. A panic becomes an error that `except Exception` catches.
pub(crate) fn guarded<T>(work: impl FnOnce() -> T) -> PyResult<T> {
    // Unwind safe: what a panic left inconsistent is not used again.
    catch_unwind(AssertUnwindSafe(work)).map_err(|panic| panicked(&*panic))
}

/// The exception for a panic.
pub(crate) fn panicked(panic: &(dyn Any + Send)) -> PyErr {
    let message = shadow_repose::schedule::panic_message(panic);
    PyRuntimeError::new_err(format!("internal error: {message}"))
}
