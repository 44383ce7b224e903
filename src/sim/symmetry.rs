//! The rotations that map a body onto itself: its shapes that can touch, and its inertia.

use mujoco_rs::prelude::MjtGeomBase;

use super::constants::*;
use super::placing::{Placed, frames_within, geoms_within, inside, touches};
use super::{Body, Scene};
use crate::quat::{self, CUBE_ROTATIONS, Quat};

/// The largest difference of lengths and inertias, as a fraction of the largest one, and of entries of rotation matrices.
const TOLERANCE: f64 = 1e-5;

/// A shape that can touch others, in the frame of the body.
struct Shape {
    /// What it is, and the number of its mesh or height field, -1 for none.
    kind: (MjtGeomBase, i32),
    size: [f64; 3],
    place: Placed,
}

/// The form of a body with all that is attached to it.
struct Form {
    shapes: Vec<Shape>,
    /// Point masses (kg, and m in the frame of the body) with the same moments as all its parts.
    masses: Vec<(f64, [f64; 3])>,
    /// Whether parts of it move.
    moves: bool,
}

impl Scene {
    /// The numbers of the rotations in [`CUBE_ROTATIONS`] that map a body, with all that is attached to it, onto itself.
    /// With moving parts there is only the identity.
    pub fn symmetry(&self, body: Body) -> Vec<usize> {
        let form = self.form(body);
        let turn = |i: usize| quat::normalized(CUBE_ROTATIONS[i].map(f64::from));
        (0..CUBE_ROTATIONS.len())
            .filter(|&i| i == 0 || form.holds(turn(i)))
            .collect()
    }

    /// The axes of a body about which any turn maps it onto itself: all three for a sphere, one for a cylinder.
    pub fn round_axes(&self, body: Body) -> String {
        let form = self.form(body);
        let (sin, cos) = 0.5_f64.sin_cos();
        [
            ('x', [cos, sin, 0.0, 0.0]),
            ('y', [cos, 0.0, sin, 0.0]),
            ('z', [cos, 0.0, 0.0, sin]),
        ]
        .into_iter()
        .filter(|&(_, turn)| form.holds(turn))
        .map(|(axis, _)| axis)
        .collect()
    }

    fn form(&self, Body(top): Body) -> Form {
        let model = &self.model;
        let frames = frames_within(model, top);
        let mut masses = Vec::new();
        let mut moves = false;
        for (body, frame) in frames.iter().enumerate() {
            let Some(frame) = *frame else { continue };
            moves |= body > top && model.body_jntnum()[body] > 0;
            let mass = model.body_mass()[body];
            let (centre, axes) = inside(frame, model.body_ipos()[body], model.body_iquat()[body]);
            let axes = matrix(axes);
            let inertia = model.body_inertia()[body];
            let half = inertia.iter().sum::<f64>() / 2.0;
            // A sixth of the mass at each end of the principal axes.
            for axis in (0..3).filter(|_| mass > 0.0) {
                let reach = (3.0 * (half - inertia[axis]).max(0.0) / mass).sqrt();
                for reach in [reach, -reach] {
                    masses.push((
                        mass / 6.0,
                        [0, 1, 2].map(|i| centre[i] + reach * axes[i][axis]),
                    ));
                }
            }
        }
        let shapes = geoms_within(model, &frames)
            .into_iter()
            .filter(|&(geom, _)| touches(model, geom))
            .map(|(geom, place)| Shape {
                kind: (model.geom_type()[geom], model.geom_dataid()[geom]),
                size: model.geom_size()[geom],
                place,
            });
        Form {
            shapes: shapes.collect(),
            masses,
            moves,
        }
    }
}

impl Form {
    /// Whether a rotation maps it onto itself.
    fn holds(&self, turn: Quat) -> bool {
        let mut turned = self.shapes.iter().map(|shape| shape.turned(turn));
        !self.moves
            && self.keeps_masses(turn)
            && turned.all(|shape| self.shapes.iter().any(|other| shape.fills(other)))
    }

    fn keeps_masses(&self, turn: Quat) -> bool {
        let own = self.moments(quat::IDENTITY);
        let turned = self.moments(turn);
        let largest = |values: &[f64]| values.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        // A centre of mass that is off by a rounding error does not count.
        alike(&turned[..3], &own[..3], largest(&own[..3]).max(1e-9))
            && alike(&turned[3..], &own[3..], largest(&own[3..]))
    }

    /// The first three moments of the turned masses, kg m, and their nine second ones, kg m².
    fn moments(&self, turn: Quat) -> [f64; 12] {
        let mut moments = [0.0; 12];
        for &(mass, place) in &self.masses {
            let place = quat::rotate(turn, place);
            for (i, moment) in moments.iter_mut().enumerate() {
                *moment += mass
                    * if i < 3 {
                        place[i]
                    } else {
                        place[i / 3 - 1] * place[i % 3]
                    };
            }
        }
        moments
    }
}

/// The rotation as a matrix: its columns are the rotated axes.
fn matrix(turn: Quat) -> [[f64; 3]; 3] {
    let columns =
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| quat::rotate(turn, axis));
    [0, 1, 2].map(|row| columns.map(|column| column[row]))
}

/// Whether values are equal but for rounding.
fn alike(a: &[f64], b: &[f64], scale: f64) -> bool {
    a.iter()
        .zip(b)
        .all(|(a, b)| (a - b).abs() <= TOLERANCE * scale)
}

impl Shape {
    fn turned(&self, turn: Quat) -> Self {
        let (position, orientation) = self.place;
        Self {
            place: inside(([0.0; 3], turn), position, orientation),
            ..*self
        }
    }

    /// Whether this shape is in the place of another and fills the same space.
    fn fills(&self, other: &Self) -> bool {
        let (position, orientation) = self.place;
        let scale = self
            .size
            .iter()
            .chain(&position)
            .fold(0.0, |most: f64, x| most.max(x.abs()));
        if self.kind != other.kind || !alike(&position, &other.place.0, scale) {
            return false;
        }
        let between = matrix(quat::mul(quat::conj(other.place.1), orientation));
        let size = match self.kind.0 {
            mjGEOM_SPHERE => self.size,
            // Their axis is z.
            mjGEOM_CAPSULE | mjGEOM_CYLINDER if between[2][2].abs() >= 1.0 - TOLERANCE => self.size,
            mjGEOM_BOX | mjGEOM_ELLIPSOID => {
                let axis = |row: [f64; 3]| (0..3).find(|&j| row[j].abs() >= 1.0 - TOLERANCE);
                let [Some(x), Some(y), Some(z)] = between.map(axis) else {
                    return false;
                };
                [x, y, z].map(|axis| self.size[axis])
            }
            _ if (0..3).all(|i| between[i][i] >= 1.0 - TOLERANCE) => self.size,
            _ => return false,
        };
        alike(&size, &other.size, scale)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::super::{Compilation, Cone};
    use super::*;

    fn scene_with(object: &str) -> (Scene, Body) {
        let text = format!(
            "<mujoco><worldbody><body name='cube'><freejoint/>{object}</body></worldbody></mujoco>"
        );
        let mut file = tempfile::NamedTempFile::with_suffix(".xml").unwrap();
        file.write_all(text.as_bytes()).unwrap();
        let scene = Scene::load(Some(file.path()), &Compilation::plain(0.01, Cone::Scene)).unwrap();
        let body = scene.body("cube").unwrap();
        (scene, body)
    }

    #[test]
    fn an_object_has_the_rotations_of_a_cube_that_map_its_shapes_and_its_inertia_onto_themselves() {
        let cube = "<geom type='box' size='.025 .025 .025'/>";
        for (rotations, object) in [
            (24, cube),
            (24, "<geom type='sphere' size='.03'/>"),
            (8, "<geom type='box' size='.025 .025 .03'/>"),
            (8, "<geom type='cylinder' size='.025 .025'/>"),
            (8, "<geom type='capsule' size='.02 .025' euler='90 0 0'/>"),
            (4, "<geom type='box' size='.025 .02 .03'/>"),
            (4, "<geom type='ellipsoid' size='.025 .02 .03'/>"),
            (
                2,
                "<geom type='box' size='.03 .015 .015' pos='.015 0 0'/><geom type='box' size='.015 .03 .015' pos='0 .015 0'/>",
            ),
            (
                1,
                "<geom type='box' size='.03 .015 .015'/><geom type='box' size='.015 .02 .01' pos='-.015 .015 0'/>",
            ),
            (
                24,
                &format!(
                    "{cube}<geom type='box' size='.01 .02 .03' contype='0' conaffinity='0' mass='0'/>"
                ),
            ),
            (
                4,
                &format!(
                    "{cube}<geom type='sphere' size='.01' pos='0 0 .02' contype='0' conaffinity='0'/>"
                ),
            ),
            (
                24,
                &format!("{cube}<body><geom type='sphere' size='.01'/></body>"),
            ),
            (
                4,
                &format!("{cube}<body pos='0 .03 0'><geom type='sphere' size='.01'/></body>"),
            ),
            (
                1,
                &format!("{cube}<body><joint/><geom type='sphere' size='.01'/></body>"),
            ),
            (
                8,
                "<inertial pos='0 0 0' mass='.1' diaginertia='1e-4 1e-4 1.1e-4'/><geom type='sphere' size='.03'/>",
            ),
        ] {
            let (scene, body) = scene_with(object);
            assert_eq!(scene.symmetry(body).len(), rotations, "{object}");
        }
    }

    #[test]
    fn a_round_object_has_axes_about_which_no_turn_can_be_seen() {
        for (axes, object) in [
            ("", "<geom type='box' size='.025 .025 .025'/>"),
            ("xyz", "<geom type='sphere' size='.03'/>"),
            ("z", "<geom type='cylinder' size='.025 .025'/>"),
            ("y", "<geom type='capsule' size='.02 .025' euler='90 0 0'/>"),
            (
                "",
                "<geom type='cylinder' size='.025 .025'/><geom type='box' size='.01 .01 .01' pos='.02 0 0'/>",
            ),
        ] {
            let (scene, body) = scene_with(object);
            assert_eq!(scene.round_axes(body), axes, "{object}");
        }
    }

    #[test]
    fn the_cube_of_the_built_in_scene_has_all_24() {
        let scene = Scene::load(None, &Compilation::plain(0.01, Cone::Scene)).unwrap();
        assert_eq!(
            scene.symmetry(scene.body("cube").unwrap()),
            (0..24).collect::<Vec<_>>()
        );
    }
}
