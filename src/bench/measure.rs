//! What all measurements share.

use std::sync::atomic::AtomicBool;

/// The stop flag of measured work, which is never set.
pub static NEVER: AtomicBool = AtomicBool::new(false);

/// The median, or the upper one of two.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Figures by their keys in JSON, and the lines that show them.
pub type Found = (Vec<(&'static str, f64)>, String);
