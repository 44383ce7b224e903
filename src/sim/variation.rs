//! Variations of a compiled scene: the physics of the same bodies with other masses, friction, servos, joints or gravity.
//!
//! This is the only place where the physics of a scene is varied, for a whole task and for single episodes. Every variation is
//! applied to the scene's own values, so that variations do not add up.

#![expect(
    unsafe_code,
    reason = "two things that the wrapper does not let do; each comment says why it is sound"
)]

use std::cell::RefCell;
use std::sync::Arc;

use mujoco_rs::mujoco_c::mj_copyModel;
use mujoco_rs::prelude::{MjData, MjModel};

use super::placing::frames_within;
use super::{Actuator, Body, Hinge, Scene, Simulation};

/// A change of the physics of a scene.
#[derive(Clone, Copy)]
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
        let add = |values: &mut [f64; 3], by: [f64; 3]| {
            values.iter_mut().zip(by).for_each(|(x, by)| *x += by)
        };
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
        Self {
            model: Arc::new(changed((*self.model).clone(), changes)),
            ..*self
        }
    }

    /// Whether it differs from another scene only in its numbers, so that a simulation can change from one to the other.
    pub fn has_structure_of(&self, other: &Self) -> bool {
        self.model.is_compatible_with_model(&other.model)
    }
}

impl Simulation {
    /// Continues in a scene with these changes. The state must be reset after it. A scene with meshes is large, so the simulation
    /// overwrites its own model rather than making another one in each episode.
    ///
    /// # Panics
    /// Panics if the structure of the scene is another one.
    pub fn change_scene(&mut self, scene: &Scene, changes: &[Change]) {
        let before = self.data.swap_model(scene.model.clone());
        self.spare = Arc::into_inner(before).or_else(|| self.spare.take());
        if changes.is_empty() {
            return;
        }
        let mut model = self.spare.take().unwrap_or_else(|| (*scene.model).clone());
        // SAFETY: MuJoCo copies one model over another of the same sizes. It checks the sizes of their buffers itself, and ends the
        // process if they differ. Both have been models of this simulation, which takes no others.
        unsafe { mj_copyModel(model.ffi_mut(), scene.model.ffi()) };
        self.data.swap_model(Arc::new(changed(model, changes)));
    }
}

thread_local! {
    /// What updates the constants of a model, from the last time.
    static WORKSPACE: RefCell<Option<MjData<Box<MjModel>>>> = const { RefCell::new(None) };
}

/// A model with these changes, and with what MuJoCo derives from masses at compile time.
fn changed(mut model: MjModel, changes: &[Change]) -> MjModel {
    changes.iter().for_each(|change| change.apply(&mut model));
    if !changes.iter().any(Change::is_structural) {
        return model;
    }
    WORKSPACE.with_borrow_mut(|kept| {
        let fitting = kept.take_if(|data| data.model().is_compatible_with_model(&model));
        let workspace =
            kept.insert(fitting.unwrap_or_else(|| MjData::new(Box::new(model.clone()))));
        let between = workspace.swap_model(Box::new(model));
        workspace.set_const();
        *workspace.swap_model(between)
    })
}

#[cfg(test)]
mod tests {
    use super::super::compilation::BUILTIN;
    use super::super::{Compilation, Cone};
    use super::*;

    #[test]
    fn a_simulation_overwrites_its_own_model_in_each_varied_episode() {
        let scene = Scene::load(None, &Compilation::plain(0.01, Cone::Scene)).unwrap();
        let cube = scene.body("cube").unwrap();
        let mut simulation = Simulation::new(&scene);
        let mut places = Vec::new();
        for factor in [2.0, 1.0, 0.5, 2.0] {
            let changes = [Change::Mass(cube, factor), Change::Friction(factor)];
            let drawn = if factor == 1.0 { &[][..] } else { &changes };
            simulation.change_scene(&scene, drawn);
            let model = simulation.data.model();
            let own = Scene {
                model: Arc::new(model.clone()),
                ..scene
            };
            assert_eq!(own.fingerprint(), scene.varied(drawn).fingerprint());
            places.push(std::ptr::from_ref(model.ffi()));
        }
        let shared = std::ptr::from_ref(scene.model.ffi());
        assert_eq!(places, [places[0], shared, places[0], places[0]]);
        assert_ne!(places[0], shared);
    }

    #[test]
    fn the_boxes_of_a_shifted_body_are_those_that_mujoco_compiles() {
        // The boxes in which contacts are searched are kept in the frame of the inertia. `mj_setConst` updates them.
        let compilation = Compilation {
            object: "cube".into(),
            shifts: true,
            ..Compilation::plain(0.01, Cone::Scene)
        };
        let scene = Scene::load(None, &compilation).unwrap();
        let shift = Change::CentreOfMass(scene.body("cube").unwrap(), [0.01, -0.004, 0.002]);
        let shifted = scene.varied(&[shift]).model;
        let joint = "<freejoint name=\"cube\"/>";
        let inertia = "<inertial pos=\".01 -.004 .002\" mass=\".028\" diaginertia=\"1.16e-5 1.16e-5 1.16e-5\"/>";
        let compiled =
            MjModel::from_xml_string(&BUILTIN.replace(joint, &format!("{joint}{inertia}")))
                .unwrap();
        let apart = |a: &[[f64; 6]], b: &[[f64; 6]]| {
            assert_eq!(a.len(), b.len());
            a.as_flattened()
                .iter()
                .zip(b.as_flattened())
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f64::max)
        };
        assert!(apart(shifted.bvh_aabb(), compiled.bvh_aabb()) < 1e-12);
        assert!(apart(scene.model.bvh_aabb(), compiled.bvh_aabb()) > 1e-3);
    }
}
