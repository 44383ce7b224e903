//! What a policy makes of an observation before its nets see it.
//!
//! The cube looks different on each side, but to the hand it is the same from all: turned about itself by one of the 24
//! rotations that take a cube onto itself, and the goal with it, it moves the same way under the same actions, and the rotation
//! that is left to the goal stays the same. So a policy need only learn one of 24 ways that a cube can lie, if each
//! observation is first turned into that one.

use std::f32::consts::FRAC_1_SQRT_2;

use anyhow::{Context, Result};
use pulp::Arch;

use super::normalizer::Scaling;
use crate::config::Symmetry;
use crate::quat;
use crate::spaces::Spaces;

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

/// What a policy takes to be the same in a raw observation.
#[derive(Clone, Copy, Debug)]
pub struct Perception {
    /// Where the orientations of cube and goal begin, if they are turned.
    cube_and_goal: Option<[usize; 2]>,
}

impl Perception {
    /// Of a policy with this setting, on observations that `spaces` describes.
    ///
    /// # Errors
    /// The symmetry of a cube where there is none.
    pub fn new(symmetry: Symmetry, spaces: &Spaces) -> Result<Self> {
        let cube_and_goal = match symmetry {
            Symmetry::None => None,
            Symmetry::Cube => Some(spaces.cube_and_goal.context("ppo.symmetry = \"cube\": there is no cube here")?),
        };
        Ok(Self { cube_and_goal })
    }

    /// Turns one raw observation `[O]` into the one that all observations of the same share, in place.
    #[inline(always)]
    pub fn turn(self, observation: &mut [f32]) {
        let Some(places) = self.cube_and_goal else { return };
        let best = nearest(quaternion(observation, places[0]));
        for place in places {
            let turned = quat::mul(quaternion(observation, place), best);
            let turned = if turned[0] < 0.0 { turned.map(|x| -x) } else { turned };
            observation[place..place + 4].copy_from_slice(&turned);
        }
    }
}

/// The rotation about the cube's own axes after which it is as near as can be to where it is not turned at all.
#[inline(always)]
fn nearest(cube: [f32; 4]) -> [f32; 4] {
    // The cosine of half the angle that is left after each; all of them first, which goes in vectors.
    let close = ROTATIONS.map(|s| (cube[0] * s[0] - cube[1] * s[1] - cube[2] * s[2] - cube[3] * s[3]).abs());
    ROTATIONS[(1..close.len()).fold(0, |best, i| if close[i] > close[best] { i } else { best })]
}

/// How a policy reads raw observations: perceived, then normalised.
#[derive(Clone, Debug)]
pub struct Reader {
    /// What it takes to be the same.
    pub perception: Perception,
    /// What its normaliser does.
    pub scaling: Scaling,
}

impl Reader {
    /// Numbers in an observation.
    pub fn size(&self) -> usize {
        self.scaling.size()
    }

    /// Writes what the nets see of the `raw` observations `[B, O]` into `out` `[B, O]`.
    pub fn read(&self, raw: &[f32], out: &mut [f32]) {
        out.copy_from_slice(raw);
        Arch::new().dispatch(
            #[inline(always)]
            || {
                for row in out.chunks_exact_mut(self.size()) {
                    self.perception.turn(row);
                    self.scaling.apply(row);
                }
            },
        );
    }
}

fn quaternion(observation: &[f32], place: usize) -> [f32; 4] {
    *observation[place..].first_chunk().expect("a place within the observation")
}

#[cfg(test)]
mod tests {
    use super::super::Normalizer;
    use super::*;
    use crate::quat::Quat;
    use crate::rng;

    const SPACES: Spaces =
        Spaces { observation_size: 20, action_size: 1, cube_and_goal: Some([5, 11]), distance: |_| 0.0 };

    fn perceive(symmetry: Symmetry, row: &mut [f32]) {
        Perception::new(symmetry, &SPACES).unwrap().turn(row);
    }

    fn observation(cube: Quat, goal: Quat) -> Vec<f32> {
        let mut row: Vec<f32> = (0..20).map(|i| i as f32).collect();
        for (place, q) in [(5, cube), (11, goal)] {
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
            perceive(Symmetry::Cube, &mut seen);
            for rotation in ROTATIONS {
                let turn = |q| quat::mul(q, rotation.map(f64::from));
                let mut other = observation(turn(cube), turn(goal));
                perceive(Symmetry::Cube, &mut other);
                let close = seen.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-5);
                assert!(close, "{rotation:?}: {:?} and {:?}", &seen[5..9], &other[5..9]);
            }
        }
    }

    #[test]
    fn what_is_left_to_the_goal_stays_and_nothing_but_two_orientations_changes() {
        for case in 0..200 {
            let (cube, goal) = (random(2 * case), random(2 * case + 1));
            let raw = observation(cube, goal);
            let mut seen = raw.clone();
            perceive(Symmetry::Cube, &mut seen);
            let [new_cube, new_goal] = [5, 11].map(|at| quaternion(&seen, at));
            let between = |a: [f32; 4], b: [f32; 4]| quat::mul(a.map(f64::from), quat::conj(b.map(f64::from)));
            let left = quat::mul(cube, quat::conj(goal));
            assert!(quat::angle_between(between(new_cube, new_goal), left) < 1e-3);
            // The rotation that takes a cube farthest from all 24 ways of lying is one of 62.8°, about a direction in which
            // two of the axes and the diagonal are as near.
            assert!(new_cube[0] > (62.9f32.to_radians() / 2.0).cos() && new_goal[0] >= 0.0, "{new_cube:?}");
            let others = (0..20).filter(|i| !(5..9).contains(i) && !(11..15).contains(i));
            assert!(others.into_iter().all(|i| seen[i] == raw[i]));
            let before = seen.clone();
            perceive(Symmetry::None, &mut seen);
            assert_eq!(seen, before);
        }
    }

    #[test]
    fn what_is_read_is_perceived_and_then_normalised() {
        let scaling = Normalizer { mean: vec![1.0; 20], variance: vec![4.0; 20], count: 9.0 }.scaling();
        let reader = Reader { perception: Perception::new(Symmetry::Cube, &SPACES).unwrap(), scaling };
        let raw = [observation(random(0), random(1)), observation(random(2), random(3))].concat();
        let mut found = vec![0.0; 40];
        reader.read(&raw, &mut found);
        for (found, raw) in found.chunks_exact(20).zip(raw.chunks_exact(20)) {
            let mut expected = raw.to_vec();
            perceive(Symmetry::Cube, &mut expected);
            assert!(expected != raw);
            let normalised = expected.iter().map(|x| ((x - 1.0) / 2.0).clamp(-5.0, 5.0));
            assert!(normalised.zip(found).all(|(a, b)| (a - b).abs() < 1e-4));
        }
    }

    #[test]
    fn the_symmetry_of_a_cube_is_refused_where_there_is_none() {
        let none = Spaces { cube_and_goal: None, ..SPACES };
        assert!(Perception::new(Symmetry::Cube, &none).unwrap_err().to_string().contains("ppo.symmetry"));
        assert!(Perception::new(Symmetry::None, &none).is_ok());
    }
}
