//! The extension module of the Python package: environments that step together, and policies.
//!
//! It follows five rules. Every array that goes out is new memory, and every array that comes in is copied. Work runs without
//! Python's lock on threads of its own, except while it calls a function of the user. A fork gets threads of its own. A panic becomes
//! a `RuntimeError`. No call waits for a lock that another thread of the user may hold: the second call fails.

mod episodes;
mod errors;
mod hands;
mod pictures;
mod policy;
mod scores;
mod settings;
mod workers;

use numpy::{IntoPyArray, PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;

/// The module.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::hands::Hands;
    #[pymodule_export]
    use super::policy::Policy;
    #[pymodule_export]
    use super::prepare;
    #[pymodule_export]
    use super::scores::{evaluate, file_of};
    use super::{PyModule, PyResult, flush_before_the_end};

    #[pymodule_init]
    fn init(_module: &super::Bound<'_, PyModule>) -> PyResult<()> {
        flush_before_the_end();
        Ok(())
    }
}

/// Takes from NumPy what the other functions need, and returns a new array. Once Python has begun to end, this is no longer possible.
#[pyfunction]
fn prepare<'py>(py: Python<'py>, array: PyReadonlyArray1<'py, f32>) -> Bound<'py, PyArray1<f32>> {
    let values: Vec<f32> = array.as_array().to_vec();
    values.into_pyarray(py)
}

/// A fatal error of MuJoCo ends the process, so what Python has buffered is written first.
fn flush_before_the_end() {
    shadow_repose::sim::before_fatal_error(|message| {
        Python::attach(|py| {
            let flushed = py.run(
                c"import sys; sys.stdout.flush(); sys.stderr.flush()",
                None,
                None,
            );
            drop(flushed);
        });
        eprintln!("error: {message}");
    });
}
