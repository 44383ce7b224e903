//! The look of a scene: the real hand's meshes over the colliding primitives, and the size and quality of pictures.
//!
//! Nothing here changes the physics: meshes have no mass and collide with nothing, and they come after the existing objects.

use anyhow::{Context, Result, anyhow};
use mujoco_rs::prelude::{MjModel, MjtGeomBase, MjtObjBase};
use mujoco_rs::wrappers::SpecItem;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;

use super::compilation::{Compilation, VISUAL};

/// The group of geoms that are not drawn.
pub(super) const HIDDEN: i32 = 3;
/// The scale of MuJoCo Menagerie's meshes, which are in millimetres.
const MILLIMETRE: f64 = 1e-3;

/// A part of the hand: the end of its body's name, mesh file, material in the built-in scene, height above the body's origin in m.
type Part = (&'static str, &'static str, &'static str, f64);

/// The parts, by the beginning of the bodies' names. The values come from MuJoCo Menagerie's Shadow Hand.
const PARTS: [(&str, &[Part]); 5] =
    [("rh_", &HAND), ("rh_ff", &FINGER), ("rh_mf", &FINGER), ("rh_rf", &FINGER), ("rh_lf", &FINGER)];

const HAND: [Part; 8] = [
    ("forearm", "forearm_0.obj", "metal", 0.0),
    ("forearm", "forearm_1.obj", "shell", 0.0),
    ("wrist", "wrist.obj", "metal", 0.0),
    ("palm", "palm.obj", "shell", 0.0),
    ("lfmetacarpal", "lf_metacarpal.obj", "shell", 0.0),
    ("thproximal", "th_proximal.obj", "shell", 0.0),
    ("thmiddle", "th_middle.obj", "shell", 0.0),
    ("thdistal", "th_distal_pst.obj", "rubber", 0.0),
];

const FINGER: [Part; 4] = [
    ("knuckle", "f_knuckle.obj", "metal", 0.0005),
    ("proximal", "f_proximal.obj", "shell", 0.0),
    ("middle", "f_middle.obj", "shell", 0.0),
    ("distal", "f_distal_pst.obj", "rubber", 0.0),
];

/// Returns each part with the beginning of its body's name.
fn parts() -> impl Iterator<Item = (&'static str, &'static Part)> {
    PARTS.into_iter().flat_map(|(prefix, parts)| parts.iter().map(move |part| (prefix, part)))
}

/// Returns the mesh files of the hand, sorted and without duplicates.
pub fn mesh_files() -> Vec<&'static str> {
    let mut files: Vec<&str> = parts().map(|(_, (_, file, ..))| *file).collect();
    files.sort_unstable();
    files.dedup();
    files
}

/// The rendering quality of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quality {
    /// No shadows, reflections or anti-aliasing: many pictures per second even without a graphics card.
    Fast,
    /// Shadows, reflections and anti-aliasing.
    High,
}

/// The position of a camera on a sphere around the scene's centre, which it looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Viewing direction around the vertical, degrees (0 is along +x).
    pub azimuth: f64,
    /// Viewing direction above the horizontal, degrees (negative looks down).
    pub elevation: f64,
    /// Distance from the scene's centre, m.
    pub distance: f64,
}

/// The look of a scene.
#[derive(Clone, Debug)]
pub struct Look {
    /// The contents of [`mesh_files`], in that order, for the built-in hand. If empty, its primitives are shown.
    pub meshes: Vec<Vec<u8>>,
    /// Width and height of pictures in pixels.
    pub size: [u32; 2],
    /// A camera that replaces the scene's own.
    pub camera: Option<Camera>,
    /// The quality of pictures.
    pub quality: Quality,
}

impl Look {
    /// Applies everything but the meshes to a model.
    pub(super) fn set_up(&self, model: &mut MjModel) {
        if let Some(camera) = self.camera {
            let global = &mut model.vis_mut().global;
            (global.azimuth, global.elevation) = (camera.azimuth as f32, camera.elevation as f32);
            // MuJoCo's free camera starts 1.5 extents away.
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
    /// Fails if MuJoCo cannot read a file as a mesh.
    pub(super) fn dress(&self, compilation: &Compilation) -> Result<MjModel> {
        let mut spec = compilation.spec(None)?;
        let mut files = MjVfs::new();
        for (name, content) in mesh_files().into_iter().zip(&self.meshes) {
            files.add_from_buffer(name, content).map_err(|error| anyhow!("{name}: {error}"))?;
            spec.add_mesh().with_name(name).with_file(name).with_scale([MILLIMETRE; 3]);
        }
        for (prefix, &(part, mesh, material, height)) in parts() {
            let body = format!("{prefix}{part}");
            let body = spec.body_mut(&body).with_context(|| format!("there is no body {body} for the mesh {mesh}"))?;
            let geom = body.add_geom().with_type(MjtGeomBase::mjGEOM_MESH).with_meshname(mesh).with_material(material);
            geom.with_pos([0.0, 0.0, height]).with_group(VISUAL);
            geom.with_contype(0).with_conaffinity(0).with_density(0.0);
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
