//! The check for infinite or NaN values in a scene: MuJoCo accepts them, and the physics then diverges immediately.

use mujoco_rs::prelude::{MjModel, MjtObjBase};

/// Returns a description of the first such value: the quantity and the object it belongs to.
pub(super) fn not_finite(model: &MjModel) -> Option<String> {
    let count = |kind| match kind {
        MjtObjBase::mjOBJ_SITE => model.nsite() as usize,
        MjtObjBase::mjOBJ_TENDON => model.ntendon() as usize,
        MjtObjBase::mjOBJ_BODY => model.nbody() as usize,
        MjtObjBase::mjOBJ_JOINT => model.njnt() as usize,
        MjtObjBase::mjOBJ_GEOM => model.ngeom() as usize,
        _ => model.nu() as usize,
    };
    let odd = |numbers: &[f64]| numbers.iter().position(|x| !x.is_finite());
    let name = |kind, number| {
        let name = model.id_to_name(kind, number);
        name.map_or_else(|| format!("number {number}"), |name| format!("`{name}`"))
    };
    for ((kind, of), what, numbers) in arrays(model) {
        if let Some(at) = odd(numbers) {
            return Some(format!("{what} of {of} {}", name(kind, at / (numbers.len() / count(kind)))));
        }
    }
    let of_joints =
        [("damping", model.dof_damping()), ("armature", model.dof_armature()), ("friction", model.dof_frictionloss())];
    for (what, numbers) in of_joints {
        if let Some(at) = odd(numbers) {
            return Some(format!("{what} of joint {}", name(JOINT.0, model.dof_jntid()[at] as usize)));
        }
    }
    let options = model.opt();
    let others = [options.gravity.as_slice(), &options.wind, &[options.density, options.viscosity, options.impratio]];
    let found = odd(&others.concat()).or(odd(model.qpos0()));
    found.map(|_| "an option (gravity, wind, density, viscosity, impratio) or a joint's reference".into())
}

/// A kind of object and its name in messages.
type Kind = (MjtObjBase, &'static str);

const BODY: Kind = (MjtObjBase::mjOBJ_BODY, "body");
const JOINT: Kind = (MjtObjBase::mjOBJ_JOINT, "joint");
const GEOM: Kind = (MjtObjBase::mjOBJ_GEOM, "geom");
const SITE: Kind = (MjtObjBase::mjOBJ_SITE, "site");
const TENDON: Kind = (MjtObjBase::mjOBJ_TENDON, "tendon");
const ACTUATOR: Kind = (MjtObjBase::mjOBJ_ACTUATOR, "actuator");

/// Returns arrays of values, each with the kind of its objects and the name of the quantity; values are ordered by object.
fn arrays(model: &MjModel) -> [(Kind, &'static str, &[f64]); 29] {
    [
        (BODY, "position", model.body_pos().as_flattened()),
        (BODY, "orientation", model.body_quat().as_flattened()),
        (BODY, "centre of mass", model.body_ipos().as_flattened()),
        (BODY, "mass", model.body_mass()),
        (BODY, "inertia", model.body_inertia().as_flattened()),
        (JOINT, "position", model.jnt_pos().as_flattened()),
        (JOINT, "axis", model.jnt_axis().as_flattened()),
        (JOINT, "range", model.jnt_range().as_flattened()),
        (JOINT, "stiffness", model.jnt_stiffness()),
        (JOINT, "margin", model.jnt_margin()),
        (JOINT, "solref", model.jnt_solref().as_flattened()),
        (JOINT, "solimp", model.jnt_solimp().as_flattened()),
        (GEOM, "margin", model.geom_margin()),
        (GEOM, "gap", model.geom_gap()),
        (GEOM, "position", model.geom_pos().as_flattened()),
        (GEOM, "orientation", model.geom_quat().as_flattened()),
        (GEOM, "size", model.geom_size().as_flattened()),
        (GEOM, "friction", model.geom_friction().as_flattened()),
        (GEOM, "solref", model.geom_solref().as_flattened()),
        (GEOM, "solimp", model.geom_solimp().as_flattened()),
        (SITE, "position", model.site_pos().as_flattened()),
        (TENDON, "range", model.tendon_range().as_flattened()),
        (TENDON, "stiffness", model.tendon_stiffness()),
        (TENDON, "damping", model.tendon_damping()),
        (ACTUATOR, "gain", model.actuator_gainprm().as_flattened()),
        (ACTUATOR, "bias", model.actuator_biasprm().as_flattened()),
        (ACTUATOR, "ctrlrange", model.actuator_ctrlrange().as_flattened()),
        (ACTUATOR, "forcerange", model.actuator_forcerange().as_flattened()),
        (ACTUATOR, "gear", model.actuator_gear().as_flattened()),
    ]
}
