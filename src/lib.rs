pub mod config;
pub mod env;
pub mod quat;
pub mod rng;
pub mod sim;
