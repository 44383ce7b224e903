//! Nets on blocks of rows, their matrix products, and the arithmetic of these products. Nothing here knows of a policy.
//!
//! Each function works on the calling thread, on data that stays in the cache of its core. Whoever calls them runs many at once.

mod activation;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod amx;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod bf16;
mod multiplier;
mod net;
mod product;
mod units;
mod widest;

pub(super) use multiplier::{Arithmetic, Multiplier};
pub(super) use net::Net;
pub use net::Workspace;
pub(super) use product::Matrix;
pub(super) use widest::widest;

/// Rows that pass through a net together: enough for fast products, few enough for the cache of one core.
pub const ROWS: usize = 256;
