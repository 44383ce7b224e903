//! How a scene looks: the real hand's meshes over the primitives that collide, the size and quality of pictures.
//!
//! Nothing here changes the physics: meshes have no mass and touch nothing, and what is added comes after what was there.

use anyhow::{Result, anyhow};
use mujoco_rs::prelude::{MjModel, MjSpec, MjtGeomBase, MjtObjBase};
use mujoco_rs::wrappers::SpecItem;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;

/// Geoms of this group are not drawn.
const HIDDEN: i32 = 3;
/// Geoms of this group are, and by convention collide with nothing.
const VISUAL: i32 = 2;
/// MuJoCo Menagerie's meshes are in millimetres.
const MILLIMETRE: f64 = 1e-3;

/// The parts of the hand: body, mesh file, material of the built-in scene, height above the body's origin in m. The figures
/// are those of MuJoCo Menagerie's Shadow Hand.
const PARTS: [(&str, &str, &str, f64); 24] = [
    ("rh_forearm", "forearm_0.obj", "metal", 0.0),
    ("rh_forearm", "forearm_1.obj", "shell", 0.0),
    ("rh_wrist", "wrist.obj", "metal", 0.0),
    ("rh_palm", "palm.obj", "shell", 0.0),
    ("rh_ffknuckle", "f_knuckle.obj", "metal", 0.0005),
    ("rh_ffproximal", "f_proximal.obj", "shell", 0.0),
    ("rh_ffmiddle", "f_middle.obj", "shell", 0.0),
    ("rh_ffdistal", "f_distal_pst.obj", "rubber", 0.0),
    ("rh_mfknuckle", "f_knuckle.obj", "metal", 0.0005),
    ("rh_mfproximal", "f_proximal.obj", "shell", 0.0),
    ("rh_mfmiddle", "f_middle.obj", "shell", 0.0),
    ("rh_mfdistal", "f_distal_pst.obj", "rubber", 0.0),
    ("rh_rfknuckle", "f_knuckle.obj", "metal", 0.0005),
    ("rh_rfproximal", "f_proximal.obj", "shell", 0.0),
    ("rh_rfmiddle", "f_middle.obj", "shell", 0.0),
    ("rh_rfdistal", "f_distal_pst.obj", "rubber", 0.0),
    ("rh_lfmetacarpal", "lf_metacarpal.obj", "shell", 0.0),
    ("rh_lfknuckle", "f_knuckle.obj", "metal", 0.0005),
    ("rh_lfproximal", "f_proximal.obj", "shell", 0.0),
    ("rh_lfmiddle", "f_middle.obj", "shell", 0.0),
    ("rh_lfdistal", "f_distal_pst.obj", "rubber", 0.0),
    ("rh_thproximal", "th_proximal.obj", "shell", 0.0),
    ("rh_thmiddle", "th_middle.obj", "shell", 0.0),
    ("rh_thdistal", "th_distal_pst.obj", "rubber", 0.0),
];

/// The mesh files of the hand, each once.
pub fn mesh_files() -> Vec<&'static str> {
    let mut files: Vec<&str> = PARTS.iter().map(|(_, file, ..)| *file).collect();
    files.sort_unstable();
    files.dedup();
    files
}

/// How much is spent on a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quality {
    /// No shadows, no reflections, no anti-aliasing: many pictures a second without a graphics card.
    Fast,
    /// All of them.
    High,
}

/// From where a scene is seen: a point on a sphere around its middle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Degrees around the vertical; the direction of view, 0 along +x.
    pub azimuth: f64,
    /// Degrees; below 0 it looks down.
    pub elevation: f64,
    /// m from the middle.
    pub distance: f64,
}

/// How a scene is to look.
#[derive(Clone, Debug)]
pub struct Look {
    /// The contents of [`mesh_files`], in their order, that the built-in hand wears; empty: its primitives are shown.
    pub meshes: Vec<Vec<u8>>,
    /// Width and height of pictures in pixels.
    pub size: [u32; 2],
    /// Instead of the one that the scene says.
    pub camera: Option<Camera>,
    /// Of the pictures.
    pub quality: Quality,
}

impl Look {
    /// Applies everything but the meshes to a model.
    pub(super) fn set_up(&self, model: &mut MjModel) {
        if let Some(camera) = self.camera {
            let global = &mut model.vis_mut().global;
            (global.azimuth, global.elevation) = (camera.azimuth as f32, camera.elevation as f32);
            // MuJoCo's free camera begins so many extents away.
            model.stat_mut().extent = camera.distance / 1.5;
        }
        let [width, height] = self.size.map(|pixels| pixels as i32);
        let visual = model.vis_mut();
        (visual.global.offwidth, visual.global.offheight) = (width, height);
        if self.quality == Quality::Fast {
            visual.quality.offsamples = 0;
            model.light_castshadow_mut().fill(false);
            model.mat_reflectance_mut().fill(0.0);
        } else {
            visual.quality.offsamples = 8;
        }
    }

    /// Compiles the built-in scene with the meshes on its hand.
    ///
    /// # Errors
    /// Files that MuJoCo cannot read as meshes.
    pub(super) fn dress(&self, scene: &str) -> Result<MjModel> {
        let mut spec = MjSpec::from_xml_string(scene).map_err(|error| anyhow!("{error}"))?;
        let mut files = MjVfs::new();
        for (name, content) in mesh_files().into_iter().zip(&self.meshes) {
            files.add_from_buffer(name, content).map_err(|error| anyhow!("{name}: {error}"))?;
            spec.add_mesh().with_name(name).with_file(name).with_scale([MILLIMETRE; 3]);
        }
        for (body, mesh, material, height) in PARTS {
            let body = spec.body_mut(body).ok_or_else(|| anyhow!("there is no body {body} to wear {mesh}"))?;
            body.add_geom()
                .with_type(MjtGeomBase::mjGEOM_MESH)
                .with_meshname(mesh)
                .with_material(material)
                .with_pos([0.0, 0.0, height])
                .with_group(VISUAL)
                .with_contype(0)
                .with_conaffinity(0)
                .with_density(0.0);
        }
        let mut model = spec.compile_with_vfs(&files).map_err(|error| anyhow!("the meshes of the hand: {error}"))?;
        hide_primitives(&mut model);
        Ok(model)
    }
}

fn hide_primitives(model: &mut MjModel) {
    for geom in 0..model.ngeom() as usize {
        let body = model.geom_bodyid()[geom] as usize;
        let of_hand = model.id_to_name(MjtObjBase::mjOBJ_BODY, body).is_some_and(|name| name.starts_with("rh_"));
        if of_hand && model.geom_group()[geom] != VISUAL {
            model.geom_group_mut()[geom] = HIDDEN;
        }
    }
}
