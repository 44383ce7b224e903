//! The fence around MuJoCo: loads a scene, finds things in it by name, steps it, tells when it diverged.
//!
//! Nothing outside this folder names `mujoco_rs`; nothing inside knows the task. Angles rad, lengths m, world frame.

mod scene;
mod simulation;

pub use mujoco_rs::mujoco_version;
pub use scene::{Actuator, Body, FreeJoint, Hinge, Mocap, Scene};
pub use simulation::{BareSimulation, Physics, Simulation, SimulationState};
