//! Nets made wider without changing what they compute.
//!
//! A new unit gets the weights that it would have in a new net. But the weights from new units to old units start at
//! zero, so the output does not change until they are trained. (Copies of old units, as in T. Chen, I. Goodfellow, J.
//! Shlens, "Net2Net" (2016), would need noise to become different, and noise changes the function.)

use anyhow::{Result, ensure};

use super::format::Array;
use super::parameters::{Layout, View};
use super::{Checkpoint, Policy};
use crate::config::NetConfig;
use crate::spaces::Spaces;

impl Checkpoint {
    /// Widens the nets of a policy, and the optimizer state that belongs to them, to the sizes in `to`. New weights are
    /// derived from `seed`.
    ///
    /// # Errors
    /// Fails if a net would become narrower or change its depth, or if the tensors do not match `from`.
    pub fn grow(&mut self, from: &NetConfig, to: &NetConfig, spaces: Spaces, seed: u64) -> Result<()> {
        if from.hidden == to.hidden {
            return Ok(());
        }
        let [old, new] = [&from.hidden, &to.hidden];
        ensure!(
            old.len() == new.len() && old.iter().zip(new).all(|(old, new)| old <= new),
            "ppo.hidden = {new:?}: nets of {old:?} can only be made wider, with the same number of layers and none smaller"
        );
        let (old, new) = (Layout::new(&from.hidden, &spaces), Layout::new(&to.hidden, &spaces));
        let mut policy = Policy::random(to, spaces, 1.0, seed)?.parameters;
        for (old, new) in old.layers().zip(new.layers()) {
            for row in policy[new.weight.clone()].chunks_exact_mut(new.inputs).take(old.outputs) {
                row[old.inputs..].fill(0.0);
            }
        }
        self.widen("", [&old, &new], |_| policy)?;
        self.widen("adam.mean.", [&old, &new], |_| vec![0.0; new.count()])?;
        // New entries start with the mean of the old ones of the same tensor: from zero, their first steps would be
        // many times too large.
        self.widen("adam.square.", [&old, &new], |known| {
            let mut begin = vec![0.0; new.count()];
            for (View { range: old, .. }, View { range: new, .. }) in old.views().into_iter().zip(new.views()) {
                let mean = known[old.clone()].iter().sum::<f32>() / old.len() as f32;
                begin[new].fill(mean);
            }
            begin
        })
    }

    /// Replaces the arrays with this prefix by arrays of the new layout: the values that `begin` returns for them, with
    /// the existing values copied over.
    fn widen(&mut self, prefix: &str, [old, new]: [&Layout; 2], begin: impl FnOnce(&[f32]) -> Vec<f32>) -> Result<()> {
        let known = self.take_floats(prefix, &old.views())?;
        let mut numbers = begin(&known);
        for (old, new) in old.layers().zip(new.layers()) {
            let rows = numbers[new.weight.clone()].chunks_exact_mut(new.inputs);
            for (row, known) in rows.zip(known[old.weight.clone()].chunks_exact(old.inputs)) {
                row[..old.inputs].copy_from_slice(known);
            }
            numbers[new.bias.clone()][..old.outputs].copy_from_slice(&known[old.bias.clone()]);
        }
        for View { name, shape, range } in new.views() {
            self.insert(&format!("{prefix}{name}"), Array::F32(shape, numbers[range].to_vec()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Activation, Symmetry};
    use crate::ppo::{Ppo, Progress};
    use crate::ranks::Exchange;

    const SPACES: Spaces = Spaces { observation_size: 3, action_size: 2, cube_and_goal: None, distance: |_, _| 0.0 };

    fn net(hidden: &[usize]) -> NetConfig {
        NetConfig { hidden: hidden.to_vec(), activation: Activation::Elu, symmetry: Symmetry::None }
    }

    fn learner(hidden: &[usize], seed: u64) -> Ppo {
        let mut config = crate::config::Config::resolve(None, &[]).unwrap().ppo;
        (config.hidden, config.symmetry) = (hidden.to_vec(), Symmetry::None);
        let mut ppo = Ppo::new(&config, SPACES, seed, Exchange::alone(1)).unwrap();
        let count = ppo.adam.square.len();
        ppo.adam.mean = (0..count).map(|i| i as f32).collect();
        ppo.adam.square = (0..count).map(|i| 2.0 * i as f32).collect();
        ppo
    }

    /// Returns means and values for some observations.
    fn answers(ppo: &Ppo) -> Vec<f32> {
        let policy = ppo.policy().freeze();
        let (observations, mut means, mut values) = ([0.3, -2.0, 1.0, 0.0, 5.0, -0.1], [0.0; 4], [0.0; 2]);
        policy.actions_and_values(&observations, (&mut means, &mut values), &mut policy.workspace(2));
        means.into_iter().chain(values).collect()
    }

    #[test]
    fn a_wider_net_computes_the_same_and_its_new_units_can_learn() {
        let (from, mut to) = (learner(&[8, 4], 1), learner(&[20, 9], 2));
        let mut checkpoint = from.checkpoint("", Progress::default());
        checkpoint.grow(&net(&[8, 4]), &net(&[20, 9]), SPACES, 3).unwrap();
        to.restore(&mut checkpoint).unwrap();
        checkpoint.finish().unwrap();
        for (found, expected) in answers(&to).iter().zip(answers(&from)) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
        let second = &to.policy.layout.actor[1];
        let rows: Vec<&[f32]> = to.policy.parameters[second.weight.clone()].chunks_exact(20).collect();
        assert!(rows[..4].iter().all(|row| row[8..].iter().all(|&x| x == 0.0)), "old units ignore new ones");
        assert!(rows[4..].iter().all(|row| row.iter().all(|&x| x != 0.0)), "new units read all");
        let old = &from.policy.layout.actor[0];
        assert_eq!(to.adam.mean[..24], from.adam.mean[old.weight.clone()], "old optimizer state stays");
        assert!(to.adam.mean[24..60].iter().all(|&x| x == 0.0) && to.adam.square[24..60].iter().all(|&x| x == 23.0));
    }

    #[test]
    fn a_net_is_not_made_narrower_or_deeper() {
        for hidden in [&[8, 3][..], &[20], &[8, 4, 4]] {
            let mut checkpoint = learner(&[8, 4], 1).checkpoint("", Progress::default());
            let refusal = checkpoint.grow(&net(&[8, 4]), &net(hidden), SPACES, 3).unwrap_err().to_string();
            assert!(refusal.contains("ppo.hidden") && refusal.contains("only be made wider"), "{refusal}");
        }
    }
}
