//! What identifies the physics of a scene, apart from its path, its names and its look.

use std::fmt::Debug;

use mujoco_rs::prelude::{MjModel, MjtGeomBase};

/// Returns a checksum (CRC-32), as hexadecimal digits, of everything in a scene that changes its motion. Geoms that collide with
/// nothing are left out, and so are sensors, keyframes and plugins.
pub(super) fn fingerprint(model: &MjModel) -> String {
    let mut hasher = crc32fast::Hasher::new();
    let mut take = |parts: &[&dyn Debug]| parts.iter().for_each(|part| hasher.update(format!("{part:?}\n").as_bytes()));
    take(&[model.opt(), &model.qpos0(), &model.qpos_spring()]);
    take(&[&model.body_parentid(), &model.body_mocapid(), &model.body_pos(), &model.body_quat()]);
    take(&[&model.body_ipos(), &model.body_iquat(), &model.body_mass(), &model.body_inertia(), &model.body_gravcomp()]);
    take(&[&model.jnt_type(), &model.jnt_bodyid(), &model.jnt_pos(), &model.jnt_axis(), &model.jnt_limited()]);
    take(&[&model.jnt_range(), &model.jnt_margin(), &model.jnt_stiffness(), &model.jnt_solref(), &model.jnt_solimp()]);
    take(&[&model.jnt_actfrclimited(), &model.jnt_actfrcrange(), &model.jnt_actgravcomp()]);
    take(&[&model.dof_armature(), &model.dof_damping(), &model.dof_frictionloss()]);
    take(&[&model.dof_solref(), &model.dof_solimp()]);
    for i in (0..model.ngeom() as usize).filter(|&i| model.geom_contype()[i] != 0 || model.geom_conaffinity()[i] != 0) {
        take(&[&model.geom_type()[i], &model.geom_bodyid()[i], &model.geom_pos()[i], &model.geom_quat()[i]]);
        take(&[&model.geom_size()[i], &model.geom_contype()[i], &model.geom_conaffinity()[i], &model.geom_condim()[i]]);
        take(&[&model.geom_priority()[i], &model.geom_friction()[i], &model.geom_solmix()[i], &model.geom_solref()[i]]);
        take(&[&model.geom_solimp()[i], &model.geom_margin()[i], &model.geom_gap()[i], &model.geom_fluid()[i]]);
        if model.geom_type()[i] == MjtGeomBase::mjGEOM_MESH {
            let mesh = model.geom_dataid()[i] as usize;
            let (first, count) = (model.mesh_vertadr()[mesh] as usize, model.mesh_vertnum()[mesh] as usize);
            take(&[&&model.mesh_vert()[first..first + count]]);
        }
    }
    take(&[&model.site_bodyid(), &model.site_pos(), &model.site_quat()]);
    take(&[&model.wrap_type(), &model.wrap_objid(), &model.wrap_prm(), &model.tendon_adr(), &model.tendon_num()]);
    take(&[&model.tendon_limited(), &model.tendon_range(), &model.tendon_stiffness(), &model.tendon_damping()]);
    take(&[&model.tendon_frictionloss(), &model.tendon_lengthspring(), &model.tendon_armature()]);
    take(&[&model.actuator_trntype(), &model.actuator_trnid(), &model.actuator_gear(), &model.actuator_dyntype()]);
    take(&[
        &model.actuator_dynprm(),
        &model.actuator_gaintype(),
        &model.actuator_gainprm(),
        &model.actuator_biastype(),
    ]);
    take(&[&model.actuator_biasprm(), &model.actuator_ctrllimited(), &model.actuator_ctrlrange()]);
    take(&[&model.actuator_forcelimited(), &model.actuator_forcerange()]);
    take(&[&model.eq_type(), &model.eq_obj1id(), &model.eq_obj2id(), &model.eq_active0(), &model.eq_data()]);
    take(&[&model.eq_solref(), &model.eq_solimp(), &model.exclude_signature(), &model.pair_signature()]);
    take(&[&model.pair_dim(), &model.pair_friction(), &model.pair_solref(), &model.pair_margin(), &model.pair_gap()]);
    format!("{:08x}", hasher.finalize())
}

#[cfg(test)]
mod tests {
    use super::super::{Compilation, Scene};

    #[test]
    fn a_scene_is_recognised_by_its_physics_and_not_by_its_path_names_or_look() {
        let place = tempfile::tempdir().unwrap();
        let print = |name: &str, from: &str, to: &str| {
            let text = include_str!("../../assets/shadow_hand/scene.xml");
            assert!(from.is_empty() || text.contains(from), "{from}");
            let path = place.path().join(name);
            let text = if from.is_empty() { text.to_owned() } else { text.replacen(from, to, 1) };
            crate::os::write_whole(&path, text.as_bytes()).unwrap();
            Scene::load(Some(&path), &Compilation::plain(0.01)).unwrap().fingerprint()
        };
        let original = print("a.xml", "", "");
        assert_eq!(original, Scene::load(None, &Compilation::plain(0.01)).unwrap().fingerprint());
        assert_eq!(print("b.xml", "name=\"cube\"", "name=\"die\""), original);
        let unseen = "<geom type='sphere' size='.1' pos='9 9 9' contype='0' conaffinity='0' rgba='1 0 0 1'/>";
        assert_eq!(print("c.xml", "<worldbody>", &format!("<worldbody><light pos='0 0 9'/>{unseen}")), original);
        assert_ne!(print("d.xml", "<worldbody>", "<worldbody><geom type='sphere' size='.1' pos='9 9 9'/>"), original);
        assert_ne!(print("e.xml", "mass=\".028\"", "mass=\".029\""), original);
    }
}
