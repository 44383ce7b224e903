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

/// All parts in order. Positions and velocities are the world's; quaternions are w,x,y,z, and all but the fingertips' have w ≥ 0.
/// Of each fingertip: position, quaternion, linear and angular velocity.
pub const OBSERVATION: [Part; 11] = {
    let mut parts = [
        part("joint_pos", JOINTS.len(), "rad"),
        part("joint_vel", JOINTS.len(), "rad/s * env.vel_obs_scale"),
        part("cube_pos", 3, "m"),
        part("cube_quat", 4, "1"),
        part("cube_linvel", 3, "m/s"),
        part("cube_angvel", 3, "rad/s * env.vel_obs_scale"),
        part("goal_pos", 3, "m"),
        part("goal_quat", 4, "1"),
        part("relative_quat", 4, "1"),
        part("fingertips", 13 * FINGERTIPS.len(), "m, 1, m/s, rad/s"),
        part("previous_action", ACTION_SIZE, "1"),
    ];
    let mut i = 1;
    while i < parts.len() {
        parts[i].start = parts[i - 1].start + parts[i - 1].length;
        i += 1;
    }
    parts
};

const CUBE_QUAT: Part = OBSERVATION[3];
const GOAL_QUAT: Part = OBSERVATION[7];
const RELATIVE_QUAT: Part = OBSERVATION[8];
const LAST: Part = OBSERVATION[OBSERVATION.len() - 1];

/// Numbers in an observation.
pub const OBSERVATION_SIZE: usize = LAST.start + LAST.length;

/// What a learner of this task must know.
pub const SPACES: Spaces = Spaces {
    observation_size: OBSERVATION_SIZE,
    action_size: ACTION_SIZE,
    cube_and_goal: Some([CUBE_QUAT.start, GOAL_QUAT.start]),
    distance: rotation_error,
};

const fn part(name: &'static str, length: usize, unit: &'static str) -> Part {
    Part { name, start: 0, length, unit }
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
    }
}
