//! Variations of a compiled scene: the physics of the same bodies with other masses, friction, servos, joints or gravity.
//!
//! This is the only place where the physics of a scene is varied, for a whole task and for single episodes. Every variation is
//! applied to the scene's own values, so that variations do not add up.

#![expect(unsafe_code, reason = "two calls of MuJoCo that the wrapper cannot check; each says why it is sound")]

use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Result, ensure};
use mujoco_rs::mujoco_c::mj_copyModel;
use mujoco_rs::prelude::{MjData, MjModel};

use super::{Actuator, Body, Hinge, Scene, Simulation};

/// Changes to the physics of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Variation {
    /// The factor on the friction coefficients of every geom and every pair of geoms.
    pub friction: f64,
    /// Bodies, with the factor on the mass and inertia of each and of its descendants.
    pub masses: Vec<(Body, f64)>,
    /// A body, and the offset of its centre of mass in its own frame, m. The scene must have been compiled with
    /// [`super::Compilation::shifts`] if the offset is not zero.
    pub shift: Option<(Body, [f64; 3])>,
    /// Position servos, with the factor on the stiffness (kp) of each.
    pub gains: Vec<(Actuator, f64)>,
    /// Joints, with the factor on the damping of each.
    pub damping: Vec<(Hinge, f64)>,
    /// Joints, with the factor on the friction loss of each.
    pub frictionloss: Vec<(Hinge, f64)>,
    /// The acceleration that is added to gravity, m/s².
    pub gravity: [f64; 3],
}

impl Default for Variation {
    /// Returns the variation that changes nothing.
    fn default() -> Self {
        Self {
            friction: 1.0,
            masses: Vec::new(),
            shift: None,
            gains: Vec::new(),
            damping: Vec::new(),
            frictionloss: Vec::new(),
            gravity: [0.0; 3],
        }
    }
}

impl Variation {
    /// Changes what MuJoCo does not derive other values from.
    fn apply(&self, model: &mut MjModel) {
        let scale = |values: &mut [f64], factor: f64| values.iter_mut().for_each(|x| *x *= factor);
        scale(model.geom_friction_mut().as_flattened_mut(), self.friction);
        scale(model.pair_friction_mut().as_flattened_mut(), self.friction);
        for &(Body(top), factor) in &self.masses {
            // Every body has a higher number than its parent.
            let mut below = vec![false; model.nbody() as usize];
            for body in top..below.len() {
                below[body] = body == top || below[model.body_parentid()[body] as usize];
                if below[body] {
                    model.body_mass_mut()[body] *= factor;
                    scale(&mut model.body_inertia_mut()[body], factor);
                }
            }
        }
        if let Some((Body(body), offset)) = self.shift {
            model.body_ipos_mut()[body].iter_mut().zip(offset).for_each(|(x, by)| *x += by);
        }
        for &(actuator, factor) in &self.gains {
            // SAFETY: this changes the stiffness of a position servo, which is not an index or a size.
            unsafe { model.actuator_gainprm_mut()[actuator.id][0] *= factor };
            model.actuator_biasprm_mut()[actuator.id][1] *= factor;
        }
        for &(joint, factor) in &self.damping {
            model.dof_damping_mut()[joint.dof] *= factor;
            scale(&mut model.dof_dampingpoly_mut()[joint.dof], factor);
        }
        for &(joint, factor) in &self.frictionloss {
            model.dof_frictionloss_mut()[joint.dof] *= factor;
        }
        model.opt_mut().gravity.iter_mut().zip(self.gravity).for_each(|(x, by)| *x += by);
    }

    /// Returns whether MuJoCo derives other values from what is changed, such as the scale of contact forces from the masses.
    fn is_structural(&self) -> bool {
        self.masses.iter().any(|&(_, factor)| factor != 1.0) || self.shift.is_some_and(|(_, offset)| offset != [0.0; 3])
    }
}

impl Scene {
    /// Returns this scene with a variation.
    pub fn varied(&self, variation: &Variation) -> Self {
        let mut model = (*self.model).clone();
        variation.apply(&mut model);
        if variation.is_structural() {
            model = with_constants(MjData::new(Box::new(model)));
        }
        Self { model: Arc::new(model), origin: self.origin.clone() }
    }
}

/// Updates what MuJoCo derives from masses at compile time, and returns the model.
fn with_constants(mut data: MjData<Box<MjModel>>) -> MjModel {
    data.set_const();
    data.model().clone()
}

/// Scenes that simulations can switch between, each time with another variation.
pub struct Variants {
    scenes: Vec<Scene>,
    /// Workspaces for updating the constants of a model, one for each thread that has needed one at the same time.
    workspaces: Mutex<Vec<MjData<Box<MjModel>>>>,
}

impl Variants {
    /// Creates the variants from scenes that differ only in sizes.
    ///
    /// # Errors
    /// Fails if they differ in their structure.
    pub fn new(scenes: Vec<Scene>) -> Result<Self> {
        let alike = scenes.windows(2).all(|pair| pair[0].model.is_compatible_with_model(&pair[1].model));
        ensure!(alike, "{}: with another size it has another structure", scenes[0].origin);
        Ok(Self { scenes, workspaces: Mutex::default() })
    }

    /// Returns a scene (by number) with a variation.
    pub fn scene(&self, scene: usize, variation: &Variation) -> Scene {
        self.scenes[scene].varied(variation)
    }

    /// Gives `simulation` a model of its own, that of a scene (by number) with a variation, and resets its state.
    ///
    /// # Panics
    /// Panics if the simulation belongs to another scene.
    pub fn vary(&self, simulation: &mut Simulation, scene: usize, variation: &Variation) {
        let scene = &self.scenes[scene].model;
        let mut model = simulation.take_own_model().unwrap_or_else(|| (**scene).clone());
        assert!(model.is_compatible_with_model(scene), "scenes that differ only in sizes");
        // SAFETY: MuJoCo copies one model over another of the same sizes. It checks the sizes of their buffers itself, and ends the
        // process if they differ; both come from the same scene, so they do not.
        unsafe { mj_copyModel(model.ffi_mut(), scene.ffi()) };
        variation.apply(&mut model);
        if variation.is_structural() {
            model = self.update_constants(model);
        }
        simulation.set_own_model(model);
    }

    fn update_constants(&self, model: MjModel) -> MjModel {
        let mut own = Box::new(model);
        let free = || self.workspaces.lock().unwrap_or_else(PoisonError::into_inner);
        let workspace = free().pop();
        let mut workspace = workspace.unwrap_or_else(|| MjData::new(own.clone()));
        own = workspace.swap_model(own);
        workspace.set_const();
        own = workspace.swap_model(own);
        free().push(workspace);
        *own
    }
}

#[cfg(test)]
mod tests {
    use super::super::Compilation;
    use super::super::compilation::BUILTIN;
    use super::*;

    #[test]
    fn the_boxes_of_a_shifted_body_are_those_that_mujoco_compiles() {
        // The boxes in which contacts are searched are kept in the frame of the inertia; `mj_setConst` updates them.
        let compilation = Compilation { object: "cube", shifts: true, ..Compilation::plain(0.01) };
        let scene = Scene::load(None, &compilation).unwrap();
        let shift = Some((scene.body("cube").unwrap(), [0.01, -0.004, 0.002]));
        let shifted = scene.varied(&Variation { shift, ..Variation::default() }).model;
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
