//! The parts of a hand and its surroundings, found by the structure of a scene where they are not named.

use std::collections::BTreeSet;

use anyhow::{Result, bail};
use mujoco_rs::prelude::{MjtJoint, MjtObjBase, MjtTrn, MjtWrap};
use serde::{Deserialize, Serialize};

use super::Scene;
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
    /// The mocap body that shows the goal; empty if there is none.
    pub goal: String,
    /// The keyframe in which an episode starts; if empty, `start` or `home`, else the only one, else the default pose.
    pub start: String,
}

/// What a user is told whose scene has nothing to turn.
const NO_OBJECT: &str = "has no body with a free joint that the hand could turn; for a cube like the built-in one, add \
                         <body name=\"cube\" pos=\"X Y Z\"><freejoint/><geom type=\"box\" size=\".025 .025 .025\" \
                         mass=\".028\" friction=\"1.2\"/></body> to <worldbody>";

impl Scene {
    /// Returns `named`, completed by what the structure of the scene says: all actuators; the limited hinges of the trees that
    /// they move; the last bodies of these trees; the only other body with a free joint; the only other mocap body.
    ///
    /// # Errors
    /// Fails with one message on all that is missing or ambiguous, and the settings that mend it.
    pub fn find_parts(&self, named: &Parts) -> Result<Parts> {
        let (mut parts, mut problems) = (named.clone(), Vec::new());
        if parts.actuators.is_empty() {
            parts.actuators = self.names(MjtObjBase::mjOBJ_ACTUATOR, &mut problems);
        }
        let actuators: Vec<usize> =
            parts.actuators.iter().filter_map(|name| self.model.name_to_id(MjtObjBase::mjOBJ_ACTUATOR, name)).collect();
        let trees: BTreeSet<usize> = actuators.iter().flat_map(|&id| self.trees_of(id)).collect();
        let of_hand = |body: usize| trees.contains(&(self.model.body_rootid()[body] as usize));
        let hinges: Vec<usize> = (0..self.model.njnt() as usize)
            .filter(|&joint| of_hand(self.model.jnt_bodyid()[joint] as usize))
            .filter(|&joint| self.model.jnt_type()[joint] == MjtJoint::mjJNT_HINGE && self.model.jnt_limited()[joint])
            .collect();
        if parts.joints.is_empty() {
            let names = hinges.iter().map(|&joint| self.name(MjtObjBase::mjOBJ_JOINT, joint));
            parts.joints = names.filter_map(|name| name.map_err(|problem| problems.push(problem)).ok()).collect();
        }
        if parts.joints.is_empty() || parts.actuators.is_empty() {
            let found = "position servos that move limited hinges are needed";
            problems.push(format!("has no hand: {found}; hand.joints and hand.actuators name them"));
        }
        if parts.fingertips.is_empty() {
            parts.fingertips = self.last_bodies(&hinges, &of_hand, &mut problems);
        }
        if parts.fingertips.is_empty() {
            problems.push("has no fingertips; hand.fingertips names them".into());
        }
        let mut free = Vec::new();
        let mut goals = Vec::new();
        for body in (1..self.model.nbody() as usize).filter(|&body| !of_hand(body)) {
            let joint = usize::try_from(self.model.body_jntadr()[body]).ok();
            if joint.is_some_and(|joint| self.model.jnt_type()[joint] == MjtJoint::mjJNT_FREE) {
                free.push(self.name(MjtObjBase::mjOBJ_BODY, body));
            }
            if self.model.body_mocapid()[body] >= 0 {
                goals.push(self.name(MjtObjBase::mjOBJ_BODY, body));
            }
        }
        for (found, part, none, what, setting) in [
            (free, &mut parts.object, Some(NO_OBJECT), "bodies with a free joint", "hand.object"),
            (goals, &mut parts.goal, None, "mocap bodies", "hand.goal"),
        ] {
            match (part.is_empty(), &found[..]) {
                (false, _) => {}
                (true, [Ok(only)]) => part.clone_from(only),
                (true, [Err(problem)]) => problems.push(problem.clone()),
                (true, []) => problems.extend(none.map(str::to_owned)),
                (true, several) => {
                    let names: Vec<String> =
                        several.iter().flatten().map(|name| format!("`{}`", shortened(name))).collect();
                    problems.push(format!("has several {what}, {}: name one by {setting}", names.join(", ")));
                }
            }
        }
        if !problems.is_empty() {
            bail!(problems.join("; "));
        }
        Ok(parts)
    }

    /// Returns the bodies of the hand, below a hinge, that carry no other body.
    fn last_bodies(
        &self,
        hinges: &[usize],
        of_hand: &dyn Fn(usize) -> bool,
        problems: &mut Vec<String>,
    ) -> Vec<String> {
        let count = self.model.nbody() as usize;
        let (mut moved, mut carries) = (vec![false; count], vec![false; count]);
        hinges.iter().for_each(|&joint| moved[self.model.jnt_bodyid()[joint] as usize] = true);
        // Every body has a higher number than its parent.
        for body in 1..count {
            let parent = self.model.body_parentid()[body] as usize;
            moved[body] |= moved[parent];
            carries[parent] = true;
        }
        let last = (1..count).filter(|&body| moved[body] && !carries[body] && of_hand(body));
        let names = last.map(|body| self.name(MjtObjBase::mjOBJ_BODY, body));
        names.filter_map(|name| name.map_err(|problem| problems.push(problem)).ok()).collect()
    }

    /// Returns the first bodies of the trees that an actuator moves.
    fn trees_of(&self, actuator: usize) -> Vec<usize> {
        let target = self.model.actuator_trnid()[actuator][0] as usize;
        let bodies: Vec<i32> = match self.model.actuator_trntype()[actuator] {
            MjtTrn::mjTRN_JOINT => vec![self.model.jnt_bodyid()[target]],
            MjtTrn::mjTRN_TENDON => {
                let first = self.model.tendon_adr()[target] as usize;
                let path = first..first + self.model.tendon_num()[target] as usize;
                path.filter_map(|wrap| {
                    let id = self.model.wrap_objid()[wrap] as usize;
                    match self.model.wrap_type()[wrap] {
                        MjtWrap::mjWRAP_JOINT => Some(self.model.jnt_bodyid()[id]),
                        MjtWrap::mjWRAP_SITE => Some(self.model.site_bodyid()[id]),
                        _ => None,
                    }
                })
                .collect()
            }
            _ => Vec::new(),
        };
        let roots = bodies.into_iter().map(|body| self.model.body_rootid()[body as usize] as usize);
        roots.filter(|&root| root != 0).collect()
    }

    /// Returns the name of an object, or a sentence if it has none.
    fn name(&self, kind: MjtObjBase, id: usize) -> Result<String, String> {
        let name = self.model.id_to_name(kind, id).filter(|name| !name.is_empty());
        let what = match kind {
            MjtObjBase::mjOBJ_ACTUATOR => "actuator",
            MjtObjBase::mjOBJ_JOINT => "joint",
            _ => "body",
        };
        name.map(str::to_owned).ok_or_else(|| format!("{what} {id} of the compiled scene needs a name"))
    }

    fn names(&self, kind: MjtObjBase, problems: &mut Vec<String>) -> Vec<String> {
        let count = if kind == MjtObjBase::mjOBJ_ACTUATOR { self.model.nactuator() } else { self.model.njnt() };
        let names = (0..count as usize).map(|id| self.name(kind, id));
        names.filter_map(|name| name.map_err(|problem| problems.push(problem)).ok()).collect()
    }

    /// Returns the names of all joints that have one.
    pub fn joints(&self) -> Vec<String> {
        self.names(MjtObjBase::mjOBJ_JOINT, &mut Vec::new())
    }
}
