//! What a policy makes of an observation before its nets see it.
//!
//! The cube looks different on each side, but to the hand it is the same from all: turned about itself by one of the 24
//! rotations that take a cube onto itself, and the goal with it, it moves the same way under the same actions, and the rotation
//! that is left to the goal stays the same. So a policy need only learn one of 24 ways that a cube can lie, if each
//! observation is first turned into that one.

use std::f32::consts::FRAC_1_SQRT_2;

use crate::config::Symmetry;
use crate::env::{CUBE_ORIENTATION, GOAL_ORIENTATION, OBSERVATION_SIZE};

/// The rotations of a cube onto itself, w,x,y,z, one of each pair q and -q.
const ROTATIONS: [[f32; 4]; 24] = {
    const H: f32 = 0.5;
    const R: f32 = FRAC_1_SQRT_2;
    [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        // About an axis through the middles of two faces.
        [R, R, 0.0, 0.0],
        [R, -R, 0.0, 0.0],
        [R, 0.0, R, 0.0],
        [R, 0.0, -R, 0.0],
        [R, 0.0, 0.0, R],
        [R, 0.0, 0.0, -R],
        // Through the middles of two edges.
        [0.0, R, R, 0.0],
        [0.0, R, -R, 0.0],
        [0.0, R, 0.0, R],
        [0.0, R, 0.0, -R],
        [0.0, 0.0, R, R],
        [0.0, 0.0, R, -R],
        // Through two corners.
        [H, H, H, H],
        [H, -H, H, H],
        [H, H, -H, H],
        [H, H, H, -H],
        [H, H, -H, -H],
        [H, -H, H, -H],
        [H, -H, -H, H],
        [H, -H, -H, -H],
    ]
};

/// What turns observations `[B, 157]` into those that a policy with this setting looks at, in place.
pub fn perception(symmetry: Symmetry) -> fn(&mut [f32]) {
    match symmetry {
        Symmetry::None => |_| {},
        Symmetry::Cube => |observations| observations.chunks_exact_mut(OBSERVATION_SIZE).for_each(turn_cube),
    }
}

/// Turns cube and goal about the cube's own axes so that the cube is as near as can be to where it is not turned at all.
fn turn_cube(observation: &mut [f32]) {
    let cube = quaternion(observation, CUBE_ORIENTATION);
    // The cosine of half the angle that is left of `cube` after it.
    let closeness = |s: &[f32; 4]| (cube[0] * s[0] - cube[1] * s[1] - cube[2] * s[2] - cube[3] * s[3]).abs();
    let mut best = (closeness(&ROTATIONS[0]), ROTATIONS[0]);
    for rotation in &ROTATIONS[1..] {
        let close = closeness(rotation);
        if close > best.0 {
            best = (close, *rotation);
        }
    }
    for place in [CUBE_ORIENTATION, GOAL_ORIENTATION] {
        let turned = mul(quaternion(observation, place), best.1);
        let turned = if turned[0] < 0.0 { turned.map(|x| -x) } else { turned };
        observation[place..place + 4].copy_from_slice(&turned);
    }
}

fn quaternion(observation: &[f32], place: usize) -> [f32; 4] {
    *observation[place..].first_chunk().expect("a place within the observation")
}

fn mul([aw, ax, ay, az]: [f32; 4], [bw, bx, by, bz]: [f32; 4]) -> [f32; 4] {
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quat::{self, Quat};
    use crate::rng;

    fn observation(cube: Quat, goal: Quat) -> Vec<f32> {
        let mut row: Vec<f32> = (0..OBSERVATION_SIZE).map(|i| i as f32).collect();
        for (place, q) in [(CUBE_ORIENTATION, cube), (GOAL_ORIENTATION, goal)] {
            row[place..place + 4].copy_from_slice(&quat::canonical(q).map(|x| x as f32));
        }
        row
    }

    fn random(purpose: u64) -> Quat {
        let mut rng = rng::stream(3, "test", purpose);
        let mut draw = || rng::uniform(&mut rng, 0.0, 1.0);
        quat::uniform([draw(), draw(), draw()])
    }

    #[test]
    fn the_rotations_are_the_24_that_take_a_cube_onto_itself() {
        for (i, &rotation) in ROTATIONS.iter().enumerate() {
            let q = rotation.map(f64::from);
            for axis in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
                let turned = quat::rotate(q, axis);
                let largest = turned.iter().fold(0.0f64, |most, x| most.max(x.abs()));
                assert!((largest - 1.0).abs() < 1e-6, "{rotation:?} takes {axis:?} to {turned:?}");
            }
            for other in &ROTATIONS[..i] {
                let cosine: f32 = rotation.iter().zip(other).map(|(a, b)| a * b).sum();
                assert!(cosine.abs() < 0.99, "{rotation:?} is {other:?}");
            }
        }
    }

    #[test]
    fn a_cube_and_the_same_cube_turned_onto_itself_look_the_same_to_a_policy() {
        for case in 0..200 {
            let (cube, goal) = (random(2 * case), random(2 * case + 1));
            let mut seen = observation(cube, goal);
            perception(Symmetry::Cube)(&mut seen);
            for rotation in ROTATIONS {
                let turn = |q| quat::mul(q, rotation.map(f64::from));
                let mut other = observation(turn(cube), turn(goal));
                perception(Symmetry::Cube)(&mut other);
                let close = seen.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-5);
                assert!(close, "{rotation:?}: {:?} and {:?}", &seen[51..55], &other[51..55]);
            }
        }
    }

    #[test]
    fn what_is_left_to_the_goal_stays_and_nothing_but_two_orientations_changes() {
        for case in 0..200 {
            let (cube, goal) = (random(2 * case), random(2 * case + 1));
            let raw = observation(cube, goal);
            let mut seen = raw.clone();
            perception(Symmetry::Cube)(&mut seen);
            let [new_cube, new_goal] = [CUBE_ORIENTATION, GOAL_ORIENTATION].map(|at| quaternion(&seen, at));
            let between = |a: [f32; 4], b: [f32; 4]| quat::mul(a.map(f64::from), quat::conj(b.map(f64::from)));
            let left = quat::mul(cube, quat::conj(goal));
            assert!(quat::angle_between(between(new_cube, new_goal), left) < 1e-3);
            // The rotation that takes a cube farthest from all 24 ways of lying is one of 62.8°, about a direction in which
            // two of the axes and the diagonal are as near.
            assert!(new_cube[0] > (62.9f32.to_radians() / 2.0).cos() && new_goal[0] >= 0.0, "{new_cube:?}");
            let others = (0..OBSERVATION_SIZE).filter(|i| !(51..55).contains(i) && !(64..68).contains(i));
            assert!(others.into_iter().all(|i| seen[i] == raw[i]));
            perception(Symmetry::None)(&mut seen);
            assert_eq!(quaternion(&seen, 51), new_cube);
        }
    }
}
