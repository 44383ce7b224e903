//! What stands where in an observation: one table, from which sizes, places, and what others are told of it follow.

use super::hand::{ACTION_SIZE, FINGERTIPS, JOINTS};
use crate::spaces::Spaces;

/// Some numbers of an observation that belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// What they are.
    pub name: &'static str,
    /// The place of the first of them.
    pub start: usize,
    /// How many.
    pub length: usize,
    /// In which unit; 1 where they have none.
    pub unit: &'static str,
}

// Each begins where the one before it ends.
const JOINT_POS: Part = Part { name: "joint_pos", start: 0, length: JOINTS.len(), unit: "rad" };
const JOINT_VEL: Part = JOINT_POS.then("joint_vel", JOINTS.len(), "rad/s * vel_obs_scale");
const CUBE_POS: Part = JOINT_VEL.then("cube_pos", 3, "m");
const CUBE_QUAT: Part = CUBE_POS.then("cube_quat", 4, "1");
const CUBE_LINVEL: Part = CUBE_QUAT.then("cube_linvel", 3, "m/s");
const CUBE_ANGVEL: Part = CUBE_LINVEL.then("cube_angvel", 3, "rad/s * vel_obs_scale");
const GOAL_POS: Part = CUBE_ANGVEL.then("goal_pos", 3, "m");
const GOAL_QUAT: Part = GOAL_POS.then("goal_quat", 4, "1");
const RELATIVE_QUAT: Part = GOAL_QUAT.then("relative_quat", 4, "1");
const OF_FINGERTIPS: &str = "each: position 3 m, quaternion 4, linear 3 m/s, angular velocity 3 rad/s";
const TIPS: Part = RELATIVE_QUAT.then("fingertips", 13 * FINGERTIPS.len(), OF_FINGERTIPS);
const PREVIOUS_ACTION: Part = TIPS.then("previous_action", ACTION_SIZE, "1");

/// All parts in order. Positions and velocities are the world's; quaternions are w,x,y,z, and all but the fingertips' have w ≥ 0.
#[rustfmt::skip]
pub const OBSERVATION: [Part; 11] = [
    JOINT_POS, JOINT_VEL, CUBE_POS, CUBE_QUAT, CUBE_LINVEL, CUBE_ANGVEL,
    GOAL_POS, GOAL_QUAT, RELATIVE_QUAT, TIPS, PREVIOUS_ACTION,
];

/// Numbers in an observation.
pub const OBSERVATION_SIZE: usize = PREVIOUS_ACTION.start + PREVIOUS_ACTION.length;

/// What a learner of this task must know.
pub const SPACES: Spaces = Spaces {
    observation_size: OBSERVATION_SIZE,
    action_size: ACTION_SIZE,
    cube_and_goal: Some([CUBE_QUAT.start, GOAL_QUAT.start]),
    distance: rotation_error,
};

impl Part {
    /// The part that follows.
    const fn then(self, name: &'static str, length: usize, unit: &'static str) -> Self {
        Self { name, start: self.start + self.length, length, unit }
    }
}

/// The rotation error that an observation shows, rad.
fn rotation_error(observation: &[f32]) -> f32 {
    2.0 * observation[RELATIVE_QUAT.start].clamp(0.0, 1.0).acos()
}

/// An observation that is being written, part by part.
pub(super) struct Cells<'a> {
    cells: &'a mut [f32],
    written: usize,
    part: usize,
}

impl<'a> Cells<'a> {
    pub(super) fn new(observation: &'a mut [f32]) -> Self {
        assert_eq!(observation.len(), OBSERVATION_SIZE, "length of an observation");
        Self { cells: observation, written: 0, part: 0 }
    }

    /// Writes the next numbers, which are of the part of this name: the one place where the doubles of the physics become the
    /// floats of the learner.
    pub(super) fn put<const N: usize>(&mut self, name: &str, values: [f64; N]) {
        let Part { name: expected, start, length, .. } = OBSERVATION[self.part];
        assert!(name == expected && self.written + N <= start + length, "{name}: {N} numbers where {expected} is");
        self.cells[self.written..self.written + N]
            .iter_mut()
            .zip(values)
            .for_each(|(cell, value)| *cell = value as f32);
        self.written += N;
        self.part += usize::from(self.written == start + length);
    }

    /// Makes sure that nothing is left of what was there before.
    pub(super) fn finish(self) {
        assert_eq!(self.written, OBSERVATION_SIZE, "numbers of an observation");
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
