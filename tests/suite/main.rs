//! Tests of the whole program. The name of each states the behaviour that it checks.

// Some limits of the model are decimal numbers near multiples of π, on purpose.
#![allow(clippy::approx_constant)]
// A panic in a test or its helpers is a failure, as it should be.
#![allow(clippy::unwrap_used)]

mod architecture;
mod bad_input;
mod binary;
mod curves;
mod docs;
mod export;
#[cfg(feature = "video")]
mod fetching;
mod foreign_scene;
mod fork;
mod goal_times;
mod mpi;
mod outputs;
mod own_hand;
mod own_scene;
mod page;
mod permissions;
#[cfg(feature = "video")]
mod pictures;
mod point_mass;
mod pool;
mod prediction;
mod randomization;
mod ranks;
mod resume;
mod run_folder;
mod runs;
mod scene;
mod settings;
mod support;
mod survival;
mod sweep;
mod task;
mod told;
mod training;
#[cfg(feature = "viewer")]
mod window;
mod words;
