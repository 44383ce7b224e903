//! The parts of a hand and its surroundings, found by the structure of a scene where they are not named.

use std::collections::BTreeSet;

use anyhow::{Result, bail};
use mujoco_rs::prelude::{MjtJoint, MjtObjBase, MjtTrn, MjtWrap};
use serde::{Deserialize, Serialize};

use super::{Actuator, Scene};
use crate::os::shortened;

/// The names of what a task uses in a scene. What is empty is found by structure.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Parts {
    /// The hinges of the hand, in the order of observations.
    pub joints: Vec<String>,
    /// The position servos of the hand, in the order of actions.
    pub actuators: Vec<String>,
    /// The bodies or sites at the ends of the fingers, in the order of observations.
    pub fingertips: Vec<String>,
    /// The body that the hand turns.
    pub object: String,
    /// The mocap body that shows the goal. Empty if there is none.
    pub goal: String,
    /// The keyframe in which an episode starts. If empty: `start` or `home`, else the only one, else the default pose.
    pub start: String,
}

/// The message for a user whose scene has nothing to turn.
const NO_OBJECT: &str = "has no body with a free joint that the hand could turn; for a cube like the built-in one, add \
                         <body name=\"cube\" pos=\"X Y Z\"><freejoint/><geom type=\"box\" size=\".025 .025 .025\" \
                         mass=\".028\" friction=\"1.2\"/></body> to <worldbody>";

/// Takes the only one that was `found` for a part that is not named, or says what is wrong: `none` if there is none, or what there
/// are several of.
fn settle(
    part: &mut String,
    found: &[Result<String, String>],
    none: Option<&str>,
    what: &str,
    setting: &str,
) -> Option<String> {
    if !part.is_empty() {
        return None;
    }
    match found {
        [Ok(only)] => {
            part.clone_from(only);
            None
        }
        [Err(problem)] => Some(problem.clone()),
        [] => none.map(str::to_owned),
        several => {
            let names: Vec<String> = several.iter().flatten().map(|name| format!("`{}`", shortened(name))).collect();
            Some(format!("has several {what}, {}: name one by {setting}", names.join(", ")))
        }
    }
}

impl Scene {
    /// `named`, completed by the structure of the scene. The actuators are all actuators, and the joints are the
    /// limited hinges of the trees that they move. The fingertips are the last bodies of these trees. The object is the only
    /// other body with a free joint. The goal is the only other mocap body that no equality constraint ties to something.
    ///
    /// # Errors
    /// Fails with one message on all that is missing or ambiguous, and the settings that mend it.
    pub fn find_parts(&self, named: &Parts) -> Result<Parts> {
        let mut parts = named.clone();
        let mut problems = Vec::new();
        if parts.actuators.is_empty() {
            parts.actuators = self.names(MjtObjBase::mjOBJ_ACTUATOR, 0..self.model.nactuator() as usize, &mut problems);
        }
        let ids = parts.actuators.iter().filter_map(|name| self.model.name_to_id(MjtObjBase::mjOBJ_ACTUATOR, name));
        let trees: BTreeSet<usize> = ids.flat_map(|id| self.trees_of(id)).collect();
        let of_hand = |body: usize| trees.contains(&(self.model.body_rootid()[body] as usize));
        let hinges = self.limited_hinges(&of_hand);
        if parts.joints.is_empty() {
            parts.joints = self.names(MjtObjBase::mjOBJ_JOINT, hinges.iter().copied(), &mut problems);
        }
        if parts.joints.is_empty() || parts.actuators.is_empty() {
            let found = "position servos that move limited hinges are needed";
            problems.push(format!("has no hand: {found}; hand.joints and hand.actuators name them"));
        }
        if parts.fingertips.is_empty() {
            parts.fingertips = self.names(MjtObjBase::mjOBJ_BODY, self.last_bodies(&hinges), &mut problems);
        }
        if parts.fingertips.is_empty() {
            problems.push("has no fingertips; hand.fingertips names them".into());
        }
        let free = self.bodies(&|body| !of_hand(body) && self.free_joint(body).is_some());
        let held = self.trees_of_constraints();
        let is_mocap = |body: usize| self.model.body_mocapid()[body] >= 0;
        let goals = self.bodies(&|body| !of_hand(body) && is_mocap(body) && !held.contains(&body));
        problems.extend(settle(&mut parts.object, &free, Some(NO_OBJECT), "bodies with a free joint", "hand.object"));
        problems.extend(settle(&mut parts.goal, &goals, None, "mocap bodies", "hand.goal"));
        if !problems.is_empty() {
            bail!(problems.join("; "));
        }
        Ok(parts)
    }

    /// The names of the bodies that are `sought`, or what is wrong with a name.
    fn bodies(&self, sought: &dyn Fn(usize) -> bool) -> Vec<Result<String, String>> {
        let bodies = (1..self.model.nbody() as usize).filter(|&body| sought(body));
        bodies.map(|body| self.name(MjtObjBase::mjOBJ_BODY, body)).collect()
    }

    /// The limited hinges of the bodies that are `sought`.
    fn limited_hinges(&self, sought: &dyn Fn(usize) -> bool) -> Vec<usize> {
        let model = &self.model;
        let hinge = |joint: usize| model.jnt_type()[joint] == MjtJoint::mjJNT_HINGE && model.jnt_limited()[joint];
        let joints = 0..model.njnt() as usize;
        joints.filter(|&joint| sought(model.jnt_bodyid()[joint] as usize) && hinge(joint)).collect()
    }

    /// The first bodies of the trees that equality constraints tie to each other, e.g. a mocap body that guides a hand.
    fn trees_of_constraints(&self) -> BTreeSet<usize> {
        let model = &self.model;
        let ids = model.eq_objtype().iter().zip(model.eq_obj1id().iter().zip(model.eq_obj2id()));
        let tied = ids.flat_map(|(&kind, (&a, &b))| [a, b].map(|id| (kind, id as usize)));
        let bodies = tied.filter_map(|(kind, id)| match kind {
            MjtObjBase::mjOBJ_BODY => Some(id),
            MjtObjBase::mjOBJ_SITE => Some(model.site_bodyid()[id] as usize),
            _ => None,
        });
        bodies.map(|body| model.body_rootid()[body] as usize).collect()
    }

    /// The bodies that one of these hinges moves and that carry no other body.
    fn last_bodies(&self, hinges: &[usize]) -> Vec<usize> {
        let count = self.model.nbody() as usize;
        let mut moved = vec![false; count];
        let mut carries = vec![false; count];
        hinges.iter().for_each(|&joint| moved[self.model.jnt_bodyid()[joint] as usize] = true);
        // Every body has a higher number than its parent.
        for body in 1..count {
            let parent = self.model.body_parentid()[body] as usize;
            moved[body] |= moved[parent];
            carries[parent] = true;
        }
        (1..count).filter(|&body| moved[body] && !carries[body]).collect()
    }

    /// The first bodies of the trees that an actuator moves.
    fn trees_of(&self, actuator: usize) -> impl Iterator<Item = usize> {
        let bodies = self.wraps(actuator).into_iter().filter_map(|(kind, id, _)| match kind {
            MjtWrap::mjWRAP_JOINT => Some(self.model.jnt_bodyid()[id]),
            MjtWrap::mjWRAP_SITE => Some(self.model.site_bodyid()[id]),
            _ => None,
        });
        bodies.map(|body| self.model.body_rootid()[body as usize] as usize).filter(|&root| root != 0)
    }

    /// The joints that an actuator drives, with the coefficients of their sum, which is its length. A tendon along a path
    /// in space drives no sum.
    pub fn driven(&self, actuator: Actuator) -> Vec<(String, f64)> {
        let name = |joint: usize| self.model.id_to_name(MjtObjBase::mjOBJ_JOINT, joint).unwrap_or_default().to_owned();
        let joints = self.wraps(actuator.id).into_iter().filter(|(kind, ..)| *kind == MjtWrap::mjWRAP_JOINT);
        joints.map(|(_, joint, coefficient)| (name(joint), coefficient)).collect()
    }

    /// What an actuator or its tendon acts on: the kind, the number, and the coefficient if it is a joint.
    fn wraps(&self, actuator: usize) -> Vec<(MjtWrap, usize, f64)> {
        let target = self.model.actuator_trnid()[actuator][0] as usize;
        let wrap =
            |at: usize| (self.model.wrap_type()[at], self.model.wrap_objid()[at] as usize, self.model.wrap_prm()[at]);
        match self.model.actuator_trntype()[actuator] {
            MjtTrn::mjTRN_JOINT => vec![(MjtWrap::mjWRAP_JOINT, target, 1.0)],
            MjtTrn::mjTRN_TENDON => {
                let first = self.model.tendon_adr()[target] as usize;
                (first..first + self.model.tendon_num()[target] as usize).map(wrap).collect()
            }
            _ => Vec::new(),
        }
    }

    /// The name of an object, or a sentence if it has none.
    fn name(&self, kind: MjtObjBase, id: usize) -> Result<String, String> {
        let name = self.model.id_to_name(kind, id).filter(|name| !name.is_empty());
        let what = match kind {
            MjtObjBase::mjOBJ_ACTUATOR => "actuator",
            MjtObjBase::mjOBJ_JOINT => "joint",
            _ => "body",
        };
        name.map(str::to_owned).ok_or_else(|| format!("{what} {id} of the compiled scene needs a name"))
    }

    /// The names of those objects that have one. The others become `problems`.
    fn names(&self, kind: MjtObjBase, ids: impl IntoIterator<Item = usize>, problems: &mut Vec<String>) -> Vec<String> {
        let names = ids.into_iter().map(|id| self.name(kind, id));
        names.filter_map(|name| name.map_err(|problem| problems.push(problem)).ok()).collect()
    }

    /// The names of all joints that have one.
    pub fn joints(&self) -> Vec<String> {
        self.names(MjtObjBase::mjOBJ_JOINT, 0..self.model.njnt() as usize, &mut Vec::new())
    }

    /// The names of all actuators that have one.
    pub fn actuators(&self) -> Vec<String> {
        self.names(MjtObjBase::mjOBJ_ACTUATOR, 0..self.model.nactuator() as usize, &mut Vec::new())
    }
}
