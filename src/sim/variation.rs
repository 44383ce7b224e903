//! Variations of a compiled scene: the physics of the same bodies with other masses, friction, servos, joints or gravity.
//!
//! This is the only place where the physics of a scene is varied, for a whole task and for single episodes. Every variation is
//! applied to the scene's own values, so that variations do not add up.

#![expect(
    unsafe_code,
    reason = "two things that the wrapper does not let do; each comment says why it is sound"
)]

use std::sync::Arc;

use mujoco_rs::mujoco_c::{mj_copyModel, mj_setConst};
use mujoco_rs::prelude::{MjData, MjModel};

use super::placing::frames_within;
use super::sharing::{Data, Varied};
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
        let mut model = (*self.model).clone();
        change(&mut model, changes, &mut MjData::new(self.model.clone()));
        Self {
            model: Arc::new(model),
            ..*self
        }
    }

    /// Whether it differs from another scene only in its numbers, so that a simulation can change from one to the other.
    pub fn has_structure_of(&self, other: &Self) -> bool {
        self.model.is_compatible_with_model(&other.model)
    }
}

impl Simulation {
    /// Continues in a scene with these changes. The state must be reset after it.
    ///
    /// # Panics
    /// Panics if the structure of the scene is another one.
    pub fn change_scene(&mut self, scene: &Scene, changes: &[Change]) {
        self.data.swap_model(scene.model.clone());
        self.variation = None;
        if changes.is_empty() {
            return;
        }
        let mut varied = Varied::take(&self.nominal);
        // SAFETY: MuJoCo copies one model over another of the same sizes. It checks the sizes of their buffers itself, and ends the
        // process if they differ. The data could not have taken a scene of another structure.
        unsafe { mj_copyModel(varied.model().ffi_mut(), scene.model.ffi()) };
        change(varied.model(), changes, &mut self.data);
        self.variation = Some(varied.leave());
    }
}

/// Makes these changes in a model, and what MuJoCo derives from masses at compile time. Overwrites the state of the data.
fn change(model: &mut MjModel, changes: &[Change], data: &mut Data) {
    changes.iter().for_each(|change| change.apply(model));
    if changes.iter().any(Change::is_structural) {
        // SAFETY: the data is of a model of the same structure.
        unsafe { mj_setConst(model.ffi_mut(), data.ffi_mut()) };
    }
}

#[cfg(test)]
mod tests {
    use super::super::compilation::BUILTIN;
    use super::super::sharing::arrays;
    use super::super::{Compilation, Cone};
    use super::*;

    #[test]
    fn simulations_of_a_thread_share_a_model_and_keep_what_differs() {
        let compilation = Compilation {
            object: "cube".into(),
            ..Compilation::plain(0.01, Cone::Scene)
        };
        let scene = Scene::load(None, &compilation).unwrap();
        let larger = Scene::load(
            None,
            &Compilation {
                size: 1.2,
                ..compilation
            },
        )
        .unwrap();
        let cube = scene.body("cube").unwrap();
        let changes = |factor| [Change::Mass(cube, factor), Change::Friction(factor)];
        let episodes = [
            (&scene, Vec::from(changes(2.0))),
            (&larger, Vec::from(changes(0.5))),
            (&scene, vec![Change::Gravity([0.0, 0.0, 1.0])]),
            (&larger, vec![]),
        ];
        let mut simulations = episodes.clone().map(|(of, changes)| {
            let mut simulation = Simulation::new(&scene);
            simulation.change_scene(of, &changes);
            simulation
        });
        let mut places = Vec::new();
        for _ in 0..2 {
            for (simulation, (of, changes)) in simulations.iter_mut().zip(&episodes) {
                let own = of.varied(changes).model;
                simulation.compute(|data| {
                    let model = data.model();
                    assert!(arrays(model) == arrays(&own));
                    let [options, expected] =
                        [model, &own].map(|model| format!("{:?}", model.opt()));
                    assert_eq!(options, expected);
                    places.push(std::ptr::from_ref(model.ffi()));
                });
            }
        }
        let resting = std::ptr::from_ref(larger.model.ffi());
        assert_eq!(places[..4], [places[0], places[0], places[0], resting]);
        assert_eq!(places[..4], places[4..]);
        let kept = simulations[0].variation.as_ref().unwrap().bytes.len();
        assert!(kept < arrays(&scene.model).len() / 10, "{kept}");
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
