//! The Shadow Hand in a scene: its names in the task's order, bound once, and the layouts that follow from them.

use anyhow::{Context, Result, ensure};

use crate::sim::{Actuator, Body, FreeJoint, Hinge, Mocap, Scene};

/// The length of an action: one value for each actuator.
pub const ACTION_SIZE: usize = 20;

/// Joints in observation order, without the prefix `rh_` that they have in a scene.
pub const JOINTS: [&str; 24] = [
    "THJ5", "THJ4", "THJ3", "THJ2", "THJ1", "FFJ4", "FFJ3", "FFJ2", "FFJ1", "MFJ4", "MFJ3", "MFJ2", "MFJ1", "RFJ4",
    "RFJ3", "RFJ2", "RFJ1", "LFJ5", "LFJ4", "LFJ3", "LFJ2", "LFJ1", "WRJ2", "WRJ1",
];

/// Actuators in action order, without the prefix `rh_A_` that they have in a scene. A J0 drives the sum of J2 and J1.
pub const ACTUATORS: [&str; ACTION_SIZE] = [
    "THJ5", "THJ4", "THJ3", "THJ2", "THJ1", "FFJ4", "FFJ3", "FFJ0", "MFJ4", "MFJ3", "MFJ0", "RFJ4", "RFJ3", "RFJ0",
    "LFJ5", "LFJ4", "LFJ3", "LFJ0", "WRJ2", "WRJ1",
];

/// The name of the body that the hand turns.
pub(super) const CUBE: &str = "cube";

/// The name of the body that shows the goal.
const TARGET: &str = "target";

/// Fingertip bodies in observation order, as named in the scene.
pub const FINGERTIPS: [&str; 5] = ["rh_ffdistal", "rh_mfdistal", "rh_rfdistal", "rh_lfdistal", "rh_thdistal"];

/// Everything in a scene that the task uses.
pub struct Hand {
    /// Joints in observation order.
    pub joints: [Hinge; 24],
    /// Actuators in action order.
    pub actuators: [Actuator; ACTION_SIZE],
    /// The joints that each actuator drives the sum of, as indices into `joints`.
    pub driven: [Vec<usize>; ACTION_SIZE],
    /// Fingertips: index, middle, ring, little finger, thumb.
    pub fingertips: [Body; 5],
    /// The body that carries the hand, an arm's included.
    pub root: Body,
    /// The cube.
    pub cube: FreeJoint,
    /// The cube that shows the goal.
    pub target: Mocap,
}

impl Hand {
    /// Finds every name in `scene`, in whatever order they appear in its file.
    ///
    /// # Errors
    /// Fails with all names that are missing, or with the first one that belongs to something else.
    pub fn bind(scene: &Scene) -> Result<Self> {
        let named = |kind: &'static str, begin: &'static str, names: &'static [&'static str]| {
            names.iter().map(move |name| (kind, format!("{begin}{name}")))
        };
        let lists = [
            named("joint", "rh_", &JOINTS),
            named("actuator", "rh_A_", &ACTUATORS),
            named("body", "", &FINGERTIPS),
            named("body", "", &[CUBE, TARGET]),
        ];
        let missing: Vec<String> = lists
            .into_iter()
            .flatten()
            .filter(|(kind, name)| !scene.has(kind, name))
            .map(|(kind, name)| format!("{kind} `{name}`"))
            .collect();
        ensure!(missing.is_empty(), "has no {}", missing.join(", "));
        let joints = each(JOINTS, |joint| scene.hinge(&format!("rh_{joint}")))?;
        let driven = each(ACTUATORS, |actuator| Ok(driven_by(actuator)))?;
        let actuators = each(ACTUATORS, |actuator| {
            let coupled: Vec<String> = match actuator.strip_suffix("J0") {
                Some(finger) => vec![format!("rh_{finger}J2"), format!("rh_{finger}J1")],
                None => Vec::new(),
            };
            scene.actuator(&format!("rh_A_{actuator}"), &format!("rh_{actuator}"), &coupled)
        })?;
        ensure!(
            scene.controls() == ACTION_SIZE,
            "has {} controls, but it must have exactly the {ACTION_SIZE} of the hand",
            scene.controls()
        );
        let fingertips = each(FINGERTIPS, |tip| scene.body(tip))?;
        Ok(Self {
            joints,
            driven,
            actuators,
            fingertips,
            root: scene.root(fingertips[0]),
            cube: scene.free_body(CUBE)?,
            target: scene.mocap(TARGET)?,
        })
    }
}

/// Returns the indices into [`JOINTS`] of the joints that `actuator` drives.
fn driven_by(actuator: &str) -> Vec<usize> {
    let drives = |joint: &str| match actuator.strip_suffix("J0") {
        Some(finger) => joint.strip_prefix(finger).is_some_and(|rest| rest == "J2" || rest == "J1"),
        None => joint == actuator,
    };
    (0..JOINTS.len()).filter(|&i| drives(JOINTS[i])).collect()
}

fn each<T, const N: usize>(names: [&str; N], find: impl FnMut(&str) -> Result<T>) -> Result<[T; N]> {
    let found: Vec<T> = names.into_iter().map(find).collect::<Result<_>>()?;
    found.try_into().ok().context("one result per name")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coupled_actuators_drive_two_joints_and_all_joints_are_driven_once() {
        assert_eq!(driven_by("FFJ0").iter().map(|&i| JOINTS[i]).collect::<Vec<_>>(), ["FFJ2", "FFJ1"]);
        let mut all: Vec<usize> = ACTUATORS.iter().flat_map(|a| driven_by(a)).collect();
        all.sort_unstable();
        assert_eq!(all, (0..24).collect::<Vec<_>>());
    }
}
