//! What a policy's file says about the hand and the object that it was trained with.

use std::collections::BTreeSet;

use anyhow::{Result, anyhow, ensure};
use serde::{Deserialize, Serialize};

use super::hand::Hand;
use super::observation::Layout;
use crate::config::Symmetry;
use crate::os::shortened;
use crate::quat::CUBE_ROTATIONS;
use crate::sim::{Parts, Scene, Simulation};
use crate::spaces::Spaces;

/// The most bytes of a record that are read. The record of the Shadow Hand has three thousand.
const LONGEST: usize = 1 << 16;

/// The fractions of the ranges of joints, in turn, at which the poses of fingertips are recorded.
const POSES: [[f64; 3]; 2] = [[0.3, 0.5, 0.6], [0.7, 0.2, 0.4]];

/// A hand and an object, by what a policy depends on. Lists are in the orders of observations and actions.
#[derive(Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The names of the joints.
    pub joints: Vec<String>,
    /// The names of the actuators.
    pub actuators: Vec<String>,
    /// The control ranges of the actuators, rad, or m for tendons along a path in space.
    pub ranges: Vec<[f64; 2]>,
    /// The joints that each actuator drives, with the coefficients of their sum.
    pub driven: Vec<Vec<(String, f64)>>,
    /// The names of the fingertips.
    pub fingertips: Vec<String>,
    /// The poses of the fingertips in two poses of the hand, in the world frame: position in m, orientation w,x,y,z.
    pub tips: Vec<[f64; 7]>,
    /// The rotations of a cube, by number, that a policy treats as the same.
    pub symmetry: Vec<usize>,
    /// Whether the policy is told how the hand and its object differ from the scene.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub told: bool,
}

impl Record {
    /// The record of a hand in its scene, and of an object with these rotations.
    pub(super) fn of(hand: &Hand, scene: &Scene, symmetry: Vec<usize>) -> Self {
        let Parts {
            joints,
            actuators,
            fingertips,
            ..
        } = hand.parts.clone();
        let ranges = hand.actuators.iter().map(|actuator| actuator.range);
        let tips = POSES
            .iter()
            .flat_map(|fractions| tips_at(hand, scene, fractions));
        Self {
            joints,
            actuators,
            ranges: ranges.collect(),
            driven: hand.driven.clone(),
            fingertips,
            tips: tips.collect(),
            symmetry,
            told: hand.layout.told,
        }
    }

    /// Reads the record in a file.
    ///
    /// # Errors
    /// Fails if it is too long or damaged.
    pub fn parse(text: &str) -> Result<Self> {
        ensure!(
            text.len() <= LONGEST,
            "its metadata `hand` has {} bytes; at most {LONGEST} are read",
            text.len()
        );
        let record: Self = serde_json::from_str(text)
            .map_err(|error| anyhow!("its metadata `hand`: {}", shortened(&error.to_string())))?;
        let actuators = record.actuators.len();
        let tips = POSES.len() * record.fingertips.len();
        let sizes = [record.ranges.len(), record.driven.len(), record.tips.len()];
        ensure!(
            sizes == [actuators, actuators, tips]
                && !record.joints.is_empty()
                && actuators > 0
                && record.symmetry.first() == Some(&0)
                && record.symmetry.iter().all(|&rotation| rotation < 24),
            "its metadata `hand` has lists of other lengths than its hand needs"
        );
        Ok(record)
    }

    /// The record of a policy with this setting: by default it treats as the same all rotations that map the object
    /// onto itself.
    pub fn with(mut self, symmetry: Symmetry) -> Self {
        match symmetry {
            Symmetry::None => self.symmetry = vec![0],
            Symmetry::Cube => self.symmetry = (0..CUBE_ROTATIONS.len()).collect(),
            Symmetry::Object => {}
        }
        self
    }

    /// The text for a file.
    ///
    /// # Panics
    /// Never panics: all of it can be written as JSON.
    pub fn to_text(&self) -> String {
        serde_json::to_string(self).expect("names and numbers")
    }

    /// The observations and actions of a policy for it.
    pub fn spaces(&self) -> Spaces {
        self.layout().spaces(&self.symmetry)
    }

    /// The layout of the observations of a policy for it.
    pub(super) fn layout(&self) -> Layout {
        Layout::new(
            self.joints.len(),
            self.fingertips.len(),
            self.actuators.len(),
            self.told,
        )
    }

    /// Checks by the names that a policy for this hand can act with the hand `there` of a scene, and says whether they tell that it is the
    /// hand on the other side.
    ///
    /// # Errors
    /// Fails with the names that differ.
    pub(super) fn expect_fits(&self, there: &Self, scene: &str) -> Result<bool> {
        let mut differ = Vec::new();
        let mut is_other_hand = false;
        for (what, own, found) in [
            ("joint", &self.joints, &there.joints),
            ("actuator", &self.actuators, &there.actuators),
            ("fingertip", &self.fingertips, &there.fingertips),
        ] {
            if own.len() != found.len() {
                differ.push(format!("{} {what}s, not {}", found.len(), own.len()));
                continue;
            }
            for (own, found) in own.iter().zip(found) {
                if is_named(found, own) {
                    continue;
                }
                if is_other_side(found, own) {
                    is_other_hand = true;
                } else {
                    differ.push(format!("the {what} `{found}` for `{own}`"));
                }
            }
        }
        let names = shortened(&differ.join(", "));
        ensure!(
            differ.is_empty(),
            "the policy is for another hand: {scene} has {names}"
        );
        Ok(is_other_hand)
    }

    /// A warning if an action means another angle with the hand `there`.
    pub(super) fn warning(&self, there: &Self) -> Option<String> {
        // In whatever order a tendon has its joints.
        let sum = |of: &Self, i: usize| -> BTreeSet<_> {
            let driven = of.driven[i].iter();
            driven
                .map(|(name, coefficient)| {
                    let place = of.joints.iter().position(|joint| joint == name);
                    (place, coefficient.to_bits())
                })
                .collect()
        };
        let mut others = Vec::new();
        for (i, name) in there.actuators.iter().enumerate() {
            let mut ends = self.ranges[i].iter().zip(there.ranges[i]);
            if ends.any(|(own, found)| (own - found).abs() > 1e-4) || sum(self, i) != sum(there, i)
            {
                others.push(name.as_str());
            }
        }
        (!others.is_empty()).then(|| {
            let names = shortened(&others.join(" "));
            format!("an action means another angle than in training: the ranges or the tendons of {names} differ")
        })
    }
}

/// Whether a name in a scene is the name in a policy, perhaps with an additional prefix.
fn is_named(found: &str, own: &str) -> bool {
    found
        .strip_suffix(own)
        .is_some_and(|prefix| prefix.is_empty() || prefix.ends_with(['/', '_', '-', '.', ':']))
}

/// Whether a name differs only in the letter of the side: `lh_` and `rh_`, `left` and `right`.
fn is_other_side(found: &str, own: &str) -> bool {
    [
        ("lh_", "rh_"),
        ("rh_", "lh_"),
        ("left", "right"),
        ("right", "left"),
    ]
    .iter()
    .any(|(here, there)| found.contains(here) && is_named(&found.replace(here, there), own))
}

/// The poses of the fingertips in a pose of the hand.
fn tips_at(hand: &Hand, scene: &Scene, fractions: &[f64]) -> Vec<[f64; 7]> {
    let mut sim = Simulation::new(scene);
    for (joint, fraction) in hand.joints.iter().zip(fractions.iter().cycle()) {
        sim.qpos_mut()[joint.qpos] = joint.range[0] + fraction * (joint.range[1] - joint.range[0]);
    }
    sim.refresh();
    let poses = hand.fingertips.iter().map(|&tip| sim.pose(tip));
    poses
        .map(|pose| {
            let [x, y, z] = pose.position;
            let [qw, qx, qy, qz] = pose.orientation;
            [x, y, z, qw, qx, qy, qz]
        })
        .collect()
}
