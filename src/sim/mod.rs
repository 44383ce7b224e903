//! The fence around MuJoCo: loads a scene, finds things in it by name, steps it, tells when it diverged.
//!
//! Nothing outside this folder names `mujoco_rs`; nothing inside knows the task. Angles rad, lengths m, world frame.

mod fatal;
mod finite;
#[cfg(any(feature = "video", feature = "viewer"))]
mod graphics;
mod look;
#[cfg(feature = "viewer")]
mod panel;
#[cfg(feature = "video")]
mod renderer;
mod scene;
mod simulation;
#[cfg(feature = "viewer")]
mod viewer;

pub use fatal::before_fatal_error;
pub use look::{Camera, Look, Quality, mesh_files};
pub use mujoco_rs::mujoco_version;
pub use scene::{Actuator, Body, FreeJoint, Hinge, Mocap, Scene, Variation};
pub use simulation::{BareSimulation, Physics, Simulation, SimulationState};

#[cfg(feature = "viewer")]
pub use panel::{Bar, Controls, Curve, Readout, SPEEDS};
#[cfg(feature = "video")]
pub use renderer::Renderer;
#[cfg(feature = "viewer")]
pub use viewer::Viewer;
