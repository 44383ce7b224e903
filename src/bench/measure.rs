//! What all measurements share.

use std::sync::atomic::AtomicBool;

/// The stop flag of what is measured, which is never set.
pub(super) static NEVER: AtomicBool = AtomicBool::new(false);

/// Returns the median; the upper one of two.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
