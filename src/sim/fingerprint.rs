//! What identifies the physics of a scene, apart from its path, its names and its look.

use std::fmt::Debug;

use mujoco_rs::prelude::MjModel;

use super::constants::*;
use super::placing::touches;

/// Lists these arrays of a model, or what one geom has in each.
macro_rules! arrays {
    ($model:ident: $($array:ident)*) => { &[$(&$model.$array()),*] };
    ($model:ident[$geom:ident]: $($array:ident)*) => { &[$(&$model.$array()[$geom]),*] };
}

/// Lists these arrays of a model, but only where something in them differs from MuJoCo's default.
macro_rules! unusual {
    ($model:ident: $($array:ident $default:expr),*) => {
        [$($model.$array().iter().any(|x| *x != $default).then(|| format!("{} {:?}\n", stringify!($array), $model.$array()))),*]
    };
}

/// A checksum (CRC-32), as hexadecimal digits, of everything in a scene that changes its motion. Geoms that collide with
/// nothing are left out, and so are sensors, keyframes, plugins and the storage of Jacobians. The quantities of the second list
/// count only where they are unusual, so that the checksum of other scenes stays the same when the list grows.
pub(super) fn fingerprint(model: &MjModel) -> String {
    let mut hasher = crc32fast::Hasher::new();
    let mut take = |parts: &[&dyn Debug]| {
        for part in parts {
            hasher.update(format!("{part:?}\n").as_bytes());
        }
    };
    let mut options = model.opt().clone();
    options.jacobian = mjJAC_AUTO as i32;
    take(&[&options]);
    take(arrays! { model:
        qpos0 qpos_spring
        body_parentid body_mocapid body_pos body_quat body_ipos body_iquat body_mass body_inertia body_gravcomp
        jnt_type jnt_bodyid jnt_pos jnt_axis jnt_limited jnt_range jnt_margin jnt_stiffness jnt_solref jnt_solimp
        jnt_actfrclimited jnt_actfrcrange jnt_actgravcomp
        dof_armature dof_damping dof_frictionloss dof_solref dof_solimp
    });
    take_geoms(model, &mut take);
    take(arrays! { model:
        site_bodyid site_pos site_quat
        wrap_type wrap_objid wrap_prm tendon_adr tendon_num tendon_limited tendon_range tendon_stiffness tendon_damping
        tendon_frictionloss tendon_lengthspring tendon_armature
        actuator_trntype actuator_trnid actuator_gear actuator_dyntype actuator_dynprm actuator_gaintype actuator_gainprm
        actuator_biastype actuator_biasprm actuator_ctrllimited actuator_ctrlrange actuator_forcelimited
        actuator_forcerange
        eq_type eq_obj1id eq_obj2id eq_active0 eq_data eq_solref eq_solimp exclude_signature
        pair_signature pair_dim pair_friction pair_solref pair_margin pair_gap
    });
    let none = [0.0; 2];
    let solref = [0.02, 1.0];
    let solimp = [0.9, 0.95, 0.001, 0.5, 2.0];
    let unusual = unusual! { model:
        actuator_armature 0.0, actuator_damping 0.0, actuator_dampingpoly none, dof_dampingpoly none, jnt_stiffnesspoly none,
        tendon_dampingpoly none, tendon_stiffnesspoly none, tendon_solref_lim solref, tendon_solimp_lim solimp,
        tendon_solref_fri solref, tendon_solimp_fri solimp, tendon_margin 0.0, tendon_actfrclimited false, tendon_actfrcrange none,
        pair_solimp solimp, pair_solreffriction none
    };
    for line in unusual.into_iter().flatten() {
        hasher.update(line.as_bytes());
    }
    format!("{:08x}", hasher.finalize())
}

/// Takes the shapes that can touch something.
fn take_geoms(model: &MjModel, take: &mut dyn FnMut(&[&dyn Debug])) {
    for geom in ids(model.ngeom()) {
        if !touches(model, geom) {
            continue;
        }
        take(arrays! { model[geom]:
            geom_type geom_bodyid geom_pos geom_quat geom_size geom_contype geom_conaffinity geom_condim geom_priority
            geom_friction geom_solmix geom_solref geom_solimp geom_margin geom_gap geom_fluid
        });
        if model.geom_type()[geom] == mjGEOM_MESH {
            let mesh = model.geom_dataid()[geom] as usize;
            let first = model.mesh_vertadr()[mesh] as usize;
            take(&[&&model.mesh_vert()[first..][..model.mesh_vertnum()[mesh] as usize]]);
        } else if model.geom_type()[geom] == mjGEOM_HFIELD {
            let field = model.geom_dataid()[geom] as usize;
            let first = model.hfield_adr()[field] as usize;
            let count = model.hfield_nrow()[field] * model.hfield_ncol()[field];
            take(&[
                &model.hfield_size()[field],
                &&model.hfield_data()[first..][..count as usize],
            ]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Compilation, Cone, Scene};

    #[test]
    fn a_scene_is_recognised_by_its_physics_and_not_by_its_path_names_or_look() {
        let place = tempfile::tempdir().unwrap();
        let print = |name: &str, from: &str, to: &str| {
            let text = include_str!("../../assets/shadow_hand/scene.xml");
            assert!(text.contains(from), "{from}");
            let path = place.path().join(name);
            let text = text.replacen(from, to, 1);
            crate::os::write_whole(&path, text.as_bytes()).unwrap();
            Scene::load(Some(&path), &Compilation::plain(0.01, Cone::Scene))
                .unwrap()
                .fingerprint()
        };
        let original = print("a.xml", "", "");
        assert_eq!(
            original,
            Scene::load(None, &Compilation::plain(0.01, Cone::Scene))
                .unwrap()
                .fingerprint()
        );
        assert_eq!(print("b.xml", "name=\"cube\"", "name=\"die\""), original);
        let unseen = "<geom type='sphere' size='.1' pos='9 9 9' contype='0' conaffinity='0' rgba='1 0 0 1'/>";
        assert_eq!(
            print(
                "c.xml",
                "<worldbody>",
                &format!("<worldbody><light pos='0 0 9'/>{unseen}")
            ),
            original
        );
        assert_ne!(
            print(
                "d.xml",
                "<worldbody>",
                "<worldbody><geom type='sphere' size='.1' pos='9 9 9'/>"
            ),
            original
        );
        assert_ne!(print("e.xml", "mass=\".028\"", "mass=\".029\""), original);
    }
}
