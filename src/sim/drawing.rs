//! What is needed to draw a scene elsewhere: its bodies and joints, its visible shapes, its meshes.

use std::collections::BTreeMap;

use mujoco_rs::prelude::MjModel;
use serde::Serialize;

use super::Scene;
use super::constants::*;
use super::look::{Camera, HIDDEN, is_of};

/// A scene as a page draws it. Lengths in m, quaternions w, x, y, z. A pose is in the frame of the parent or of the body.
#[derive(Serialize)]
pub struct Drawing {
    /// Every body after its parent. The first is the world.
    pub bodies: Vec<DrawnBody>,
    /// The shapes that are seen.
    pub geoms: Vec<DrawnGeom>,
    /// The height of a level floor without end, which is no shape.
    pub floor: Option<f64>,
    /// From where it is seen at first.
    pub camera: DrawnCamera,
    /// The numbers that give the poses, in the default pose: `qpos`, then position and orientation of each mocap body.
    pub start: Vec<f64>,
    /// The meshes of the shapes.
    #[serde(skip)]
    pub meshes: Vec<DrawnMesh>,
}

/// A body.
#[derive(Serialize)]
pub struct DrawnBody {
    parent: usize,
    pos: [f64; 3],
    quat: [f64; 4],
    joints: Vec<DrawnJoint>,
    /// The index of its pose among the numbers, if it is a mocap body.
    #[serde(skip_serializing_if = "Option::is_none")]
    mocap: Option<usize>,
}

/// A joint: which numbers move it, and its number at rest.
#[derive(Serialize)]
struct DrawnJoint {
    r#type: &'static str,
    at: usize,
    pos: [f64; 3],
    axis: [f64; 3],
    rest: f64,
}

/// A shape of a body.
#[derive(Clone, Serialize)]
pub struct DrawnGeom {
    r#type: &'static str,
    body: usize,
    size: [f64; 3],
    pos: [f64; 3],
    quat: [f64; 4],
    rgba: [f32; 4],
    specular: f32,
    shininess: f32,
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<usize>,
    /// Whether it is part only of a fine picture, or only of a plain one.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    fine: bool,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    plain: bool,
}

/// From where a page shows the scene.
#[derive(Serialize)]
pub struct DrawnCamera {
    /// Viewing direction around the vertical.
    pub azimuth: f64,
    /// Viewing direction above the horizontal.
    pub elevation: f64,
    /// Distance from the centre, m.
    pub distance: f64,
    /// The centre, m.
    pub center: [f64; 3],
    /// The vertical field of view.
    pub fovy: f64,
    /// Whether the page may come nearer, until all of the first picture fills it.
    pub fit: bool,
}

/// A mesh, or a part of one: corners, each with its normal, and triangles of corners.
#[derive(Default)]
pub struct DrawnMesh {
    /// Points and normals.
    pub corners: Vec<([f32; 3], [f32; 3])>,
    /// Three corners each.
    pub triangles: Vec<[usize; 3]>,
}

impl Drawing {
    /// The number of values in `qpos`.
    pub fn positions(&self) -> usize {
        self.start.len() - 7 * self.bodies.iter().filter(|body| body.mocap.is_some()).count()
    }

    /// Where quaternions begin among the numbers.
    pub fn quaternions(&self) -> Vec<usize> {
        let of_body = |body: &DrawnBody| {
            let of_joints = body.joints.iter().filter_map(|joint| match joint.r#type {
                "free" => Some(joint.at + 3),
                "ball" => Some(joint.at),
                _ => None,
            });
            of_joints.chain(body.mocap.map(|at| at + 3)).collect::<Vec<_>>()
        };
        self.bodies.iter().flat_map(of_body).collect()
    }
}

/// The most corners of a part of a mesh, which a page numbers in 16 bits.
const MOST_CORNERS: usize = 65_535;

/// The colour of a shape that has none.
const UNCOLOURED: [f32; 4] = [0.5, 0.5, 0.5, 1.0];

impl Scene {
    /// What a page needs to draw this scene, perhaps from this camera. `dressed` is the beginning of the names of the bodies that
    /// wear a [`super::Dress`], if it was loaded.
    pub fn drawing(&self, dressed: Option<&str>, from: Option<Camera>) -> Drawing {
        let model = &*self.model;
        let dressed = dressed.filter(|_| model.ffi().nmesh > 0);
        let mut geoms = Vec::new();
        let mut meshes = Vec::new();
        let mut parts = BTreeMap::new();
        let mut floor = None;
        for geom in 0..model.ngeom() as usize {
            if floor.is_none() && is_floor(model, geom) {
                floor = Some(model.geom_pos()[geom][2]);
                continue;
            }
            let Some(drawn) = drawn_geom(model, geom, dressed) else { continue };
            if drawn.r#type != "mesh" {
                geoms.push(drawn);
                continue;
            }
            // A mesh is drawn by as many shapes as it has parts.
            let parts = parts.entry(model.geom_dataid()[geom]).or_insert_with(|| {
                let first = meshes.len();
                meshes.extend(drawn_mesh(model, model.geom_dataid()[geom] as usize));
                first..meshes.len()
            });
            geoms.extend(parts.clone().map(|mesh| DrawnGeom { mesh: Some(mesh), ..drawn.clone() }));
        }
        Drawing {
            bodies: (0..model.nbody() as usize).map(|body| drawn_body(model, body)).collect(),
            geoms,
            floor,
            camera: camera(model, from),
            start: start(model),
            meshes,
        }
    }
}

fn drawn_body(model: &MjModel, body: usize) -> DrawnBody {
    let first = model.body_jntadr()[body].max(0) as usize;
    let joint = |joint: usize| {
        let at = model.jnt_qposadr()[joint] as usize;
        DrawnJoint {
            r#type: match model.jnt_type()[joint] {
                mjJNT_FREE => "free",
                mjJNT_BALL => "ball",
                mjJNT_SLIDE => "slide",
                mjJNT_HINGE => "hinge",
            },
            at,
            pos: model.jnt_pos()[joint],
            axis: model.jnt_axis()[joint],
            rest: model.qpos0()[at],
        }
    };
    let mocap = usize::try_from(model.body_mocapid()[body]).ok();
    DrawnBody {
        parent: model.body_parentid()[body] as usize,
        pos: model.body_pos()[body],
        quat: model.body_quat()[body],
        joints: (first..first + model.body_jntnum()[body] as usize).map(joint).collect(),
        mocap: mocap.map(|mocap| model.nq() as usize + 7 * mocap),
    }
}

fn is_floor(model: &MjModel, geom: usize) -> bool {
    let [width, length, _] = model.geom_size()[geom];
    let level = model.geom_quat()[geom][0] > 0.9999 && model.geom_bodyid()[geom] == 0;
    let endless = model.geom_type()[geom] == mjGEOM_PLANE && width == 0.0 && length == 0.0;
    endless && level && model.geom_group()[geom] < HIDDEN
}

/// A shape, unless it is of a kind that a page does not draw, or hidden.
fn drawn_geom(model: &MjModel, geom: usize, dressed: Option<&str>) -> Option<DrawnGeom> {
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
    let body = model.geom_bodyid()[geom] as usize;
    // The primitives of a dressed hand are hidden, but for a plain picture.
    let plain = kind != "mesh" && dressed.is_some_and(|bodies| is_of(model, geom, bodies));
    if model.geom_group()[geom] >= HIDDEN && !plain {
        return None;
    }
    let material = usize::try_from(model.geom_matid()[geom]).ok();
    let shine = |of: &[f32]| material.map_or(0.5, |material| of[material]);
    // As MuJoCo draws it: a colour of the shape's own goes before the material's.
    let own = model.geom_rgba()[geom];
    let of_material = material.filter(|_| own == UNCOLOURED).map(|material| model.mat_rgba()[material]);
    Some(DrawnGeom {
        r#type: kind,
        body,
        size: model.geom_size()[geom],
        pos: model.geom_pos()[geom],
        quat: model.geom_quat()[geom],
        rgba: of_material.unwrap_or(own),
        specular: shine(model.mat_specular()),
        shininess: shine(model.mat_shininess()),
        mesh: None,
        fine: dressed.is_some() && kind == "mesh",
        plain,
    })
}

/// The parts of a mesh. They have one corner for each pair of point and normal that a triangle uses, in the order of first
/// use.
fn drawn_mesh(model: &MjModel, mesh: usize) -> Vec<DrawnMesh> {
    let first = model.mesh_faceadr()[mesh];
    let points = model.mesh_vertadr()[mesh];
    let normals = model.mesh_normaladr()[mesh];
    let faces = first as usize..(first + model.mesh_facenum()[mesh]) as usize;
    let mut places = BTreeMap::new();
    let mut parts = vec![DrawnMesh::default()];
    for (face, directions) in model.mesh_face()[faces.clone()].iter().zip(&model.mesh_facenormal()[faces]) {
        if parts.last().is_some_and(|part| part.corners.len() + 3 > MOST_CORNERS) {
            parts.push(DrawnMesh::default());
            places.clear();
        }
        let Some(DrawnMesh { corners, triangles }) = parts.last_mut() else { continue };
        triangles.push([0, 1, 2].map(|corner| {
            let point = model.mesh_vert()[(points + face[corner]) as usize];
            let normal = model.mesh_normal()[(normals + directions[corner]) as usize];
            // Points of one place and direction, as a picture shows them, are one corner.
            let key = (point.map(|x| (x * 5e4).round() as i64), normal.map(|x| (x * 16.0).round() as i64));
            *places.entry(key).or_insert_with(|| {
                corners.push((point, normal));
                corners.len() - 1
            })
        }));
    }
    for part in &mut parts {
        part.triangles.retain(|[a, b, c]| a != b && b != c && a != c);
    }
    parts
}

fn camera(model: &MjModel, from: Option<Camera>) -> DrawnCamera {
    let global = &model.vis().global;
    let stat = model.stat();
    let Camera { azimuth, elevation, distance } = from.unwrap_or(Camera {
        azimuth: global.azimuth.into(),
        elevation: global.elevation.into(),
        distance: 1.5 * stat.extent,
    });
    DrawnCamera { azimuth, elevation, distance, center: stat.center, fovy: global.fovy.into(), fit: from.is_none() }
}

fn start(model: &MjModel) -> Vec<f64> {
    let mut numbers = model.qpos0().to_vec();
    let mocap = (0..model.nbody() as usize).filter(|&body| model.body_mocapid()[body] >= 0);
    for body in mocap {
        numbers.extend(model.body_pos()[body]);
        numbers.extend(model.body_quat()[body]);
    }
    numbers
}
