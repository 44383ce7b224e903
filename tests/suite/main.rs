//! The behaviours of the whole: each test says one in a sentence.

// The limits of the model are decimal numbers near multiples of π, and are meant so.
#![allow(clippy::approx_constant)]

mod architecture;
mod bad_input;
mod binary;
mod experiment;
mod fork;
mod outputs;
mod pace;
#[cfg(feature = "video")]
mod pictures;
mod point_mass;
mod pool;
mod ranks;
mod resume;
mod run_folder;
mod scene;
mod support;
mod survival;
mod task;
mod training;
#[cfg(feature = "viewer")]
mod window;
