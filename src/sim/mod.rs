//! The wrapper around MuJoCo: loads a scene, finds objects in it by name, steps it and reports divergence.
//!
//! Nothing outside this folder names `mujoco_rs`. Nothing inside it depends on the task, except for the look of the hand.
//! Angles are in rad, lengths in m, in the world frame.

mod compilation;
mod constants;
mod drawing;
mod fatal;
mod files;
mod fingerprint;
mod finite;
mod furnish;
#[cfg(any(feature = "pictures", feature = "viewer"))]
mod graphics;
mod look;
#[cfg(feature = "viewer")]
mod panel;
mod placing;
#[cfg(feature = "pictures")]
mod renderer;
mod scene;
mod sharing;
mod simulation;
mod structure;
mod symmetry;
mod variation;
#[cfg(feature = "viewer")]
mod viewer;

pub use compilation::{Compilation, Cone, origin};
pub use drawing::Drawing;
pub use fatal::{before_fatal_error, stepping};
pub use files::{SceneFiles, scene_files};
pub use look::{Camera, Dress, Look, Piece, Quality};
pub use mujoco_rs::mujoco_version;
pub use scene::{Actuator, Body, Frame, FreeJoint, Hinge, Mocap, Scene};
pub use simulation::{Pose, Simulation, Velocity};
pub use structure::Parts;
pub use variation::Change;

#[cfg(feature = "viewer")]
pub use panel::{Controls, Gauge, Readout, SPEEDS, Trend};
#[cfg(feature = "pictures")]
pub use renderer::Renderer;
#[cfg(feature = "viewer")]
pub use viewer::Viewer;
