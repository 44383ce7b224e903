//! The places of the parts of a body in its frame, which of them can touch anything, and their colours.

use mujoco_rs::prelude::MjModel;

use super::constants::ids;
use crate::quat::{self, Quat};

/// A position in m, and an orientation.
pub type Placed = ([f64; 3], Quat);

/// The poses in the frame of the body `top`: of itself and of the bodies that it carries, where no joint has moved.
pub fn frames_within(model: &MjModel, top: usize) -> Vec<Option<Placed>> {
    let mut frames = vec![None; model.nbody() as usize];
    frames[top] = Some(([0.0; 3], quat::IDENTITY));
    // Every body has a higher number than its parent.
    for body in top + 1..frames.len() {
        let parent = frames[model.body_parentid()[body] as usize];
        frames[body] =
            parent.map(|parent| inside(parent, model.body_pos()[body], model.body_quat()[body]));
    }
    frames
}

/// The geoms of the bodies that have a pose, each with its own in the same frame.
pub fn geoms_within(model: &MjModel, frames: &[Option<Placed>]) -> Vec<(usize, Placed)> {
    ids(model.ngeom())
        .filter_map(|geom| {
            let frame = frames[model.geom_bodyid()[geom] as usize]?;
            let place = inside(frame, model.geom_pos()[geom], model.geom_quat()[geom]);
            Some((geom, place))
        })
        .collect()
}

/// A pose that is given in a frame as a pose in the surroundings of that frame.
pub fn inside((origin, axes): Placed, position: [f64; 3], orientation: Quat) -> Placed {
    let [x, y, z] = quat::rotate(axes, position);
    (
        [origin[0] + x, origin[1] + y, origin[2] + z],
        quat::mul(axes, orientation),
    )
}

/// Whether a geom can be in a contact.
pub fn touches(model: &MjModel, geom: usize) -> bool {
    let id = geom as i32;
    model.geom_contype()[geom] != 0
        || model.geom_conaffinity()[geom] != 0
        || model.pair_geom1().contains(&id)
        || model.pair_geom2().contains(&id)
}

/// The colour of a shape that has none.
const UNCOLOURED: [f32; 4] = [0.5, 0.5, 0.5, 1.0];

/// The colour of a shape as MuJoCo draws it: one of its own goes before the material's.
pub fn colour_of(model: &MjModel, geom: usize) -> [f32; 4] {
    let own = model.geom_rgba()[geom];
    match usize::try_from(model.geom_matid()[geom]) {
        Ok(material) if own == UNCOLOURED => model.mat_rgba()[material],
        _ => own,
    }
}
