//! How a policy reads observations: it turns an object onto itself so that equal states look the same, then normalises.
//!
//! The faces of the cube look different, but make no difference to the hand. There are 24 rotations that map a cube
//! onto itself. If one of them rotates cube and goal about the cube's own axes, the cube moves in the same way under
//! the same actions. The remaining rotation to the goal is the same. So each observation is first mapped to one of the
//! 24 equivalent ones, and a policy has to learn only that one.

use super::kernels::widest;
use super::normalizer::Normalizer;
use crate::quat::{self, CUBE_ROTATIONS};
use crate::spaces::{ObjectAndGoal, Spaces};

/// The way a policy reads raw observations: turned, then normalised as `(x - mean) · factor`, clipped.
pub struct Perception {
    /// The offsets of the orientations of cube and goal, if they are to be rotated.
    pub object_and_goal: Option<ObjectAndGoal>,
    /// The rotations that map the object onto itself. If there are fewer, the first one fills the rest.
    pub rotations: [[f32; 4]; CUBE_ROTATIONS.len()],
    /// `[O]`
    pub mean: Vec<f32>,
    /// `[O]`
    pub factor: Vec<f32>,
    /// The limit of normalised values.
    pub clip: f32,
}

impl Perception {
    /// Creates the perception of the observations that `spaces` describes, by a policy that has seen these statistics.
    pub fn new(spaces: &Spaces, normalizer: &Normalizer) -> Self {
        let object_and_goal = spaces
            .object_and_goal
            .filter(|places| places.rotations != 1);
        let mask = object_and_goal.map_or(1, |places| places.rotations);
        let mut own = CUBE_ROTATIONS
            .into_iter()
            .enumerate()
            .filter(|(i, _)| mask >> i & 1 == 1);
        Self {
            object_and_goal,
            rotations: std::array::from_fn(|_| {
                own.next()
                    .map_or(CUBE_ROTATIONS[0], |(_, rotation)| rotation)
            }),
            mean: normalizer.mean.iter().map(|&m| m as f32).collect(),
            factor: normalizer
                .variance
                .iter()
                .map(|&v| (1.0 / (v + normalizer.epsilon).sqrt()) as f32)
                .collect(),
            clip: normalizer.clip as f32,
        }
    }

    /// Maps one raw observation `[O]`, in place, to the observation that represents all equivalent ones.
    #[inline(always)]
    pub fn canonicalize(&self, observation: &mut [f32]) {
        let Some(ObjectAndGoal { object, goal, .. }) = self.object_and_goal else {
            return;
        };
        let q = quat::read(observation, object);
        // The cosine of half the angle that remains to the unrotated orientation. All are computed first, so that the loop vectorises.
        let close = self
            .rotations
            .map(|s| (q[0] * s[0] - q[1] * s[1] - q[2] * s[2] - q[3] * s[3]).abs());
        let best = self.rotations
            [(1..close.len()).fold(0, |best, i| if close[i] > close[best] { i } else { best })];
        for place in [object, goal] {
            let turned = quat::mul(quat::read(observation, place), best);
            observation[place..place + 4].copy_from_slice(&quat::canonical(turned));
        }
    }

    /// Writes what the nets see of the `raw` observations `[B, O]` into `out` `[B, O]`.
    pub(super) fn apply(&self, raw: &[f32], out: &mut [f32]) {
        out.copy_from_slice(raw);
        widest!({
            for row in out.chunks_exact_mut(self.mean.len()) {
                self.canonicalize(row);
                for ((x, mean), factor) in row.iter_mut().zip(&self.mean).zip(&self.factor) {
                    *x = ((*x - mean) * factor).clamp(-self.clip, self.clip);
                }
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quat::Quat;
    use crate::rng;

    const SPACES: Spaces = Spaces {
        observation_size: 20,
        action_size: 1,
        object_and_goal: Some(ObjectAndGoal {
            object: 5,
            goal: 11,
            relative: 0,
            rotations: u32::MAX,
        }),
        distance: |_, _| 0.0,
    };

    const UNTURNED: Spaces = Spaces {
        object_and_goal: None,
        ..SPACES
    };

    fn perceive(row: &mut [f32]) {
        Perception::new(&SPACES, &Normalizer::new(20)).canonicalize(row);
    }

    fn observation(object: Quat, goal: Quat) -> Vec<f32> {
        let mut row: Vec<f32> = (0..20).map(|i| i as f32).collect();
        for (place, q) in [(5, object), (11, goal)] {
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
        for (i, &rotation) in CUBE_ROTATIONS.iter().enumerate() {
            let q = rotation.map(f64::from);
            for axis in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
                let turned = quat::rotate(q, axis);
                let largest = turned.iter().fold(0.0f64, |most, x| most.max(x.abs()));
                assert!(
                    (largest - 1.0).abs() < 1e-6,
                    "{rotation:?} takes {axis:?} to {turned:?}"
                );
            }
            for other in &CUBE_ROTATIONS[..i] {
                let cosine: f32 = rotation.iter().zip(other).map(|(a, b)| a * b).sum();
                assert!(cosine.abs() < 0.99, "{rotation:?} is {other:?}");
            }
        }
    }

    #[test]
    fn a_cube_and_the_same_cube_turned_onto_itself_look_the_same_to_a_policy() {
        for case in 0..200 {
            let (object, goal) = (random(2 * case), random(2 * case + 1));
            let mut seen = observation(object, goal);
            perceive(&mut seen);
            for rotation in CUBE_ROTATIONS {
                let turn = |q| quat::mul(q, rotation.map(f64::from));
                let mut other = observation(turn(object), turn(goal));
                perceive(&mut other);
                let close = seen.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-5);
                assert!(
                    close,
                    "{rotation:?}: {:?} and {:?}",
                    &seen[5..9],
                    &other[5..9]
                );
            }
        }
    }

    #[test]
    fn what_is_left_to_the_goal_stays_and_nothing_but_two_orientations_changes() {
        for case in 0..200 {
            let (object, goal) = (random(2 * case), random(2 * case + 1));
            let raw = observation(object, goal);
            let mut seen = raw.clone();
            perceive(&mut seen);
            let [new_object, new_goal] = [5, 11].map(|at| quat::read(&seen, at));
            let between = |a: [f32; 4], b: [f32; 4]| {
                quat::mul(a.map(f64::from), quat::conj(b.map(f64::from)))
            };
            let left = quat::mul(object, quat::conj(goal));
            assert!(quat::angle_between(between(new_object, new_goal), left) < 1e-3);
            // The largest misorientation of a cube is 62.8°. Equally near are then no rotation, a quarter turn about
            // either of two axes, and a third turn about the diagonal between them.
            assert!(
                new_object[0] > (62.9f32.to_radians() / 2.0).cos() && new_goal[0] >= 0.0,
                "{new_object:?}"
            );
            let others = (0..20).filter(|i| !(5..9).contains(i) && !(11..15).contains(i));
            assert!(others.into_iter().all(|i| seen[i] == raw[i]));
            let before = seen.clone();
            Perception::new(&UNTURNED, &Normalizer::new(20)).canonicalize(&mut seen);
            assert_eq!(seen, before);
        }
    }

    #[test]
    fn what_is_read_is_perceived_and_then_normalised() {
        let normalizer = Normalizer {
            mean: vec![1.0; 20],
            variance: vec![4.0; 20],
            ..Normalizer::new(20)
        };
        let perception = Perception::new(&SPACES, &normalizer);
        let raw = [
            observation(random(0), random(1)),
            observation(random(2), random(3)),
        ]
        .concat();
        let mut found = vec![0.0; 40];
        perception.apply(&raw, &mut found);
        for (found, raw) in found.chunks_exact(20).zip(raw.chunks_exact(20)) {
            let mut expected = raw.to_vec();
            perceive(&mut expected);
            assert!(expected != raw);
            let normalised = expected.iter().map(|x| ((x - 1.0) / 2.0).clamp(-5.0, 5.0));
            assert!(normalised.zip(found).all(|(a, b)| (a - b).abs() < 1e-4));
        }
    }

    #[test]
    fn normalised_values_are_in_standard_deviations_and_clipped() {
        let normalizer = Normalizer {
            mean: vec![2.0],
            variance: vec![4.0],
            ..Normalizer::new(1)
        };
        let mut normalised = [0.0; 3];
        let perception = Perception::new(&UNTURNED, &normalizer);
        perception.apply(&[4.0, 2.0, 400.0], &mut normalised);
        assert!((normalised[0] - 1.0).abs() < 1e-5, "{normalised:?}");
        assert_eq!(normalised[1..], [0.0, 5.0]);
    }
}
