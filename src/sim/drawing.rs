//! What is needed to draw a scene elsewhere: its bodies and joints, its visible shapes, its meshes.

use std::collections::BTreeMap;

use mujoco_rs::prelude::MjModel;
use serde_json::{Value, json};

use super::Scene;
use super::constants::*;
use super::look::{Camera, HIDDEN, is_of};
use super::placing::colour_of;
use crate::draw::Mesh;

/// A scene as a page draws it. Lengths in m, quaternions w, x, y, z.
pub struct Drawing {
    /// Its bodies, shapes, floor and camera, as `assets/page/FORMAT.md` says. A pose is in the frame of the parent or of the body.
    pub scene: Value,
    /// The numbers that give the poses, in the default pose: `qpos`, then position and orientation of each mocap body.
    pub start: Vec<f64>,
    /// The number of values in `qpos`.
    pub positions: usize,
    /// Where quaternions begin among the numbers.
    pub quaternions: Vec<usize>,
    /// The meshes of the shapes.
    pub meshes: Vec<Mesh>,
}

/// The most corners of a part of a mesh, which a page numbers in 16 bits.
const MOST_CORNERS: usize = 65_535;

impl Scene {
    /// What a page needs to draw this scene, perhaps from this camera. `dressed` is the beginning of the names of the bodies that
    /// wear a [`super::Dress`], if it was loaded.
    pub fn drawing(&self, dressed: Option<&str>, from: Option<Camera>) -> Drawing {
        let model = &*self.model;
        let dressed = dressed.filter(|_| model.ffi().nmesh > 0);
        let floor = ids(model.ngeom()).find(|&geom| is_floor(model, geom));
        let (geoms, meshes) = drawn_geoms(model, dressed, floor);
        let floor = floor.map(|geom| model.geom_pos()[geom][2]);
        let bodies: Value = ids(model.nbody())
            .map(|body| drawn_body(model, body))
            .collect();
        let scene = json!({ "bodies": bodies, "geoms": geoms, "floor": floor, "camera": camera(model, from) });
        let positions = model.nq() as usize;
        let mut start = model.qpos0().to_vec();
        for body in ids(model.nbody()).filter(|&body| model.body_mocapid()[body] >= 0) {
            start.extend(model.body_pos()[body]);
            start.extend(model.body_quat()[body]);
        }
        let of_joints = ids(model.njnt()).filter_map(|joint| match model.jnt_type()[joint] {
            mjJNT_FREE => Some(model.jnt_qposadr()[joint] as usize + 3),
            mjJNT_BALL => Some(model.jnt_qposadr()[joint] as usize),
            _ => None,
        });
        Drawing {
            quaternions: of_joints
                .chain((positions + 3..start.len()).step_by(7))
                .collect(),
            scene,
            start,
            positions,
            meshes,
        }
    }
}

/// The shapes but for the floor, and the meshes of those that have one.
fn drawn_geoms(
    model: &MjModel,
    dressed: Option<&str>,
    floor: Option<usize>,
) -> (Vec<Value>, Vec<Mesh>) {
    let mut geoms = Vec::new();
    let mut meshes = Vec::new();
    let mut parts = BTreeMap::new();
    for geom in ids(model.ngeom()).filter(|geom| Some(*geom) != floor) {
        let Some(drawn) = drawn_geom(model, geom, dressed) else {
            continue;
        };
        if model.geom_type()[geom] != mjGEOM_MESH {
            geoms.push(drawn);
            continue;
        }
        // A mesh is drawn by as many shapes as it has parts.
        let parts = parts.entry(model.geom_dataid()[geom]).or_insert_with(|| {
            let first = meshes.len();
            meshes.extend(drawn_mesh(model, model.geom_dataid()[geom] as usize));
            first..meshes.len()
        });
        for mesh in parts.clone() {
            let mut drawn = drawn.clone();
            drawn["mesh"] = mesh.into();
            if dressed.is_some() {
                // It is part only of a fine picture.
                drawn["fine"] = true.into();
            }
            geoms.push(drawn);
        }
    }
    (geoms, meshes)
}

fn drawn_body(model: &MjModel, body: usize) -> Value {
    let first = model.body_jntadr()[body].max(0) as usize;
    let joint = |joint: usize| {
        let at = model.jnt_qposadr()[joint] as usize;
        let kind = match model.jnt_type()[joint] {
            mjJNT_FREE => "free",
            mjJNT_BALL => "ball",
            mjJNT_SLIDE => "slide",
            mjJNT_HINGE => "hinge",
        };
        let axis = model.jnt_axis()[joint];
        json!({ "type": kind, "at": at, "pos": model.jnt_pos()[joint], "axis": axis, "rest": model.qpos0()[at] })
    };
    let joints: Value = (first..first + model.body_jntnum()[body] as usize)
        .map(joint)
        .collect();
    let mut drawn = json!({
        "parent": model.body_parentid()[body],
        "pos": model.body_pos()[body],
        "quat": model.body_quat()[body],
        "joints": joints,
    });
    if let Ok(mocap) = usize::try_from(model.body_mocapid()[body]) {
        drawn["mocap"] = (model.nq() as usize + 7 * mocap).into();
    }
    drawn
}

fn is_floor(model: &MjModel, geom: usize) -> bool {
    let [width, length, _] = model.geom_size()[geom];
    let level = model.geom_quat()[geom][0] > 0.9999 && model.geom_bodyid()[geom] == 0;
    let endless = model.geom_type()[geom] == mjGEOM_PLANE && width == 0.0 && length == 0.0;
    endless && level && model.geom_group()[geom] < HIDDEN
}

/// A shape, unless it is of a kind that a page does not draw, or hidden.
fn drawn_geom(model: &MjModel, geom: usize, dressed: Option<&str>) -> Option<Value> {
    let kind = match model.geom_type()[geom] {
        mjGEOM_PLANE => "plane",
        mjGEOM_SPHERE => "sphere",
        mjGEOM_CAPSULE => "capsule",
        mjGEOM_ELLIPSOID => "ellipsoid",
        mjGEOM_CYLINDER => "cylinder",
        mjGEOM_BOX => "box",
        mjGEOM_MESH => "mesh",
        _ => return None,
    };
    // The primitives of a dressed hand are hidden, but for a plain picture.
    let plain = kind != "mesh" && dressed.is_some_and(|bodies| is_of(model, geom, bodies));
    if model.geom_group()[geom] >= HIDDEN && !plain {
        return None;
    }
    let material = usize::try_from(model.geom_matid()[geom]).ok();
    let shine = |of: &[f32]| material.map_or(0.5, |material| of[material]);
    let mut drawn = json!({
        "type": kind,
        "body": model.geom_bodyid()[geom],
        "size": model.geom_size()[geom],
        "pos": model.geom_pos()[geom],
        "quat": model.geom_quat()[geom],
        "rgba": colour_of(model, geom),
        "specular": shine(model.mat_specular()),
        "shininess": shine(model.mat_shininess()),
    });
    if plain {
        drawn["plain"] = true.into();
    }
    Some(drawn)
}

/// The parts of a mesh. They have one corner for each pair of point and normal that a triangle uses, in the order of first
/// use.
fn drawn_mesh(model: &MjModel, mesh: usize) -> Vec<Mesh> {
    let first = model.mesh_faceadr()[mesh];
    let points = model.mesh_vertadr()[mesh];
    let normals = model.mesh_normaladr()[mesh];
    let faces = first as usize..(first + model.mesh_facenum()[mesh]) as usize;
    let mut places = BTreeMap::new();
    let mut parts = vec![Mesh::default()];
    for (face, directions) in model.mesh_face()[faces.clone()]
        .iter()
        .zip(&model.mesh_facenormal()[faces])
    {
        if parts
            .last()
            .is_some_and(|(corners, _)| corners.len() + 3 > MOST_CORNERS)
        {
            parts.push(Mesh::default());
            places.clear();
        }
        let (corners, triangles) = parts.last_mut().expect("there is a first part");
        triangles.push([0, 1, 2].map(|corner| {
            let point = model.mesh_vert()[(points + face[corner]) as usize];
            let normal = model.mesh_normal()[(normals + directions[corner]) as usize];
            // Points of one place and direction, as a picture shows them, are one corner.
            let key = (
                point.map(|x| (x * 5e4).round() as i64),
                normal.map(|x| (x * 16.0).round() as i64),
            );
            *places.entry(key).or_insert_with(|| {
                corners.push((point, normal));
                corners.len() - 1
            })
        }));
    }
    for (_, triangles) in &mut parts {
        triangles.retain(|[a, b, c]| a != b && b != c && a != c);
    }
    parts
}

fn camera(model: &MjModel, from: Option<Camera>) -> Value {
    let global = &model.vis().global;
    let stat = model.stat();
    let mut camera = json!(from.unwrap_or(Camera {
        azimuth: global.azimuth.into(),
        elevation: global.elevation.into(),
        distance: 1.5 * stat.extent,
    }));
    camera["center"] = json!(stat.center);
    camera["fovy"] = json!(global.fovy);
    // A page may come nearer, until all of the first picture fills it.
    camera["fit"] = from.is_none().into();
    camera
}
