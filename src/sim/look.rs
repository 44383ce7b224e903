//! The look of a scene: meshes over the colliding primitives, and the size and quality of pictures.
//!
//! Nothing here changes the physics: meshes have no mass and collide with nothing, and they come after the existing objects.

use anyhow::{Context, Result, anyhow};
use mujoco_rs::prelude::MjModel;
use mujoco_rs::wrappers::SpecItem;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use serde::Serialize;

use super::compilation::{Compilation, VISUAL, only_seen};
use super::constants::*;

/// The group of geoms that are not drawn.
pub const HIDDEN: i32 = 3;
/// The scale of MuJoCo Menagerie's meshes, which are in millimetres.
const MILLIMETRE: f64 = 1e-3;

/// Meshes that are shown over the primitives of some bodies.
#[derive(Clone)]
pub struct Dress {
    /// The beginning of the names of the bodies whose primitives are hidden.
    pub bodies: String,
    /// The files of the meshes: name and content.
    pub files: Vec<(&'static str, Vec<u8>)>,
    /// The meshes on the bodies.
    pub pieces: Vec<Piece>,
}

/// A mesh on a body.
#[derive(Clone)]
pub struct Piece {
    /// The name of the body.
    pub body: String,
    /// The name of the mesh's file.
    pub file: &'static str,
    /// A material of the scene.
    pub material: &'static str,
    /// The height of the mesh above the body's origin, m.
    pub height: f64,
}

/// The rendering quality of pictures.
#[derive(Clone, Copy, PartialEq)]
pub enum Quality {
    /// No shadows, reflections or anti-aliasing: many pictures per second even without a graphics card.
    Fast,
    /// Shadows, reflections and anti-aliasing.
    High,
}

/// The position of a camera on a sphere around the scene's centre, which it looks at.
#[derive(Clone, Copy, Serialize)]
pub struct Camera {
    /// Viewing direction around the vertical, degrees (0 is along +x).
    pub azimuth: f64,
    /// Viewing direction above the horizontal, degrees (negative looks down).
    pub elevation: f64,
    /// Distance from the scene's centre, m.
    pub distance: f64,
}

/// The look of a scene.
#[derive(Clone)]
pub struct Look {
    /// Meshes for the built-in scene. Without them its primitives are shown.
    pub dress: Option<Dress>,
    /// Width and height of pictures in pixels.
    pub size: [u32; 2],
    /// A camera that replaces the scene's own.
    pub camera: Option<Camera>,
    /// The quality of pictures.
    pub quality: Quality,
    /// Whether the hand's primitives are shown in place of its meshes.
    pub plain: bool,
}

impl Look {
    /// Applies everything but the dress to a model.
    pub(super) fn set_up(&self, model: &mut MjModel) {
        if let Some(camera) = self.camera {
            let global = &mut model.vis_mut().global;
            global.azimuth = camera.azimuth as f32;
            global.elevation = camera.elevation as f32;
            // MuJoCo's free camera starts 1.5 extents away.
            model.stat_mut().extent = camera.distance / 1.5;
        }
        let visual = model.vis_mut();
        [visual.global.offwidth, visual.global.offheight] = self.size.map(|pixels| pixels as i32);
        if self.quality == Quality::Fast {
            visual.quality.offsamples = 0;
            model.light_castshadow_mut().fill(false);
            model.mat_reflectance_mut().fill(0.0);
        } else {
            visual.quality.offsamples = 8;
        }
    }
}

impl Dress {
    /// Compiles the built-in scene with the meshes on its bodies.
    ///
    /// # Errors
    /// Fails if MuJoCo cannot read a file as a mesh.
    pub(super) fn compile(&self, compilation: &Compilation) -> Result<MjModel> {
        let mut spec = compilation.spec(None)?;
        let mut files = MjVfs::new();
        for (name, content) in &self.files {
            files
                .add_from_buffer(name, content)
                .map_err(|error| anyhow!("{name}: {error}"))?;
            spec.add_mesh()
                .with_name(name)
                .with_file(name)
                .with_scale([MILLIMETRE; 3]);
        }
        for Piece {
            body,
            file,
            material,
            height,
        } in &self.pieces
        {
            let body = spec
                .body_mut(body)
                .with_context(|| format!("there is no body {body} for the mesh {file}"))?;
            only_seen(body)
                .with_type(mjGEOM_MESH)
                .with_meshname(file)
                .with_material(material)
                .with_pos([0.0, 0.0, *height])
                .with_group(VISUAL);
        }
        let mut model = spec
            .compile_with_vfs(&files)
            .map_err(|error| anyhow!("the meshes of the hand: {error}"))?;
        for geom in ids(model.ngeom()) {
            if is_of(&model, geom, &self.bodies) && model.geom_group()[geom] != VISUAL {
                model.geom_group_mut()[geom] = HIDDEN;
            }
        }
        Ok(model)
    }
}

/// Whether a shape is of one of the bodies whose names begin with `bodies`.
pub fn is_of(model: &MjModel, geom: usize, bodies: &str) -> bool {
    let body = model.geom_bodyid()[geom] as usize;
    model
        .id_to_name(mjOBJ_BODY, body)
        .is_some_and(|name| name.starts_with(bodies))
}
