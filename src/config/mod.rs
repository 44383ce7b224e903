//! The settings of the program: their types, the sources of their values, and the rules for valid values.
//!
//! No default is written in Rust: `configs/repose.toml` is the base, over which the user's file and `--set` are applied. They
//! are merged as tables before typing, so that every source goes through the same checks. Nothing here depends on the code
//! that uses a setting.
//!
//! A new training key is written in four places: `configs/repose.toml`, its field in `settings`, its rule in `rules`, its use.

mod layers;
mod overlay;
mod ramp;
mod removed;
mod rules;
mod settings;
mod used;

/// The default configuration, with comments.
pub const BASE: &str = include_str!("../../configs/repose.toml");

pub use layers::{Override, PolicyConfig, Source, user_file};
pub use ramp::Ramp;
pub use settings::{
    Activation, BUILTIN_MODEL, Backend, ByGroup, ConeSetting, Config, EnvConfig, NetConfig, PpoConfig, Precision,
    RandomizationConfig, RunConfig, SuccessHold, Symmetry, TrainingConfig, VARIED,
};
pub use used::expect_used;
