//! What a custom scene may lack for display: a light, a sky, a floor, a camera, and objects whose sides can be told apart.
//!
//! Nothing here changes the physics: what is added has no mass, collides with nothing, and comes after the existing objects.

use std::path::Path;

use anyhow::{Context, Result};
use mujoco_rs::prelude::{MjData, MjModel, MjSpec, MjtGeomBase};
use mujoco_rs::wrappers::SpecItem;
use mujoco_rs::wrappers::mj_editing::MjsBody;
use std::f64::consts::FRAC_1_SQRT_2;

use super::compilation::{Compilation, VISUAL, only_seen};
use super::constants::*;
use super::placing::{Placed, frames_within, geoms_within, inside};
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

/// How far a rod reaches beyond the object along its axis, and its radius, in terms of the object's least half size.
const ROD: [f64; 2] = [0.6, 0.15];

/// The radius of a dot on a round object, its half height, and the depth of its middle, in terms of the object's least half size.
const DOT: [f64; 3] = [0.5, 0.17, 0.1];

/// The orientations in which a capsule lies along x, y and z.
const ALONG: [quat::Quat; 3] = [
    [FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2, 0.0],
    [FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0, 0.0],
    quat::IDENTITY,
];

/// The half size of the goal for the camera, m.
const GOAL: f64 = 0.04;

/// The distance of a floor below the lowest shape, m.
const BELOW: f64 = 0.02;

/// Compiles the scene in `file` with what it lacks, and points its camera at what moves and at the place of the `goal`. Returns `None` if it lacks nothing.
///
/// # Errors
/// Fails if MuJoCo refuses the scene.
pub fn furnished(
    file: &Path,
    model: &MjModel,
    compilation: &Compilation,
    goal: [f64; 3],
) -> Result<Option<MjModel>> {
    let is_dark = model.nlight() == 0;
    let has_no_sky = !model.tex_type().contains(&mjTEXTURE_SKYBOX);
    let is_ground = |kind: &_| matches!(kind, mjGEOM_PLANE | mjGEOM_HFIELD);
    let has_no_floor = !model.geom_type().iter().any(is_ground);
    let shown = |body: usize| {
        let name = model
            .id_to_name(mjOBJ_BODY, body)
            .filter(|name| !name.is_empty())?;
        let is_goal = model.body_mocapid()[body] >= 0;
        // A goal can be seen through.
        let opacity = if is_goal { 0.7 } else { 1.0 };
        (is_goal || name == compilation.object).then_some((name, marks(model, body)?, opacity))
    };
    let marked: Vec<_> = (1..model.nbody() as usize).filter_map(shown).collect();
    let mut spec = compilation.spec(Some(file))?;
    let has_no_camera = spec.stat().extent.is_nan();
    if !is_dark && !has_no_sky && !has_no_floor && !has_no_camera && marked.is_empty() {
        return Ok(None);
    }
    let [low, high] = space_of(model, goal);
    let middle = [0, 1, 2].map(|axis| 0.5 * (low[axis] + high[axis]));
    if is_dark {
        add_light(&mut spec, middle);
    }
    add_surroundings(&mut spec, [has_no_sky, has_no_floor], low[2] - BELOW);
    for (name, marks, opacity) in marked {
        let body = spec
            .body_mut(name)
            .context("a body of the compiled scene")?;
        add_marks(body, marks, opacity);
    }
    let mut furnished = compilation.finish(spec)?;
    if has_no_camera {
        let statistics = furnished.stat_mut();
        statistics.center = middle;
        let squares: f64 = (0..3).map(|axis| (high[axis] - low[axis]).powi(2)).sum();
        statistics.extent = squares.sqrt();
    }
    Ok(Some(furnished))
}

/// Adds a light that shines through this point. MuJoCo draws no shadows far from this line.
fn add_light(spec: &mut MjSpec, through: [f64; 3]) {
    let direction = [0.2, 0.4, -1.0];
    spec.world_body_mut()
        .add_light()
        .with_pos([0, 1, 2].map(|axis| through[axis] - 2.0 * direction[axis]))
        .with_dir(direction)
        .with_type(mjLIGHT_DIRECTIONAL);
}

/// Adds a sky, and a floor at this height, if they are lacking.
fn add_surroundings(spec: &mut MjSpec, [has_no_sky, has_no_floor]: [bool; 2], height: f64) {
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
    if has_no_floor {
        only_seen(spec.world_body_mut())
            .with_type(mjGEOM_PLANE)
            .with_size([0.0, 0.0, 0.05])
            .with_pos([0.0, 0.0, height])
            .with_quat(quat::IDENTITY)
            .with_rgba([0.55, 0.58, 0.62, 1.0])
            .with_group(0);
    }
}

/// A coloured shape that shows how an object is turned: its kind, size, position and orientation.
type Mark = (MjtGeomBase, [f64; 3], [f64; 3], quat::Quat);

/// Puts marks on a body, in the colours of [`FACES`].
fn add_marks(body: &mut MjsBody, marks: Vec<Mark>, opacity: f32) {
    for ((kind, size, position, orientation), [red, green, blue]) in marks.into_iter().zip(FACES) {
        only_seen(body)
            .with_type(kind)
            .with_size(size)
            .with_pos(position)
            // Regardless of the defaults of its class.
            .with_quat(orientation)
            .with_rgba([red, green, blue, opacity])
            .with_group(VISUAL);
    }
}

/// A mark for each colour of [`FACES`]: plates on a box, dots on a round shape, and rods along the axes of anything else. What has a
/// material has rods, so that its texture is seen. What has several colours needs no marks.
fn marks(model: &MjModel, body: usize) -> Option<Vec<Mark>> {
    let mut shapes = geoms_within(model, &frames_within(model, body));
    shapes.retain(|&(geom, _)| model.geom_group()[geom] <= VISUAL);
    let &(first, place) = shapes.first()?;
    let look = |geom: usize| (model.geom_rgba()[geom], model.geom_matid()[geom]);
    if shapes.iter().any(|&(geom, _)| look(geom) != look(first)) {
        return None;
    }
    let is_centred = place == ([0.0; 3], quat::IDENTITY);
    let is_simple = shapes.len() == 1 && is_centred && model.geom_matid()[first] < 0;
    let kind = is_simple.then(|| model.geom_type()[first]);
    let corners = box_around(model, &shapes);
    let faces = 0..FACES.len();
    Some(faces.map(|face| mark(kind, corners, face)).collect())
}

/// The mark of this face on a simple shape of this kind, or on anything else, in a box with these corners.
fn mark(kind: Option<MjtGeomBase>, [low, high]: [[f64; 3]; 2], face: usize) -> Mark {
    let axis = face / 2;
    let half = [0, 1, 2].map(|axis| 0.5 * (high[axis] - low[axis]));
    let least = half.into_iter().fold(f64::INFINITY, f64::min);
    let (kind, size, distance, orientation) = match kind {
        Some(mjGEOM_BOX) => {
            let mut size = half.map(|half| 0.88 * half);
            size[axis] = PLATE * half[axis];
            (mjGEOM_BOX, size, half[axis], quat::IDENTITY)
        }
        Some(mjGEOM_SPHERE | mjGEOM_ELLIPSOID | mjGEOM_CAPSULE | mjGEOM_CYLINDER) => {
            let [radius, height, depth] = DOT.map(|part| part * least);
            let mut size = [radius; 3];
            size[axis] = height;
            (mjGEOM_ELLIPSOID, size, half[axis] - depth, quat::IDENTITY)
        }
        _ => {
            let middle = 0.5 * (half[axis] + ROD[0] * least);
            let size = [ROD[1] * least, middle, 0.0];
            (mjGEOM_CAPSULE, size, middle, ALONG[axis])
        }
    };
    let mut position = [0, 1, 2].map(|axis| low[axis] + half[axis]);
    position[axis] += if face.is_multiple_of(2) {
        distance
    } else {
        -distance
    };
    (kind, size, position, orientation)
}

/// The corners of a box along the axes around shapes that have these places, m.
fn box_around(model: &MjModel, shapes: &[(usize, Placed)]) -> [[f64; 3]; 2] {
    let mut corners = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for &(geom, place) in shapes {
        for point in points_of(model, geom) {
            let (point, _) = inside(place, point, quat::IDENTITY);
            for axis in 0..3 {
                corners[0][axis] = corners[0][axis].min(point[axis]);
                corners[1][axis] = corners[1][axis].max(point[axis]);
            }
        }
    }
    corners
}

/// Points of a shape in its frame whose hull contains it, m: the corners of a mesh, or of a box around another shape.
fn points_of(model: &MjModel, geom: usize) -> Vec<[f64; 3]> {
    if model.geom_type()[geom] == mjGEOM_MESH {
        let mesh = model.geom_dataid()[geom] as usize;
        let first = model.mesh_vertadr()[mesh] as usize;
        let corners = &model.mesh_vert()[first..][..model.mesh_vertnum()[mesh] as usize];
        return corners.iter().map(|corner| corner.map(f64::from)).collect();
    }
    let [x, y, z, half @ ..] = model.geom_aabb()[geom];
    let sign = |corner: usize, axis: usize| if corner >> axis & 1 == 1 { 1.0 } else { -1.0 };
    let corner = |i: usize| [0, 1, 2].map(|axis| [x, y, z][axis] + sign(i, axis) * half[axis]);
    (0..8).map(corner).collect()
}

/// The corners of a box along the axes around all shapes that are not of the world itself in the default pose, and around the place of
/// the goal, m.
fn space_of(model: &MjModel, goal: [f64; 3]) -> [[f64; 3]; 2] {
    let mut data = MjData::new(model);
    data.kinematics();
    let shapes: Vec<_> = ids(model.ngeom())
        .filter(|&geom| model.geom_bodyid()[geom] > 0 && model.geom_group()[geom] <= VISUAL)
        .map(|geom| {
            let body = model.geom_bodyid()[geom] as usize;
            let frame = (data.xpos()[body], data.xquat()[body]);
            (
                geom,
                inside(frame, model.geom_pos()[geom], model.geom_quat()[geom]),
            )
        })
        .collect();
    let [mut low, mut high] = box_around(model, &shapes);
    for axis in 0..3 {
        low[axis] = low[axis].min(goal[axis] - GOAL);
        high[axis] = high[axis].max(goal[axis] + GOAL);
    }
    [low, high]
}

#[cfg(test)]
mod tests {
    use super::super::Cone;
    use super::*;

    #[test]
    fn the_light_of_a_scene_without_one_shines_on_what_moves_so_that_it_has_a_shadow() {
        let text = "<mujoco><worldbody><body pos='3 1 2'><freejoint/><geom size='.1'/></body></worldbody></mujoco>";
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("scene.xml");
        crate::os::write_whole(&file, text.as_bytes()).unwrap();
        let compilation = Compilation::plain(0.01, Cone::Scene);
        let model = compilation.compile(Some(&file)).unwrap();
        let shown = furnished(&file, &model, &compilation, [3.0, 1.0, 2.5])
            .unwrap()
            .unwrap();
        let centre = shown.stat().center;
        assert!((centre[0] - 3.0).abs() < 1e-9 && (1.9..2.6).contains(&centre[2]));
        let [from, along] = [shown.light_pos()[0], shown.light_dir()[0]];
        let length = quat::length(&along);
        let way = [0, 1, 2].map(|axis| centre[axis] - from[axis]);
        let distance = quat::length(&way);
        for axis in 0..3 {
            assert!((way[axis] / distance - along[axis] / length).abs() < 1e-6);
        }
    }
}
