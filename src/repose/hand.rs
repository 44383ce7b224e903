//! The hand in a scene: its parts in the task's order, bound once, and the layout of observations that follows from them.

use std::collections::BTreeSet;

use anyhow::{Error, Result, bail, ensure};

use super::observation::Layout;
use crate::sim::{Actuator, Body, Frame, FreeJoint, Hinge, Mocap, Parts, Scene};

/// Joints of the Shadow Hand in observation order, without the prefix that they have in a scene.
pub const JOINTS: [&str; 24] = [
    "THJ5", "THJ4", "THJ3", "THJ2", "THJ1", "FFJ4", "FFJ3", "FFJ2", "FFJ1", "MFJ4", "MFJ3", "MFJ2",
    "MFJ1", "RFJ4", "RFJ3", "RFJ2", "RFJ1", "LFJ5", "LFJ4", "LFJ3", "LFJ2", "LFJ1", "WRJ2", "WRJ1",
];

/// Actuators of the Shadow Hand in action order, without the prefix and `A_`. A J0 drives the sum of J2 and J1.
pub const ACTUATORS: [&str; 20] = [
    "THJ5", "THJ4", "THJ3", "THJ2", "THJ1", "FFJ4", "FFJ3", "FFJ0", "MFJ4", "MFJ3", "MFJ0", "RFJ4",
    "RFJ3", "RFJ0", "LFJ5", "LFJ4", "LFJ3", "LFJ0", "WRJ2", "WRJ1",
];

/// Fingertip bodies of the Shadow Hand in observation order, without the prefix.
pub const FINGERTIPS: [&str; 5] = ["ffdistal", "mfdistal", "rfdistal", "lfdistal", "thdistal"];

/// Everything in a scene that the task uses.
#[derive(Clone)]
pub struct Hand {
    /// The names of its parts.
    pub parts: Parts,
    /// Joints in observation order.
    pub joints: Vec<Hinge>,
    /// Actuators in action order.
    pub actuators: Vec<Actuator>,
    /// The joints that each actuator drives, and the coefficients of their sum. There are none for a tendon along a path in space.
    pub driven: Vec<Vec<(String, f64)>>,
    /// Fingertips in observation order.
    pub fingertips: Vec<Frame>,
    /// The first bodies of the trees that carry the fingertips, an arm's included.
    pub roots: Vec<Body>,
    /// The object, by default a cube.
    pub object: FreeJoint,
    /// The body that shows the goal.
    pub goal: Mocap,
    /// The number of the keyframe in which an episode starts, if it does.
    pub keyframe: Option<usize>,
    /// The generalised positions in which an episode starts, before noise.
    pub start: Vec<f64>,
    /// The layout of observations.
    pub layout: Layout,
}

impl Hand {
    /// Finds the parts of the hand in `scene` that are not `named`. They have the order of the Shadow Hand if they have
    /// its names with one prefix. Otherwise they are found by the structure of the scene.
    ///
    /// # Errors
    /// Fails with one message on all that is missing or ambiguous, and the settings that mend it.
    pub fn find(scene: &Scene, named: &Parts) -> Result<Parts> {
        let mut parts = named.clone();
        if let Some(shadow) = shadow_hand(scene) {
            for (own, of_shadow) in [
                (&mut parts.joints, shadow.joints),
                (&mut parts.actuators, shadow.actuators),
                (&mut parts.fingertips, shadow.fingertips),
            ] {
                if own.is_empty() {
                    *own = of_shadow;
                }
            }
        }
        scene.find_parts(parts)
    }

    /// Binds these parts of `scene`, all of which are named but for the start. Its policy is `told` what is known, or not.
    ///
    /// # Errors
    /// Fails with one message on all names that are missing, and on all that belong to another kind of object.
    pub fn bind(scene: &Scene, parts: Parts, told: bool) -> Result<Self> {
        let mut problems = Vec::new();
        let joints = each(&parts.joints, |joint| scene.hinge(joint), &mut problems);
        let actuators = each(
            &parts.actuators,
            |actuator| scene.servo(actuator),
            &mut problems,
        );
        let fingertips = each(&parts.fingertips, |tip| scene.frame(tip), &mut problems);
        let mut note = |error: Error| problems.push(error.to_string());
        let object = scene.free_body(&parts.object).map_err(&mut note);
        let goal = scene.mocap(&parts.goal).map_err(&mut note);
        let keyframe = scene.start(&parts.start).map_err(&mut note);
        let driven: Vec<_> = actuators
            .iter()
            .map(|&actuator| scene.driven(actuator))
            .collect();
        for (joint, _) in driven.iter().flatten() {
            if let Err(error) = scene.hinge(joint) {
                note(error);
            }
        }
        problems.sort();
        problems.dedup();
        let (Ok(object), Ok(goal), Ok(keyframe), []) = (object, goal, keyframe, &problems[..])
        else {
            bail!(problems.join("; "))
        };
        let controls = scene.controls();
        ensure!(
            controls == actuators.len(),
            "has {controls} controls, but it must have exactly the {} of the hand",
            actuators.len()
        );
        Ok(Self {
            roots: roots(scene, &parts, &fingertips)?,
            start: scene.pose_of(keyframe),
            layout: Layout::new(joints.len(), fingertips.len(), actuators.len(), told),
            parts,
            joints,
            actuators,
            driven,
            fingertips,
            object,
            goal,
            keyframe,
        })
    }

    /// Where an episode starts the object, before noise, m.
    pub fn place(&self) -> [f64; 3] {
        *self.start[self.object.qpos..]
            .first_chunk()
            .expect("a free joint")
    }

    /// The prefix of its names if it has the names of the Shadow Hand.
    pub fn side(&self) -> Option<&str> {
        let prefix = self.parts.joints.first()?.strip_suffix(JOINTS[0])?;
        self.parts
            .joints
            .iter()
            .map(|name| name.strip_prefix(prefix))
            .eq(JOINTS.map(Some))
            .then_some(prefix)
    }
}

/// The parts of a Shadow Hand, if all of its names are there with one prefix.
fn shadow_hand(scene: &Scene) -> Option<Parts> {
    let joints = scene.joints();
    let actuators = scene.actuators();
    let with =
        |names: &[&str], prefix: &str| names.iter().map(|name| format!("{prefix}{name}")).collect();
    joints
        .iter()
        .filter_map(|name| name.strip_suffix(JOINTS[0]))
        .map(|prefix| Parts {
            joints: with(&JOINTS, prefix),
            actuators: with(&ACTUATORS, &format!("{prefix}A_")),
            fingertips: with(&FINGERTIPS, prefix),
            ..Parts::default()
        })
        .find(|hand| {
            hand.joints.iter().all(|name| joints.contains(name))
                && hand.actuators.iter().all(|name| actuators.contains(name))
                && hand.fingertips.iter().all(|name| scene.body(name).is_ok())
        })
}

/// The first bodies of the trees that carry these fingertips.
///
/// # Errors
/// Fails if a fingertip is no part of a hand.
fn roots(scene: &Scene, parts: &Parts, fingertips: &[Frame]) -> Result<Vec<Body>> {
    let roots: BTreeSet<Body> = fingertips.iter().map(|&tip| scene.root(tip)).collect();
    let others = ["world", &parts.object, &parts.goal].map(|name| scene.body(name).ok());
    ensure!(
        roots.iter().all(|&root| !others.contains(&Some(root))),
        "hand.fingertips must name parts of the hand, and not the world, the object or the goal"
    );
    Ok(Vec::from_iter(roots))
}

/// Finds each of these names, and lists what is wrong.
fn each<T>(
    names: &[String],
    find: impl Fn(&str) -> Result<T>,
    problems: &mut Vec<String>,
) -> Vec<T> {
    let mut found = Vec::new();
    for (i, name) in names.iter().enumerate() {
        if names[..i].contains(name) {
            problems.push(format!("`{name}` is named twice"));
        }
        match find(name) {
            Ok(part) => found.push(part),
            Err(error) => problems.push(error.to_string()),
        }
    }
    found
}
