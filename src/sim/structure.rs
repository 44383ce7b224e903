//! The parts of a hand and its surroundings, found by the structure of a scene where they are not named.

use std::collections::BTreeSet;
use std::iter;

use anyhow::{Result, ensure};
use mujoco_rs::prelude::{MjtObjBase, MjtWrap};
use serde::{Deserialize, Serialize};

use super::constants::*;
use super::{Actuator, FreeJoint, Hinge, Scene};
use crate::os::shortened;

/// The names of what a task uses in a scene. What is empty is found by structure.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
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

/// All that is missing or ambiguous in a scene, each with the setting that mends it.
type Problems = Vec<String>;

/// The message for a user whose scene has nothing to turn.
const NO_OBJECT: &str = "has no body with a free joint that the hand could turn; for a cube like the built-in one, add \
                         <body name=\"cube\" pos=\"X Y Z\"><freejoint/><geom type=\"box\" size=\".025 .025 .025\" \
                         mass=\".028\" friction=\"1.2\"/></body> to <worldbody>";

impl Scene {
    /// What `named` leaves open is found by the structure of the scene. The actuators are all actuators, and the joints are the
    /// limited hinges of the trees that they move. The fingertips are the last bodies of these trees. The object is the only
    /// other body with a free joint. The goal is the only other mocap body that no equality constraint ties to something.
    ///
    /// # Errors
    /// Fails with one message on all that is missing or ambiguous, and the settings that mend it.
    pub fn find_parts(&self, mut parts: Parts) -> Result<Parts> {
        let mut problems = Problems::new();
        let hand = self.find_hand(&mut parts, &mut problems);
        let others =
            (1..self.model.nbody() as usize).filter(|&body| !hand.contains(&self.root_of(body)));
        let free: Vec<usize> = others
            .clone()
            .filter(|&body| self.free_joint(body).is_some())
            .collect();
        if parts.object.is_empty() && free.is_empty() {
            problems.push(NO_OBJECT.into());
        }
        self.name_only(
            &free,
            &mut parts.object,
            ("bodies with a free joint", "hand.object"),
            &mut problems,
        );
        let held: BTreeSet<usize> = self
            .held()
            .flatten()
            .map(|body| self.root_of(body))
            .collect();
        let goals: Vec<usize> = others
            .filter(|body| self.model.body_mocapid()[*body] >= 0 && !held.contains(body))
            .collect();
        self.name_only(
            &goals,
            &mut parts.goal,
            ("mocap bodies", "hand.goal"),
            &mut problems,
        );
        ensure!(problems.is_empty(), problems.join("; "));
        Ok(parts)
    }

    /// Names the parts of the hand that are not named. The result is the first bodies of the trees that its actuators move.
    fn find_hand(&self, parts: &mut Parts, problems: &mut Problems) -> BTreeSet<usize> {
        if parts.actuators.is_empty() {
            parts.actuators = self.names(mjOBJ_ACTUATOR, ids(self.model.nactuator()), problems);
        }
        let actuators = parts
            .actuators
            .iter()
            .filter_map(|name| self.model.name_to_id(mjOBJ_ACTUATOR, name));
        let moved = actuators
            .flat_map(|actuator| self.wraps(actuator))
            .filter_map(|(kind, id, _)| match kind {
                mjWRAP_JOINT => Some(self.model.jnt_bodyid()[id]),
                mjWRAP_SITE => Some(self.model.site_bodyid()[id]),
                _ => None,
            });
        // The world is no tree.
        let trees: BTreeSet<usize> = moved
            .map(|body| self.root_of(body as usize))
            .filter(|tree| *tree > 0)
            .collect();
        let hinges: Vec<usize> = ids(self.model.njnt())
            .filter(|&joint| {
                trees.contains(&self.root_of(self.model.jnt_bodyid()[joint] as usize))
                    && self.model.jnt_type()[joint] == mjJNT_HINGE
                    && self.model.jnt_limited()[joint]
            })
            .collect();
        if parts.joints.is_empty() {
            parts.joints = self.names(mjOBJ_JOINT, hinges.iter().copied(), problems);
        }
        if parts.joints.is_empty() || parts.actuators.is_empty() {
            let found = "position servos that move limited hinges are needed";
            problems.push(format!(
                "has no hand: {found}; hand.joints and hand.actuators name them"
            ));
        }
        if parts.fingertips.is_empty() {
            parts.fingertips = self.names(mjOBJ_BODY, self.last_bodies(&hinges), problems);
        }
        if parts.fingertips.is_empty() {
            problems.push("has no fingertips; hand.fingertips names them".into());
        }
        trees
    }

    /// Names a part that is not named, if there is only one body that it can be.
    fn name_only(
        &self,
        found: &[usize],
        part: &mut String,
        (what, setting): (&str, &str),
        problems: &mut Problems,
    ) {
        if !part.is_empty() || found.is_empty() {
            return;
        }
        if let [only] = *found {
            *part = self.names(mjOBJ_BODY, [only], problems).concat();
            return;
        }
        let names: Vec<_> = self
            .names(mjOBJ_BODY, found.iter().copied(), &mut Problems::new())
            .iter()
            .map(|name| format!("`{}`", shortened(name)))
            .collect();
        problems.push(format!(
            "has several {what}, {}: name one by {setting}",
            names.join(", ")
        ));
    }

    /// The number of the first body of the tree that a body belongs to.
    pub fn root_of(&self, body: usize) -> usize {
        self.model.body_rootid()[body] as usize
    }

    /// The bodies that connect and weld constraints hold together, e.g. a mocap body that guides a hand.
    fn held(&self) -> impl Iterator<Item = [usize; 2]> {
        let model = &self.model;
        let ends = move |i: usize| {
            let ends = [model.eq_obj1id()[i], model.eq_obj2id()[i]].map(|id| id as usize);
            match model.eq_objtype()[i] {
                mjOBJ_BODY => Some(ends),
                mjOBJ_SITE => Some(ends.map(|site| model.site_bodyid()[site] as usize)),
                _ => None,
            }
        };
        ids(model.neq())
            .filter(|&i| model.eq_active0()[i])
            .filter_map(ends)
    }

    /// Whether a joint is part of a loop that such a constraint closes: it moves one end without the other.
    pub(super) fn is_in_loop(&self, joint: usize) -> bool {
        let parent = |&body: &usize| (body > 0).then(|| self.model.body_parentid()[body] as usize);
        let moved = self.model.jnt_bodyid()[joint] as usize;
        let moves = |end: usize| iter::successors(Some(end), parent).any(|body| body == moved);
        self.held().any(|[one, other]| moves(one) != moves(other))
    }

    /// The bodies that one of these hinges moves and that carry no other body.
    fn last_bodies(&self, hinges: &[usize]) -> Vec<usize> {
        let count = self.model.nbody() as usize;
        let mut moved = vec![false; count];
        let mut carries = vec![false; count];
        for &joint in hinges {
            moved[self.model.jnt_bodyid()[joint] as usize] = true;
        }
        // Every body has a higher number than its parent.
        for body in 1..count {
            let parent = self.model.body_parentid()[body] as usize;
            moved[body] |= moved[parent];
            carries[parent] = true;
        }
        (1..count)
            .filter(|&body| moved[body] && !carries[body])
            .collect()
    }

    /// The joints that an actuator drives, with the coefficients of their sum, which is its length. A tendon along a path
    /// in space drives no sum.
    pub fn driven(&self, actuator: Actuator) -> Vec<(String, f64)> {
        let mut driven = Vec::new();
        for (kind, id, coefficient) in self.wraps(actuator.id) {
            if kind == mjWRAP_JOINT {
                let name = self.model.id_to_name(mjOBJ_JOINT, id).unwrap_or_default();
                driven.push((name.to_owned(), coefficient));
            }
        }
        driven
    }

    /// What an actuator or its tendon acts on: the kind, the number, and the coefficient if it is a joint.
    fn wraps(&self, actuator: usize) -> Vec<(MjtWrap, usize, f64)> {
        let target = self.model.actuator_trnid()[actuator][0] as usize;
        let model = &self.model;
        match model.actuator_trntype()[actuator] {
            mjTRN_JOINT => vec![(mjWRAP_JOINT, target, 1.0)],
            mjTRN_TENDON => {
                let first = model.tendon_adr()[target] as usize;
                (first..first + model.tendon_num()[target] as usize)
                    .map(|at| {
                        let id = model.wrap_objid()[at] as usize;
                        (model.wrap_type()[at], id, model.wrap_prm()[at])
                    })
                    .collect()
            }
            _ => Vec::new(),
        }
    }

    /// The names of these objects. Each that has none is a problem.
    fn names(
        &self,
        kind: MjtObjBase,
        ids: impl IntoIterator<Item = usize>,
        problems: &mut Problems,
    ) -> Vec<String> {
        let what = match kind {
            mjOBJ_ACTUATOR => "actuator",
            mjOBJ_JOINT => "joint",
            _ => "body",
        };
        let mut names = Vec::new();
        for id in ids {
            match self.model.id_to_name(kind, id) {
                Some(name) if !name.is_empty() => names.push(name.to_owned()),
                _ => problems.push(format!("{what} {id} of the compiled scene needs a name")),
            }
        }
        names
    }

    /// The number of actuators, joints but free ones, and bodies without a name.
    pub fn unnamed(&self) -> usize {
        let model = &self.model;
        let joints = ids(model.njnt()).filter(|&joint| model.jnt_type()[joint] != mjJNT_FREE);
        let mut problems = Problems::new();
        self.names(mjOBJ_ACTUATOR, ids(model.nactuator()), &mut problems);
        self.names(mjOBJ_JOINT, joints, &mut problems);
        self.names(mjOBJ_BODY, ids(model.nbody()), &mut problems);
        problems.len()
    }

    /// The names of all joints that have one.
    pub fn joints(&self) -> Vec<String> {
        self.names(mjOBJ_JOINT, ids(self.model.njnt()), &mut Problems::new())
    }

    /// The joints besides these hinges and the joint of this object, by name or number.
    pub fn joints_besides(&self, hinges: &[Hinge], object: &FreeJoint) -> Vec<String> {
        let known: Vec<usize> = hinges
            .iter()
            .map(|hinge| hinge.qpos)
            .chain([object.qpos])
            .collect();
        let joints = ids(self.model.njnt())
            .filter(|&joint| !known.contains(&(self.model.jnt_qposadr()[joint] as usize)));
        let name = |joint| match self.model.id_to_name(mjOBJ_JOINT, joint) {
            Some(name) => format!("joint `{name}`"),
            None => format!("joint {joint}"),
        };
        joints.map(name).collect()
    }

    /// The names of all actuators that have one.
    pub fn actuators(&self) -> Vec<String> {
        self.names(
            mjOBJ_ACTUATOR,
            ids(self.model.nactuator()),
            &mut Problems::new(),
        )
    }
}
