//! The behaviours of the whole: each test says one in a sentence.

mod architecture;
mod bad_input;
mod binary;
mod point_mass;
mod pool;
mod scene;
mod support;
mod task;
