//! The layout of an observation: one table from which sizes, offsets and the descriptions for other modules follow.

use super::hand::{ACTION_SIZE, FINGERTIPS, JOINTS};
use crate::spaces::{CubeAndGoal, Spaces};

/// A group of consecutive values in an observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Group {
    /// The name of the group.
    pub name: &'static str,
    /// The index of its first value.
    pub start: usize,
    /// The number of values.
    pub length: usize,
    /// The unit; 1 for dimensionless values.
    pub unit: &'static str,
}

// Each group begins where the previous one ends.
const JOINT_POS: Group = Group { name: "joint_pos", start: 0, length: JOINTS.len(), unit: "rad" };
const JOINT_VEL: Group = JOINT_POS.then("joint_vel", JOINTS.len(), "rad/s * vel_obs_scale");
const CUBE_POS: Group = JOINT_VEL.then("cube_pos", 3, "m");
pub(super) const CUBE_QUAT: Group = CUBE_POS.then("cube_quat", 4, "1");
const CUBE_LINVEL: Group = CUBE_QUAT.then("cube_linvel", 3, "m/s");
const CUBE_ANGVEL: Group = CUBE_LINVEL.then("cube_angvel", 3, "rad/s * vel_obs_scale");
const GOAL_POS: Group = CUBE_ANGVEL.then("goal_pos", 3, "m");
pub(super) const GOAL_QUAT: Group = GOAL_POS.then("goal_quat", 4, "1");
pub(super) const RELATIVE_QUAT: Group = GOAL_QUAT.then("relative_quat", 4, "1");
/// The number of values of a fingertip.
pub(super) const TIP_SIZE: usize = 13;
/// The index of its quaternion among them.
pub(super) const TIP_QUAT: usize = 3;
const OF_FINGERTIPS: &str = "each: position 3 m, quaternion 4, linear 3 m/s, angular velocity 3 rad/s";
pub(super) const TIPS: Group = RELATIVE_QUAT.then("fingertips", TIP_SIZE * FINGERTIPS.len(), OF_FINGERTIPS);
const PREVIOUS_ACTION: Group = TIPS.then("previous_action", ACTION_SIZE, "1");

/// All groups in order. Positions and velocities are in the world frame. Quaternions are w,x,y,z; all but those of the
/// fingertips have w ≥ 0.
#[rustfmt::skip]
pub const OBSERVATION: [Group; 11] = [
    JOINT_POS, JOINT_VEL, CUBE_POS, CUBE_QUAT, CUBE_LINVEL, CUBE_ANGVEL,
    GOAL_POS, GOAL_QUAT, RELATIVE_QUAT, TIPS, PREVIOUS_ACTION,
];

/// The number of values in an observation.
pub const OBSERVATION_SIZE: usize = PREVIOUS_ACTION.start + PREVIOUS_ACTION.length;

/// The description of this task's observations and actions for a learner.
pub const SPACES: Spaces = Spaces {
    observation_size: OBSERVATION_SIZE,
    action_size: ACTION_SIZE,
    cube_and_goal: Some(CubeAndGoal { cube: CUBE_QUAT.start, goal: GOAL_QUAT.start }),
    distance: rotation_error,
};

impl Group {
    /// Returns the group that follows this one.
    const fn then(self, name: &'static str, length: usize, unit: &'static str) -> Self {
        Self { name, start: self.start + self.length, length, unit }
    }
}

/// Returns the rotation error that an observation shows, rad.
fn rotation_error(observation: &[f32]) -> f32 {
    2.0 * observation[RELATIVE_QUAT.start].clamp(0.0, 1.0).acos()
}

/// An observation that is being written, group by group.
pub(super) struct Cells<'a> {
    cells: &'a mut [f32],
    written: usize,
    part: usize,
}

impl<'a> Cells<'a> {
    pub(super) fn new(observation: &'a mut [f32]) -> Self {
        assert_eq!(observation.len(), OBSERVATION_SIZE, "observation length");
        Self { cells: observation, written: 0, part: 0 }
    }

    /// Writes the next values, which must belong to the group `name`. This is the only place where the doubles of the physics
    /// become the floats of the learner.
    pub(super) fn put<const N: usize>(&mut self, name: &str, values: [f64; N]) {
        let Group { name: expected, start, length, .. } = OBSERVATION[self.part];
        assert!(name == expected && self.written + N <= start + length, "{name}: {N} values do not fit {expected}");
        self.cells[self.written..self.written + N]
            .iter_mut()
            .zip(values)
            .for_each(|(cell, value)| *cell = value as f32);
        self.written += N;
        self.part += usize::from(self.written == start + length);
    }

    /// Checks that every value has been overwritten.
    pub(super) fn finish(self) {
        assert_eq!(self.written, OBSERVATION_SIZE, "values written to an observation");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_observation_is_laid_out_as_the_task_says() {
        let found = OBSERVATION.map(|part| (part.name, part.start, part.length));
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
        assert_eq!(OBSERVATION_SIZE, 157);
    }

    #[test]
    fn numbers_that_do_not_fit_into_their_part_are_refused() {
        let refused = |write: fn(&mut Cells)| {
            let mut observation = [0.0; OBSERVATION_SIZE];
            let mut cells = Cells::new(&mut observation);
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| write(&mut cells))).is_err()
        };
        assert!(!refused(|cells| cells.put("joint_pos", [0.0; 24])));
        assert!(refused(|cells| cells.put("joint_pos", [0.0; 25])), "too many");
        assert!(refused(|cells| cells.put("joint_vel", [0.0; 24])), "out of order");
        let all = |cells: &mut Cells| {
            for part in OBSERVATION {
                (0..part.length).for_each(|_| cells.put(part.name, [0.0]));
            }
        };
        let mut observation = [0.0; OBSERVATION_SIZE];
        let mut cells = Cells::new(&mut observation);
        all(&mut cells);
        cells.finish();
        assert!(refused(|cells| std::mem::replace(cells, Cells { cells: &mut [], written: 0, part: 0 }).finish()));
    }
}
