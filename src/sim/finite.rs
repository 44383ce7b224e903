//! The check for infinite or NaN values in a scene: MuJoCo accepts them, and the physics then diverges immediately.

use std::fmt::Debug;

use mujoco_rs::prelude::{MjModel, MjtObjBase};

/// Lists the arrays of a model by kind of object: the kind, its name, the array's name, and the first object with a value that is
/// not finite.
macro_rules! arrays {
    ($model:ident, $($kind:ident $of:literal: $($array:ident)*;)*) => {
        [$($((MjtObjBase::$kind, $of, stringify!($array), first_odd($model.$array()))),*),*]
    };
}

/// Returns a description of the first such value: the quantity, by MuJoCo's name, and the object it belongs to.
pub(super) fn not_finite(model: &MjModel) -> Option<String> {
    let by_object = arrays! { model,
        mjOBJ_BODY "body": body_pos body_quat body_ipos body_iquat body_mass body_inertia body_gravcomp;
        mjOBJ_JOINT "joint": jnt_pos jnt_axis jnt_range jnt_stiffness jnt_margin jnt_solref jnt_solimp jnt_actfrcrange;
        mjOBJ_GEOM "geom": geom_pos geom_quat geom_size geom_friction geom_margin geom_gap geom_solmix geom_solref geom_solimp;
        mjOBJ_SITE "site": site_pos site_quat;
        mjOBJ_TENDON "tendon": tendon_range tendon_stiffness tendon_damping tendon_frictionloss tendon_armature;
        mjOBJ_ACTUATOR "actuator": actuator_gainprm actuator_biasprm actuator_ctrlrange actuator_forcerange actuator_gear;
    };
    let by_dof = arrays! { model, mjOBJ_JOINT "joint": dof_damping dof_armature dof_frictionloss; };
    let joint = |dof: usize| model.dof_jntid()[dof] as usize;
    let by_dof = by_dof.map(|(kind, of, array, dof)| (kind, of, array, dof.map(joint)));
    let found = by_object.into_iter().chain(by_dof).find_map(|(kind, of, array, at)| Some((kind, of, array, at?)));
    if let Some((kind, of, array, at)) = found {
        let name = model.id_to_name(kind, at).map_or_else(|| format!("number {at}"), |name| format!("`{name}`"));
        return Some(format!("{array} of {of} {name}"));
    }
    let options = model.opt();
    let others = [&options.gravity[..], &options.wind, &[options.density, options.viscosity, options.impratio]];
    let found = first_odd(&others.concat()).or(first_odd(model.qpos0()));
    found.map(|_| "an option (gravity, wind, density, viscosity, impratio) or a joint's reference".into())
}

/// Returns the first object with a value that is not finite.
fn first_odd(objects: &[impl Debug]) -> Option<usize> {
    let is_odd = |text: String| text.contains("NaN") || text.contains("inf");
    objects.iter().position(|values| is_odd(format!("{values:?}")))
}
