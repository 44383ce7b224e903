//! What a real sensor would add to an observation: white noise, and an offset that stays the same through an episode.

use std::collections::BTreeMap;

use anyhow::{Result, ensure};
use rand_distr::{Distribution, StandardNormal};

use super::observation::{GOAL_QUAT, Layout, OBJECT_QUAT, RELATIVE_QUAT, TIP_QUAT};
use crate::config::ByName;
use crate::os::shortened;
use crate::quat::{self, Quat};
use crate::rng::Rng;

/// The standard deviations of what is added to each value of an observation, by index, where they are not 0.
#[derive(Clone, Debug)]
pub struct NoiseStd(pub Vec<(usize, f32)>);

impl NoiseStd {
    /// Spreads the values of groups over the values of an observation.
    ///
    /// # Errors
    /// Fails on the name of a group that does not exist or is not measured.
    pub fn new(groups: &ByName, layout: &Layout) -> Result<Self> {
        let measured: Vec<&str> = layout.measured().map(|group| group.name).collect();
        expect_names(groups, &measured)?;
        let mut all = Vec::new();
        for group in layout.measured() {
            let std = groups.get(group.name).map_or(0.0, |&std| std as f32);
            if std != 0.0 {
                all.extend(group.cells().map(|i| (i, std)));
            }
        }
        Ok(Self(all))
    }

    /// Draws what is added: independent normal numbers.
    pub fn draw<'a>(&'a self, rng: &'a mut Rng) -> impl Iterator<Item = (usize, f32)> + 'a {
        self.0
            .iter()
            .map(|&(i, std)| (i, std * Distribution::<f32>::sample(&StandardNormal, rng)))
    }
}

/// Checks that values have no other names than these.
///
/// # Errors
/// Fails with the first other name.
pub fn expect_names(values: &ByName, names: &[&str]) -> Result<()> {
    for name in values.keys() {
        ensure!(
            names.contains(&&**name),
            "`{}` is none of {}",
            shortened(name),
            names.join(", ")
        );
    }
    Ok(())
}

/// Adds the offset of an episode, which has these parts by the numbers of the values. On an orientation q it is a small rotation q ⊗ (1, v), where v are the last three of its four
/// numbers. It stays the same however the body turns.
pub fn offset(observation: &mut [f32], bias: &BTreeMap<usize, f32>, layout: &Layout) {
    let orientations = || {
        let tips = layout.tips().map(|tip| tip + TIP_QUAT);
        tips.chain([layout.start(OBJECT_QUAT)])
    };
    let of_value = |i: usize| bias.get(&i).copied().unwrap_or_default();
    for (&i, added) in bias {
        if !orientations().any(|at| (at..at + 4).contains(&i)) {
            observation[i] += added;
        }
    }
    for at in orientations() {
        let error = [1.0, of_value(at + 1), of_value(at + 2), of_value(at + 3)];
        let turned = quat::mul(quat::read(observation, at), error);
        observation[at..at + 4].copy_from_slice(&turned);
    }
}

/// Makes an observation consistent after something was added to its values. Quaternions get length 1 and their usual sign. The
/// orientation relative to the goal follows from the orientation of the object.
pub fn make_consistent(observation: &mut [f32], layout: &Layout) {
    let read = |observation: &[f32], at: usize| {
        let q = quat::read(observation, at).map(f64::from);
        let length = quat::length(&q);
        // Noise this close to the negative of a quaternion leaves no orientation.
        if length > 1e-6 {
            q.map(|x| x / length)
        } else {
            quat::IDENTITY
        }
    };
    let write = |observation: &mut [f32], at: usize, q: Quat| {
        observation[at..at + 4].copy_from_slice(&q.map(|x| x as f32));
    };
    let [object_at, goal_at, relative_at] =
        [OBJECT_QUAT, GOAL_QUAT, RELATIVE_QUAT].map(|group| layout.start(group));
    let object = quat::canonical(read(observation, object_at));
    let goal = read(observation, goal_at);
    write(observation, object_at, object);
    write(
        observation,
        relative_at,
        quat::canonical(quat::mul(object, quat::conj(goal))),
    );
    for tip in layout.tips() {
        let orientation = read(observation, tip + TIP_QUAT);
        write(observation, tip + TIP_QUAT, orientation);
    }
}

#[cfg(test)]
mod tests {
    use super::super::observation::{TIP_SIZE, TIPS};
    use super::*;
    use crate::rng;

    fn shadow() -> Layout {
        Layout::new(24, 5, 20, false)
    }

    fn spread(groups: &[(&str, f64)]) -> Result<NoiseStd> {
        NoiseStd::new(
            &groups
                .iter()
                .map(|&(name, std)| (name.to_owned(), std))
                .collect(),
            &shadow(),
        )
    }

    #[test]
    fn noise_has_the_deviation_that_was_asked_in_the_groups_that_were_named_and_nowhere_else() {
        let spread = spread(&[("joint_pos", 0.5), ("cube_pos", 0.0)]).unwrap();
        let mut rng = rng::stream(1, "noise", 0);
        let drawn: Vec<(usize, f32)> = (0..1000)
            .flat_map(|_| spread.draw(&mut rng).collect::<Vec<_>>())
            .collect();
        assert!(drawn.len() == 24_000 && drawn.iter().all(|&(i, _)| i < 24));
        let variance = drawn
            .iter()
            .map(|&(_, x)| f64::from(x).powi(2))
            .sum::<f64>()
            / drawn.len() as f64;
        assert!((variance.sqrt() - 0.5).abs() < 0.01, "{variance}");
    }

    #[test]
    fn groups_that_do_not_exist_or_are_not_measured_are_refused() {
        for name in ["joint_positions", "goal_quat", "known"] {
            let error = spread(&[(name, 0.1)]).unwrap_err().to_string();
            let expected = format!("`{name}` is none of joint_pos, joint_vel, ");
            assert!(error.contains(&expected), "{error}");
        }
    }

    #[test]
    fn the_offset_of_an_orientation_is_the_same_rotation_however_the_cube_lies() {
        let bias = spread(&[("cube_quat", 0.05), ("joint_pos", 0.1)]).unwrap();
        let bias: BTreeMap<usize, f32> = bias.draw(&mut rng::stream(1, "bias", 0)).collect();
        let mut turns = rng::stream(2, "turns", 0);
        let mut off = || {
            let q = quat::canonical(quat::uniform(
                [0; 3].map(|_| rng::uniform(&mut turns, 0.0, 1.0)),
            ));
            let mut observation = vec![0.1; shadow().size];
            observation[shadow().start(OBJECT_QUAT)..][..4].copy_from_slice(&q.map(|x| x as f32));
            offset(&mut observation, &bias, &shadow());
            make_consistent(&mut observation, &shadow());
            assert_eq!(observation[5], 0.1 + bias[&5]);
            assert_eq!(observation[30], 0.1);
            let seen =
                [0, 1, 2, 3].map(|i| f64::from(observation[shadow().start(OBJECT_QUAT) + i]));
            quat::canonical(quat::mul(quat::conj(q), seen))
        };
        let first = off();
        assert!(first[0] < 0.9999, "{first:?}");
        for _ in 0..50 {
            assert!(off().iter().zip(first).all(|(a, b)| (a - b).abs() < 1e-5));
        }
    }

    #[test]
    fn quaternions_stay_of_length_one_and_the_relative_one_is_that_of_the_seen_cube() {
        let mut observation = vec![0.1; shadow().size];
        observation[shadow().start(GOAL_QUAT)..][..4].copy_from_slice(&[0.0, 1.0, 0.0, 0.0]);
        observation[shadow().start(OBJECT_QUAT)..][..4].copy_from_slice(&[0.2, 0.9, 0.3, -0.2]);
        for (i, added) in [
            (shadow().start(OBJECT_QUAT), -0.4),
            (shadow().start(TIPS) + TIP_QUAT, 3.0),
            (3, 0.25),
        ] {
            observation[i] += added;
        }
        make_consistent(&mut observation, &shadow());
        let part = |at: usize| [0, 1, 2, 3].map(|i| f64::from(observation[at + i]));
        let object = part(shadow().start(OBJECT_QUAT));
        assert!(object[0] > 0.0 && object[1] < 0.0, "{object:?}");
        for at in [
            shadow().start(OBJECT_QUAT),
            shadow().start(RELATIVE_QUAT),
            shadow().start(TIPS) + TIP_QUAT,
            shadow().start(TIPS) + TIP_SIZE + TIP_QUAT,
        ] {
            assert!((part(at).iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-6);
        }
        let relative = quat::canonical(quat::mul(object, quat::conj([0.0, 1.0, 0.0, 0.0])));
        assert!(
            part(shadow().start(RELATIVE_QUAT))
                .iter()
                .zip(relative)
                .all(|(a, b)| (a - b).abs() < 1e-6)
        );
        assert_eq!((observation[3], observation[4]), (0.35, 0.1));
    }
}
