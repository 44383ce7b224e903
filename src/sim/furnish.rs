//! What a custom scene may lack for display: a light, a sky, and cubes whose faces can be told apart.
//!
//! Nothing here changes the physics: what is added has no mass, collides with nothing, and comes after the existing objects.

use std::path::Path;

use anyhow::{Context, Result};
use mujoco_rs::prelude::MjModel;
use mujoco_rs::wrappers::SpecItem;
use mujoco_rs::wrappers::mj_editing::MjsBody;

use super::compilation::{Compilation, VISUAL, only_seen};
use super::constants::*;
use crate::quat;

/// The colours of the faces, as in the built-in scene: +x, -x, +y, -y, +z, -z.
const FACES: [[f32; 3]; 6] = [
    [0.8, 0.1, 0.12],
    [0.95, 0.45, 0.05],
    [0.1, 0.6, 0.25],
    [0.1, 0.3, 0.8],
    [0.93, 0.93, 0.93],
    [0.95, 0.82, 0.1],
];

/// The thickness of a face's plate beyond the box, as a fraction of the box's half size.
const PLATE: f64 = 0.02;

/// Compiles the scene in `file` with what it lacks. Returns `None` if it lacks nothing.
///
/// # Errors
/// Fails if MuJoCo refuses the scene.
pub fn furnished(
    file: &Path,
    model: &MjModel,
    compilation: &Compilation,
) -> Result<Option<MjModel>> {
    let is_dark = model.nlight() == 0;
    let has_no_sky = !model.tex_type().contains(&mjTEXTURE_SKYBOX);
    let shown = |body: usize| {
        let name = model
            .id_to_name(mjOBJ_BODY, body)
            .filter(|name| !name.is_empty())?;
        let is_goal = model.body_mocapid()[body] >= 0;
        // A goal can be seen through.
        let opacity = if is_goal { 0.7 } else { 1.0 };
        (is_goal || name == compilation.object).then_some((name, plain_box(model, body)?, opacity))
    };
    let boxes: Vec<_> = (1..model.nbody() as usize).filter_map(shown).collect();
    if !is_dark && !has_no_sky && boxes.is_empty() {
        return Ok(None);
    }
    let mut spec = compilation.spec(Some(file))?;
    if is_dark {
        spec.world_body_mut()
            .add_light()
            .with_pos([0.0, 0.0, 2.0])
            .with_dir([0.2, 0.4, -1.0])
            .with_type(mjLIGHT_DIRECTIONAL);
    }
    if has_no_sky {
        spec.add_texture()
            .with_name("sky of shadow-repose")
            .with_type(mjTEXTURE_SKYBOX)
            .with_builtin(mjBUILTIN_GRADIENT)
            .with_width(64)
            .with_height(384)
            .with_rgb1([0.74, 0.78, 0.83])
            .with_rgb2([0.42, 0.49, 0.58]);
    }
    for (name, half, opacity) in boxes {
        let body = spec
            .body_mut(name)
            .context("a body of the compiled scene")?;
        colour_faces(body, half, opacity);
    }
    compilation.finish(spec).map(Some)
}

/// Puts a coloured plate on each face of a box with these half sizes in m.
fn colour_faces(body: &mut MjsBody, half: [f64; 3], opacity: f32) {
    for (face, [red, green, blue]) in FACES.into_iter().enumerate() {
        let axis = face / 2;
        let mut size = half.map(|half| 0.88 * half);
        size[axis] = PLATE * half[axis];
        let mut position = [0.0; 3];
        position[axis] = if face % 2 == 0 {
            half[axis]
        } else {
            -half[axis]
        };
        only_seen(body)
            .with_type(mjGEOM_BOX)
            .with_size(size)
            .with_pos(position)
            // Regardless of the defaults of its class.
            .with_quat(quat::IDENTITY)
            .with_rgba([red, green, blue, opacity])
            .with_group(VISUAL);
    }
}

/// The half sizes (m) of a body that is one box in the middle of its frame, without a material.
fn plain_box(model: &MjModel, body: usize) -> Option<[f64; 3]> {
    let geom = usize::try_from(model.body_geomadr()[body]).ok()?;
    let is_plain = model.body_geomnum()[body] == 1
        && model.geom_type()[geom] == mjGEOM_BOX
        && model.geom_matid()[geom] < 0
        && model.geom_pos()[geom] == [0.0; 3]
        && model.geom_quat()[geom] == quat::IDENTITY;
    is_plain.then(|| model.geom_size()[geom])
}
