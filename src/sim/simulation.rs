//! One simulated world, stepped independently of others.

use std::sync::Arc;

use anyhow::{Result, ensure};
use mujoco_rs::prelude::{MjData, MjModel};

use super::constants::*;
use super::sharing::{Data, Variation, compute};
use super::{Actuator, Body, Frame, FreeJoint, Mocap, Scene};
use crate::quat::{self, Quat};

/// MuJoCo's name for everything that the next step depends on.
const EVERYTHING: u32 = mjSTATE_INTEGRATION as u32;

/// The state of one world. Body positions, velocities and joints always belong to the same instant.
pub struct Simulation {
    pub(super) data: Data,
    /// The scene that it began in, which it shares with others.
    pub(super) nominal: Arc<MjModel>,
    /// How its physics differ from that scene.
    pub(super) variation: Option<Variation>,
}

impl Simulation {
    /// Creates a simulation of `scene` in its default state.
    pub fn new(scene: &Scene) -> Self {
        Self {
            data: MjData::new(scene.model.clone()),
            nominal: scene.model.clone(),
            variation: None,
        }
    }

    /// Computes with the physics of this simulation.
    pub(super) fn compute<T>(&mut self, act: impl FnOnce(&mut Data) -> T) -> T {
        compute(&mut self.data, &self.nominal, self.variation.as_ref(), act)
    }

    /// Resets to the default state and clears warm start and warnings. Call [`Simulation::refresh`] after changing the state.
    pub fn reset(&mut self) {
        self.data.reset();
    }

    /// Updates body positions and velocities to `qpos` and `qvel`.
    pub fn refresh(&mut self) {
        self.compute(|data| data.step1());
    }

    /// Takes `substeps` physics steps with constant controls. Returns whether the state diverged: it or a control was not finite or
    /// was far too large, and MuJoCo has reset what it could not use.
    ///
    /// `mj_step` would leave the bodies one substep behind the joints. Its two halves in the opposite order are bit for bit the
    /// same computation and end with both at the same instant.
    #[must_use]
    pub fn step(&mut self, substeps: usize) -> bool {
        self.compute(|data| diverges(data, substeps))
    }

    /// Takes `substeps` physics steps as [`Simulation::step`] does. After the last one, only the poses and the velocities of the bodies are
    /// up to date, and the next step needs a [`Simulation::refresh`].
    #[must_use]
    pub fn step_to_observe(&mut self, substeps: usize) -> bool {
        self.compute(|data| {
            if diverges(data, substeps - 1) {
                return true;
            }
            data.step2();
            data.kinematics();
            data.com_pos();
            data.com_vel();
            diverged(data)
        })
    }

    /// Takes `substeps` steps of plain `mj_step`: the physics alone, for comparison. The bodies are one substep behind the joints.
    pub fn step_whole(&mut self, substeps: usize) {
        self.compute(|data| (0..substeps).for_each(|_| data.step()));
    }

    /// The generalised positions, in the model's order: rad, m, and quaternions.
    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    /// The same, to be changed. [`Simulation::refresh`] must follow.
    pub fn qpos_mut(&mut self) -> &mut [f64] {
        self.data.qpos_mut()
    }

    /// The generalised velocities, in the model's order: rad/s and m/s.
    pub fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// The same, to be changed. [`Simulation::refresh`] must follow.
    pub fn qvel_mut(&mut self) -> &mut [f64] {
        self.data.qvel_mut()
    }

    /// Moves each joint that follows another by an equality constraint to where the constraint wants it. Returns whether all these
    /// constraints hold then. [`Simulation::refresh`] must follow.
    pub fn follow(&mut self) -> bool {
        let model = self.nominal.clone();
        let ties: Vec<_> = ids(model.neq())
            .filter(|&i| model.eq_type()[i] == mjEQ_JOINT && model.eq_active0()[i])
            .collect();
        // A joint may follow one that follows.
        (0..=ties.len()).any(|_| {
            let mut apart: f64 = 0.0;
            for &tie in &ties {
                let qpos = self.qpos_mut();
                // Without a second joint, the first is held where it is.
                let other = model
                    .jnt_qposadr()
                    .get(model.eq_obj2id()[tie] as usize)
                    .map_or(0.0, |&at| qpos[at as usize] - model.qpos0()[at as usize]);
                let wanted = model.eq_data()[tie][..5]
                    .iter()
                    .rfold(0.0, |sum, factor| sum * other + factor);
                let own = model.jnt_qposadr()[model.eq_obj1id()[tie] as usize] as usize;
                let wanted = model.qpos0()[own] + wanted;
                apart = apart.max((qpos[own] - wanted).abs());
                qpos[own] = wanted;
            }
            apart < 1e-9
        })
    }

    /// The controls, in the model's order.
    pub fn ctrl(&self) -> &[f64] {
        self.data.ctrl()
    }

    /// The same, to be changed.
    pub fn ctrl_mut(&mut self) -> &mut [f64] {
        self.data.ctrl_mut()
    }

    /// Everything that the next step depends on, in the order of MuJoCo's `mj_getState` for `mjSTATE_INTEGRATION`.
    pub fn state(&self) -> Box<[f64]> {
        self.data.state(EVERYTHING)
    }

    /// Resumes from the values of a state, with bodies up to date. The next step is bit for bit the next step of the
    /// simulation that the state was taken from.
    ///
    /// # Errors
    /// Fails if the state is of another scene or has diverged.
    pub fn restore(&mut self, numbers: &[f64]) -> Result<()> {
        let size = self.data.model().state_size(EVERYTHING);
        ensure!(
            numbers.len() == size,
            "the state has {} values, but this scene needs {size}",
            numbers.len()
        );
        self.data.reset();
        self.data.set_state(numbers, EVERYTHING)?;
        self.refresh();
        ensure!(
            !diverged(&self.data),
            "MuJoCo cannot resume from this state"
        );
        Ok(())
    }

    /// The length of an actuator: an angle, a sum of angles, or the length of a tendon in m.
    pub fn length(&self, actuator: Actuator) -> f64 {
        self.data.actuator_length()[actuator.id]
    }

    /// The angle between what carries a body and a floor under it, rad: between the mean normal of the contacts at its tree of bodies,
    /// in proportion to their forces, and the direction against gravity. Returns `None` if nothing presses against it, or without gravity.
    pub fn tilt(&mut self, Body(id): Body) -> Option<f64> {
        // A step ends with contacts without forces.
        self.compute(|data| data.forward());
        let model = self.data.model();
        let own = |geom: i32| {
            let body = model.geom_bodyid().get(geom as usize);
            body.is_some_and(|&body| model.body_rootid()[body as usize] == model.body_rootid()[id])
        };
        let mut sum = [0.0; 3];
        for (i, contact) in self.data.contact().iter().enumerate() {
            let [of_first, of_second] = contact.geom.map(own);
            if of_first == of_second {
                continue;
            }
            let [force, ..] = self.data.contact_force(i);
            // The normal points from the first geom to the second one.
            let sign = if of_second { 1.0 } else { -1.0 };
            for (sum, normal) in sum.iter_mut().zip(contact.frame) {
                *sum += sign * force * normal;
            }
        }
        let down = model.opt().gravity;
        let product = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let lengths = (product(sum, sum) * product(down, down)).sqrt();
        (lengths > 0.0).then(|| (-product(sum, down) / lengths).clamp(-1.0, 1.0).acos())
    }

    /// The pose of a frame.
    pub fn pose(&self, frame: Frame) -> Pose {
        match frame {
            Frame::Body(Body(id)) => Pose {
                position: self.data.xpos()[id],
                orientation: self.data.xquat()[id],
            },
            Frame::Site(id) => {
                let model = self.data.model();
                let body = self.data.xquat()[model.site_bodyid()[id] as usize];
                Pose {
                    position: self.data.site_xpos()[id],
                    orientation: quat::mul(body, model.site_quat()[id]),
                }
            }
        }
    }

    /// The velocity of a frame at its origin.
    pub fn velocity(&self, frame: Frame) -> Velocity {
        let (kind, id) = match frame {
            // XBODY is the frame's origin. BODY would be the centre of mass.
            Frame::Body(Body(id)) => (mjOBJ_XBODY, id),
            Frame::Site(id) => (mjOBJ_SITE, id),
        };
        let [wx, wy, wz, x, y, z] = self.data.object_velocity(kind, id, false);
        Velocity {
            linear: [x, y, z],
            angular: [wx, wy, wz],
        }
    }

    /// The pose of a body with a free joint.
    pub fn free_pose(&self, joint: &FreeJoint) -> Pose {
        let [x, y, z, orientation @ ..] = *self.qpos()[joint.qpos..]
            .first_chunk::<7>()
            .expect("a free joint");
        Pose {
            position: [x, y, z],
            orientation,
        }
    }

    /// The velocity of a body with a free joint.
    pub fn free_velocity(&self, joint: &FreeJoint) -> Velocity {
        let [x, y, z, spin @ ..] = *self.qvel()[joint.dof..]
            .first_chunk::<6>()
            .expect("a free joint");
        // MuJoCo stores the angular velocity of a free joint in the body's frame.
        Velocity {
            linear: [x, y, z],
            angular: quat::rotate(self.free_pose(joint).orientation, spin),
        }
    }

    /// Applies a force (N, world frame) to the centre of mass of a body. It acts in all steps until it is replaced or the state
    /// is reset.
    pub fn push(&mut self, Body(id): Body, force: [f64; 3]) {
        self.data.xfrc_applied_mut()[id][..3].copy_from_slice(&force);
    }

    /// Applies a torque (N m, world frame) to a body in all steps until it is replaced or the state is reset.
    pub fn twist(&mut self, Body(id): Body, torque: [f64; 3]) {
        self.data.xfrc_applied_mut()[id][3..].copy_from_slice(&torque);
    }

    /// Sets the pose of a mocap body.
    pub fn place(
        &mut self,
        Mocap(id): Mocap,
        Pose {
            position,
            orientation,
        }: Pose,
    ) {
        self.data.mocap_pos_mut()[id] = position;
        self.data.mocap_quat_mut()[id] = orientation;
    }
}

/// Takes steps as [`Simulation::step`] does.
fn diverges(data: &mut Data, substeps: usize) -> bool {
    (0..substeps).any(|_| {
        data.step2();
        data.step1();
        diverged(data)
    })
}

/// Whether the state diverged. MuJoCo resets it silently within the step. Only its warning counters show it.
fn diverged(data: &Data) -> bool {
    let warnings = data.warning();
    [
        mjWARN_BADQPOS,
        mjWARN_BADQVEL,
        mjWARN_BADQACC,
        mjWARN_BADCTRL,
    ]
    .iter()
    .any(|&kind| warnings[kind as usize].number > 0)
}

/// The pose of a frame in the world.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// Position, m.
    pub position: [f64; 3],
    /// Orientation, w,x,y,z.
    pub orientation: Quat,
}

/// The velocity of a point of a body, in the world frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Velocity {
    /// Linear velocity, m/s.
    pub linear: [f64; 3],
    /// Angular velocity, rad/s.
    pub angular: [f64; 3],
}
