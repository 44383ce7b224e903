//! Variations of a compiled scene: the physics of the same bodies with other masses, friction, servos, joints or gravity.
//!
//! This is the only place where the physics of a scene is varied, for a whole task and for single episodes. Every variation is
//! applied to the scene's own values, so that variations do not add up.

#![expect(
    unsafe_code,
    reason = "a value that the wrapper does not let change; the comment says why it is sound"
)]

use std::sync::Arc;

use mujoco_rs::prelude::{MjData, MjModel};

use super::placing::frames_within;
use super::{Actuator, Body, Hinge, Scene};

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
    /// This scene with these changes, and with what MuJoCo derives from masses at compile time.
    pub fn varied(&self, changes: &[Change]) -> Self {
        let mut model = (*self.model).clone();
        changes.iter().for_each(|change| change.apply(&mut model));
        if changes.iter().any(Change::is_structural) {
            let mut workspace = MjData::new(Box::new(model));
            workspace.set_const();
            model = workspace.model().clone();
        }
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

#[cfg(test)]
mod tests {
    use super::super::compilation::BUILTIN;
    use super::super::{Compilation, Cone};
    use super::*;

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
