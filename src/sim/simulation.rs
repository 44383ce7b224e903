//! One simulated world that steps on its own.

use std::sync::Arc;

use anyhow::{Result, ensure};
use mujoco_rs::prelude::{MjData, MjModel, MjtObjBase, MjtState, MjtWarning};

use super::{Body, Mocap, Scene};
use crate::quat::Quat;

/// Whether the state after a step can be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Physics {
    /// It can.
    Sound,
    /// The state or a control was not finite or far too large; MuJoCo has reset what it could not use.
    Diverged,
}

/// All that the next step depends on, in the order of MuJoCo's `mj_getState` for `mjSTATE_INTEGRATION`.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulationState(Box<[f64]>);

impl SimulationState {
    /// As numbers.
    pub fn numbers(&self) -> &[f64] {
        &self.0
    }
}

/// MuJoCo's name for that.
const EVERYTHING: u32 = MjtState::mjSTATE_INTEGRATION as u32;

/// The state of one world. Positions of bodies, velocities and joints are always those of the same instant.
pub struct Simulation {
    pub(super) data: MjData<Arc<MjModel>>,
}

impl Simulation {
    /// A simulation of this scene, in its default state.
    pub fn new(scene: &Scene) -> Self {
        Self { data: MjData::new(scene.model.clone()) }
    }

    /// The default state, without warm start and warnings; call [`Simulation::refresh`] after changing it.
    pub fn reset(&mut self) {
        self.data.reset();
    }

    /// Brings body positions and velocities up to date with `qpos` and `qvel`.
    pub fn refresh(&mut self) {
        self.data.step1();
    }

    /// Takes `substeps` physics steps with the controls held.
    ///
    /// `mj_step` would leave the bodies one substep behind the joints. Its two halves in the other order are the same
    /// computation, bit for bit, and end with both at the same instant.
    pub fn step(&mut self, substeps: usize) -> Physics {
        for _ in 0..substeps {
            self.data.step2();
            self.data.step1();
            if self.diverged() {
                return Physics::Diverged;
            }
        }
        Physics::Sound
    }

    /// MuJoCo resets a diverged state silently inside the step: only its warning counters tell.
    fn diverged(&self) -> bool {
        let warnings = self.data.warning();
        [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC, MjtWarning::mjWARN_BADCTRL]
            .iter()
            .any(|&kind| warnings[kind as usize].number > 0)
    }

    /// Generalised positions.
    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    /// Generalised positions, to be changed.
    pub fn qpos_mut(&mut self) -> &mut [f64] {
        self.data.qpos_mut()
    }

    /// Generalised velocities.
    pub fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// Generalised velocities, to be changed.
    pub fn qvel_mut(&mut self) -> &mut [f64] {
        self.data.qvel_mut()
    }

    /// Controls in the model's order.
    pub fn ctrl(&self) -> &[f64] {
        self.data.ctrl()
    }

    /// Controls, to be changed.
    pub fn ctrl_mut(&mut self) -> &mut [f64] {
        self.data.ctrl_mut()
    }

    /// A copy of the state.
    pub fn state(&self) -> SimulationState {
        SimulationState(self.data.state(EVERYTHING))
    }

    /// Goes on from the numbers of a state, with bodies up to date: the next step is bit for bit that of the simulation that
    /// the state was taken from.
    ///
    /// # Errors
    /// A state of another scene.
    pub fn restore(&mut self, numbers: &[f64]) -> Result<()> {
        let size = self.data.model().state_size(EVERYTHING);
        ensure!(numbers.len() == size, "a state of {} numbers, but the scene's has {size}", numbers.len());
        self.data.reset();
        self.data.set_state(numbers, EVERYTHING)?;
        self.refresh();
        ensure!(!self.diverged(), "a state that MuJoCo cannot go on from");
        Ok(())
    }

    /// Position (m) and orientation of a body's frame in the world.
    pub fn pose(&self, Body(id): Body) -> ([f64; 3], Quat) {
        (self.data.xpos()[id], self.data.xquat()[id])
    }

    /// Linear (m/s) and angular (rad/s) velocity of a body's frame origin, both in the world frame.
    pub fn velocity(&self, Body(id): Body) -> ([f64; 3], [f64; 3]) {
        // XBODY is the frame's origin; BODY would be the centre of mass.
        let [wx, wy, wz, x, y, z] = self.data.object_velocity(MjtObjBase::mjOBJ_XBODY, id, false);
        ([x, y, z], [wx, wy, wz])
    }

    /// Draws a mocap body at a position (m) and orientation.
    pub fn place(&mut self, Mocap(id): Mocap, position: [f64; 3], orientation: Quat) {
        self.data.mocap_pos_mut()[id] = position;
        self.data.mocap_quat_mut()[id] = orientation;
    }
}

/// A world that is only stepped, with plain `mj_step`: what the physics alone can do, for comparison.
pub struct BareSimulation {
    data: MjData<Arc<MjModel>>,
}

impl BareSimulation {
    /// A world of `scene` in its default state.
    pub fn new(scene: &Scene) -> Self {
        Self { data: MjData::new(scene.model.clone()) }
    }

    /// Starts from a state of a simulation of the same scene.
    ///
    /// # Panics
    /// A state of another scene.
    pub fn start(&mut self, state: &SimulationState) {
        self.data.set_state(&state.0, EVERYTHING).expect("a state of the same scene");
    }

    /// Takes `substeps` physics steps with these controls.
    pub fn step(&mut self, ctrl: &[f64], substeps: usize) {
        self.data.ctrl_mut().copy_from_slice(ctrl);
        for _ in 0..substeps {
            self.data.step();
        }
    }

    /// Generalised positions.
    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }
}
