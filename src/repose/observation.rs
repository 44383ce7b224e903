//! The layout of an observation: one table from which sizes, offsets and the descriptions for other modules follow.

use std::ops::Range;

use crate::spaces::{ObjectAndGoal, Spaces};
use Sensing::{Known, Measured};

/// A group of consecutive values in an observation.
#[derive(Clone, Copy)]
pub struct Group {
    /// The name of the group.
    pub name: &'static str,
    /// The index of its first value.
    pub start: usize,
    /// The number of values.
    pub length: usize,
    /// The unit, or 1 for dimensionless values.
    pub unit: &'static str,
    /// The values that change their sign in the mirror, by index. For fingertips, the indices apply to each one.
    mirrored: &'static [usize],
    sensing: Sensing,
}

/// Where the values of a group come from.
#[derive(Clone, Copy, PartialEq)]
pub enum Sensing {
    /// Sensors, which may have noise and offsets.
    Measured,
    /// They are known exactly, or follow from measured groups.
    Known,
}

/// The quantities whose factors a policy can be told, in the order of the group `known`.
pub const KNOWN: [&str; 4] = ["cube_mass", "cube_size", "damping", "friction"];

/// The number of values of a fingertip.
pub const TIP_SIZE: usize = 13;
/// The index of its quaternion among them.
pub const TIP_QUAT: usize = 3;
const OF_FINGERTIPS: &str =
    "each: position 3 m, quaternion 4, linear 3 m/s, angular velocity 3 rad/s";

// The places of groups in the table.
pub const OBJECT_QUAT: usize = 3;
pub const GOAL_QUAT: usize = 7;
pub const RELATIVE_QUAT: usize = 8;
pub const TIPS: usize = 9;

/// The layout of the observations of a hand.
#[derive(Clone, Copy)]
pub struct Layout {
    groups: [Group; 12],
    /// Whether the policy is told how the hand and its object differ from the scene.
    pub told: bool,
    /// The number of values in an observation.
    pub size: usize,
    /// The number of values in an action.
    pub actions: usize,
}

impl Group {
    /// The places of its values in an observation.
    pub(super) fn cells(&self) -> Range<usize> {
        self.start..self.start + self.length
    }
}

impl Layout {
    /// The layout for a hand with this many joints, fingertips and actuators, and for a policy that is `told` what is known.
    pub fn new(joints: usize, fingertips: usize, actuators: usize, told: bool) -> Self {
        const NOTHING: &[usize] = &[];
        // Points and velocities change their y, axes their x and z, and so do quaternions.
        const POINT: &[usize] = &[1];
        const AXIS: &[usize] = &[0, 2];
        const QUATERNION: &[usize] = &[1, 3];
        const TIP: &[usize] = &[1, 4, 6, 8, 10, 12];
        let table = [
            ("joint_pos", Measured, joints, "rad", NOTHING),
            (
                "joint_vel",
                Measured,
                joints,
                "rad/s * vel_obs_scale",
                NOTHING,
            ),
            ("cube_pos", Measured, 3, "m", POINT),
            ("cube_quat", Measured, 4, "1", QUATERNION),
            ("cube_linvel", Measured, 3, "m/s", POINT),
            ("cube_angvel", Measured, 3, "rad/s * vel_obs_scale", AXIS),
            ("goal_pos", Known, 3, "m", POINT),
            ("goal_quat", Known, 4, "1", QUATERNION),
            ("relative_quat", Known, 4, "1", QUATERNION),
            (
                "fingertips",
                Measured,
                TIP_SIZE * fingertips,
                OF_FINGERTIPS,
                TIP,
            ),
            ("previous_action", Known, actuators, "1", NOTHING),
            (
                "known",
                Known,
                if told { KNOWN.len() } else { 0 },
                "ln of a factor",
                NOTHING,
            ),
        ];
        let mut size = 0;
        let groups = table.map(|(name, sensing, length, unit, mirrored)| {
            size += length;
            Group {
                name,
                start: size - length,
                length,
                unit,
                mirrored,
                sensing,
            }
        });
        Self {
            groups,
            told,
            size,
            actions: actuators,
        }
    }

    /// All groups in order. Positions and velocities are in the world frame. Quaternions are w,x,y,z. Except for the
    /// fingertips, they have w ≥ 0. The group `known` is left out if the policy is not told what is known.
    pub fn groups(&self) -> impl Iterator<Item = &Group> {
        self.groups.iter().filter(|group| group.length > 0)
    }

    /// The groups that sensors measure.
    pub(super) fn measured(&self) -> impl Iterator<Item = &Group> {
        self.groups.iter().filter(|group| group.sensing == Measured)
    }

    /// The index of the first value of a group, by the group's place in the table.
    pub(super) fn start(&self, group: usize) -> usize {
        self.groups[group].start
    }

    /// The indices of the first values of the fingertips.
    pub(super) fn tips(&self) -> impl Iterator<Item = usize> {
        self.groups[TIPS].cells().step_by(TIP_SIZE)
    }

    /// The indices of the values that change their sign in the mirror, the plane y = 0 of the world.
    pub(super) fn mirrored(&self) -> Vec<usize> {
        // No other group in which something changes is longer than one fingertip.
        let mut all = Vec::new();
        for group in self.groups {
            for part in group.cells().step_by(TIP_SIZE) {
                all.extend(group.mirrored.iter().map(|i| part + i));
            }
        }
        all
    }

    /// The description of observations and actions for a learner, for an object with these rotations.
    pub fn spaces(&self, rotations: &[usize]) -> Spaces {
        let [object, goal, relative] =
            [OBJECT_QUAT, GOAL_QUAT, RELATIVE_QUAT].map(|group| self.start(group));
        Spaces {
            observation_size: self.size,
            action_size: self.actions,
            object_and_goal: Some(ObjectAndGoal {
                object,
                goal,
                relative,
                rotations: rotations.iter().fold(0, |mask, i| mask | 1 << i),
            }),
            distance: rotation_error,
        }
    }
}

/// The rotation error that an observation shows, rad.
fn rotation_error(spaces: &Spaces, observation: &[f32]) -> f32 {
    let places = spaces.object_and_goal.expect("an object and its goal");
    2.0 * observation[places.relative].clamp(0.0, 1.0).acos()
}

/// An observation that is being written, group by group.
pub struct Writer<'a> {
    layout: &'a Layout,
    cells: &'a mut [f32],
    written: usize,
    part: usize,
}

impl<'a> Writer<'a> {
    pub fn new(layout: &'a Layout, observation: &'a mut [f32]) -> Self {
        assert_eq!(observation.len(), layout.size, "observation length");
        Self {
            layout,
            cells: observation,
            written: 0,
            part: 0,
        }
    }

    /// Writes the next values, which must belong to the group `name`. This is the only place where the doubles of the physics
    /// become the floats of the learner.
    pub fn put(&mut self, name: &str, values: impl IntoIterator<Item = f64>) {
        let group = &self.layout.groups[self.part];
        let Range { end, .. } = group.cells();
        assert!(name == group.name, "{name}: {} comes first", group.name);
        for value in values {
            assert!(
                self.written < end,
                "{name}: more than {} values",
                group.length
            );
            self.cells[self.written] = value as f32;
            self.written += 1;
        }
        self.part += usize::from(self.written == end);
    }

    /// Checks that every value has been overwritten.
    pub fn finish(self) {
        assert_eq!(
            self.written, self.layout.size,
            "values written to an observation"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_observation_is_laid_out_as_the_task_says() {
        let layout = Layout::new(24, 5, 20, false);
        let found: Vec<_> = layout
            .groups()
            .map(|part| (part.name, part.start, part.length))
            .collect();
        let expected = [
            ("joint_pos", 0, 24),
            ("joint_vel", 24, 24),
            ("cube_pos", 48, 3),
            ("cube_quat", 51, 4),
            ("cube_linvel", 55, 3),
            ("cube_angvel", 58, 3),
            ("goal_pos", 61, 3),
            ("goal_quat", 64, 4),
            ("relative_quat", 68, 4),
            ("fingertips", 72, 65),
            ("previous_action", 137, 20),
        ];
        assert_eq!(found, expected);
        assert_eq!((layout.size, layout.actions), (157, 20));
        let told = Layout::new(24, 5, 20, true);
        let last = told.groups().last().unwrap();
        assert_eq!((last.name, last.start, told.size), ("known", 157, 161));
    }

    #[test]
    fn numbers_that_do_not_fit_into_their_part_are_refused() {
        let layout = Layout::new(24, 5, 20, false);
        let refused = |write: fn(&mut Writer)| {
            let mut observation = [0.0; 157];
            let mut cells = Writer::new(&layout, &mut observation);
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| write(&mut cells))).is_err()
        };
        assert!(!refused(|cells| cells.put("joint_pos", [0.0; 24])));
        assert!(
            refused(|cells| cells.put("joint_pos", [0.0; 25])),
            "too many"
        );
        assert!(
            refused(|cells| cells.put("joint_vel", [0.0; 24])),
            "out of order"
        );
        let all = |cells: &mut Writer| {
            for part in Layout::new(24, 5, 20, false).groups {
                (0..part.length).for_each(|_| cells.put(part.name, [0.0]));
            }
        };
        let mut observation = [0.0; 157];
        let mut cells = Writer::new(&layout, &mut observation);
        all(&mut cells);
        cells.finish();
        assert!(
            refused(|cells| Writer::new(cells.layout, &mut [0.0; 157]).finish()),
            "nothing was written"
        );
    }
}
