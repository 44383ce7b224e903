//! Numbers of a scene that are infinite or NaN: MuJoCo takes them as any other, and the physics diverges at once.

use mujoco_rs::prelude::{MjModel, MjtObjBase};

/// What first has such a number, and which of its numbers it is.
pub fn not_finite(model: &MjModel) -> Option<String> {
    let (body, joint) = ((MjtObjBase::mjOBJ_BODY, "body"), (MjtObjBase::mjOBJ_JOINT, "joint"));
    let (geom, actuator) = ((MjtObjBase::mjOBJ_GEOM, "geom"), (MjtObjBase::mjOBJ_ACTUATOR, "actuator"));
    let (site, tendon) = ((MjtObjBase::mjOBJ_SITE, "site"), (MjtObjBase::mjOBJ_TENDON, "tendon"));
    let count = |kind| match kind {
        MjtObjBase::mjOBJ_SITE => model.nsite() as usize,
        MjtObjBase::mjOBJ_TENDON => model.ntendon() as usize,
        MjtObjBase::mjOBJ_BODY => model.nbody() as usize,
        MjtObjBase::mjOBJ_JOINT => model.njnt() as usize,
        MjtObjBase::mjOBJ_GEOM => model.ngeom() as usize,
        _ => model.nu() as usize,
    };
    let arrays = [
        (body, "position", model.body_pos().as_flattened()),
        (body, "orientation", model.body_quat().as_flattened()),
        (body, "centre of mass", model.body_ipos().as_flattened()),
        (body, "mass", model.body_mass()),
        (body, "inertia", model.body_inertia().as_flattened()),
        (joint, "position", model.jnt_pos().as_flattened()),
        (joint, "axis", model.jnt_axis().as_flattened()),
        (joint, "range", model.jnt_range().as_flattened()),
        (joint, "stiffness", model.jnt_stiffness()),
        (joint, "margin", model.jnt_margin()),
        (joint, "solref", model.jnt_solref().as_flattened()),
        (joint, "solimp", model.jnt_solimp().as_flattened()),
        (geom, "margin", model.geom_margin()),
        (geom, "gap", model.geom_gap()),
        (geom, "position", model.geom_pos().as_flattened()),
        (geom, "orientation", model.geom_quat().as_flattened()),
        (geom, "size", model.geom_size().as_flattened()),
        (geom, "friction", model.geom_friction().as_flattened()),
        (geom, "solref", model.geom_solref().as_flattened()),
        (geom, "solimp", model.geom_solimp().as_flattened()),
        (site, "position", model.site_pos().as_flattened()),
        (tendon, "range", model.tendon_range().as_flattened()),
        (tendon, "stiffness", model.tendon_stiffness()),
        (tendon, "damping", model.tendon_damping()),
        (actuator, "gain", model.actuator_gainprm().as_flattened()),
        (actuator, "bias", model.actuator_biasprm().as_flattened()),
        (actuator, "ctrlrange", model.actuator_ctrlrange().as_flattened()),
        (actuator, "forcerange", model.actuator_forcerange().as_flattened()),
        (actuator, "gear", model.actuator_gear().as_flattened()),
    ];
    let odd = |numbers: &[f64]| numbers.iter().position(|x| !x.is_finite());
    let name = |kind, number| {
        let name = model.id_to_name(kind, number);
        name.map_or_else(|| format!("number {number}"), |name| format!("`{name}`"))
    };
    for ((kind, of), what, numbers) in arrays {
        if let Some(at) = odd(numbers) {
            return Some(format!("{what} of {of} {}", name(kind, at / (numbers.len() / count(kind)))));
        }
    }
    let of_joints =
        [("damping", model.dof_damping()), ("armature", model.dof_armature()), ("friction", model.dof_frictionloss())];
    for (what, numbers) in of_joints {
        if let Some(at) = odd(numbers) {
            return Some(format!("{what} of joint {}", name(joint.0, model.dof_jntid()[at] as usize)));
        }
    }
    let options = model.opt();
    let others = [options.gravity.as_slice(), &options.wind, &[options.density, options.viscosity, options.impratio]];
    let found = odd(&others.concat()).or(odd(model.qpos0()));
    found.map(|_| "an option (gravity, wind, density, viscosity, impratio) or a joint's reference".into())
}
