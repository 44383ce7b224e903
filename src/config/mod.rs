//! Every setting of the program: its type, where its value comes from, and which values are allowed.
//!
//! No default is written in Rust: `configs/repose.toml` is the base, a user's file and `--set` lie on top, all merged as
//! tables before typing, so that each source meets the same checks. Nothing here reads files or knows who uses a setting.
//!
//! A new training key is written at four places: `configs/repose.toml`, its field in `settings`, its rule in `rules`, its use.

mod layers;
mod overlay;
mod ramp;
mod removed;
mod rules;
mod settings;
mod used;

/// The default configuration, commented.
pub const BASE: &str = include_str!("../../configs/repose.toml");

pub use layers::{Override, PolicyConfig, Source};
pub use ramp::Ramp;
pub use settings::{
    Activation, BUILTIN_MODEL, Backend, Config, EnvConfig, NetConfig, PpoConfig, Precision, RunConfig, SuccessHold,
    Symmetry, TrainingConfig,
};
pub use used::expect_used;
