//! Variations of a compiled scene: the physics of the same bodies with other masses, friction, servos, joints or gravity.
//!
//! This is the only place where the physics of a scene is varied, for a whole task and for single episodes. Every variation is
//! applied to the scene's own values, so that variations do not add up.

#![expect(unsafe_code, reason = "two calls of MuJoCo that the wrapper cannot check; each says why it is sound")]

use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Result, ensure};
use mujoco_rs::mujoco_c::mj_copyModel;
use mujoco_rs::prelude::{MjData, MjModel};

use super::placing::frames_within;
use super::{Actuator, Body, Hinge, Scene, Simulation};

/// A change of the physics of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// The factor on the friction coefficients of every geom and every pair of geoms.
    Friction(f64),
    /// The factor on the mass and inertia of a body and of its descendants.
    Mass(Body, f64),
    /// The offset of a body's centre of mass in its own frame, m. The scene must have been compiled with
    /// [`super::Compilation::shifts`].
    CentreOfMass(Body, [f64; 3]),
    /// The factor on the stiffness (kp) of a position servo.
    Gain(Actuator, f64),
    /// The factor on the damping of a joint.
    Damping(Hinge, f64),
    /// The factor on the friction loss of a joint.
    FrictionLoss(Hinge, f64),
    /// The acceleration that is added to gravity, m/s².
    Gravity([f64; 3]),
}

impl Change {
    /// Changes what MuJoCo does not derive other values from.
    fn apply(&self, model: &mut MjModel) {
        let scale = |values: &mut [f64], factor: f64| values.iter_mut().for_each(|x| *x *= factor);
        let add = |values: &mut [f64; 3], by: [f64; 3]| values.iter_mut().zip(by).for_each(|(x, by)| *x += by);
        match *self {
            Self::Friction(factor) => {
                scale(model.geom_friction_mut().as_flattened_mut(), factor);
                scale(model.pair_friction_mut().as_flattened_mut(), factor);
            }
            Self::Mass(Body(top), factor) => {
                for (body, frame) in frames_within(model, top).iter().enumerate() {
                    if frame.is_some() {
                        model.body_mass_mut()[body] *= factor;
                        scale(&mut model.body_inertia_mut()[body], factor);
                    }
                }
            }
            Self::CentreOfMass(Body(body), offset) => add(&mut model.body_ipos_mut()[body], offset),
            Self::Gain(actuator, factor) => {
                // SAFETY: this changes the stiffness of a position servo, which is not an index or a size.
                unsafe { model.actuator_gainprm_mut()[actuator.id][0] *= factor };
                model.actuator_biasprm_mut()[actuator.id][1] *= factor;
            }
            Self::Damping(joint, factor) => {
                model.dof_damping_mut()[joint.dof] *= factor;
                scale(&mut model.dof_dampingpoly_mut()[joint.dof], factor);
            }
            Self::FrictionLoss(joint, factor) => model.dof_frictionloss_mut()[joint.dof] *= factor,
            Self::Gravity(by) => add(&mut model.opt_mut().gravity, by),
        }
    }

    /// Whether MuJoCo derives other values from what is changed, such as the scale of contact forces from the masses.
    fn is_structural(&self) -> bool {
        matches!(self, Self::Mass(..) | Self::CentreOfMass(..))
    }
}

impl Scene {
    /// This scene with these changes.
    pub fn varied(&self, changes: &[Change]) -> Self {
        Self { model: Arc::new(changed((*self.model).clone(), changes, &Workspaces::default())), ..*self }
    }
}

/// Workspaces for updating the constants of a model, one for each thread that has needed one at the same time.
type Workspaces = Mutex<Vec<MjData<Box<MjModel>>>>;

/// A model with these changes, and with what MuJoCo derives from masses at compile time.
fn changed(mut model: MjModel, changes: &[Change], workspaces: &Workspaces) -> MjModel {
    changes.iter().for_each(|change| change.apply(&mut model));
    if !changes.iter().any(Change::is_structural) {
        return model;
    }
    let mut own = Box::new(model);
    let free = || workspaces.lock().unwrap_or_else(PoisonError::into_inner);
    let workspace = free().pop();
    let mut workspace = workspace.unwrap_or_else(|| MjData::new(own.clone()));
    own = workspace.swap_model(own);
    workspace.set_const();
    own = workspace.swap_model(own);
    free().push(workspace);
    *own
}

/// Scenes that simulations can switch between, each time with other changes.
pub struct Variants {
    scenes: Vec<Scene>,
    workspaces: Workspaces,
}

impl Variants {
    /// Creates the variants from scenes that differ only in sizes.
    ///
    /// # Errors
    /// Fails if they differ in their structure.
    pub fn new(scenes: Vec<Scene>) -> Result<Self> {
        let alike = scenes.windows(2).all(|pair| pair[0].model.is_compatible_with_model(&pair[1].model));
        ensure!(alike, "its structure changes with the size of the object");
        Ok(Self { scenes, workspaces: Workspaces::default() })
    }

    /// A scene (by number) with these changes.
    pub fn scene(&self, scene: usize, changes: &[Change]) -> Scene {
        self.scenes[scene].varied(changes)
    }

    /// Gives `simulation` a model of its own: a scene (by number) with these changes. Its state must be reset after it.
    ///
    /// # Panics
    /// Panics if the simulation belongs to another scene.
    pub fn vary(&self, simulation: &mut Simulation, scene: usize, changes: &[Change]) {
        let scene = &self.scenes[scene].model;
        let mut model = simulation.take_own_model().unwrap_or_else(|| (**scene).clone());
        assert!(model.is_compatible_with_model(scene), "scenes that differ only in sizes");
        // SAFETY: MuJoCo copies one model over another of the same sizes. It checks the sizes of their buffers itself, and ends the
        // process if they differ. Both come from the same scene, so they do not.
        unsafe { mj_copyModel(model.ffi_mut(), scene.ffi()) };
        simulation.set_own_model(changed(model, changes, &self.workspaces));
    }
}

#[cfg(test)]
mod tests {
    use super::super::compilation::BUILTIN;
    use super::super::{Compilation, Cone};
    use super::*;

    #[test]
    fn the_boxes_of_a_shifted_body_are_those_that_mujoco_compiles() {
        // The boxes in which contacts are searched are kept in the frame of the inertia. `mj_setConst` updates them.
        let compilation = Compilation { object: "cube".into(), shifts: true, ..Compilation::plain(0.01, Cone::Scene) };
        let scene = Scene::load(None, &compilation).unwrap();
        let shift = Change::CentreOfMass(scene.body("cube").unwrap(), [0.01, -0.004, 0.002]);
        let shifted = scene.varied(&[shift]).model;
        let joint = "<freejoint name=\"cube\"/>";
        let inertia = "<inertial pos=\".01 -.004 .002\" mass=\".028\" diaginertia=\"1.16e-5 1.16e-5 1.16e-5\"/>";
        let compiled = MjModel::from_xml_string(&BUILTIN.replace(joint, &format!("{joint}{inertia}"))).unwrap();
        let apart = |a: &[[f64; 6]], b: &[[f64; 6]]| {
            assert_eq!(a.len(), b.len());
            a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        assert!(apart(shifted.bvh_aabb(), compiled.bvh_aabb()) < 1e-12);
        assert!(apart(scene.model.bvh_aabb(), compiled.bvh_aabb()) > 1e-3);
    }
}
