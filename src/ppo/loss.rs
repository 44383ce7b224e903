//! The losses of PPO and their gradients with respect to the outputs of the nets, sample by sample.
//!
//! J. Schulman et al., "Proximal policy optimization algorithms" (2017), eq. 7. The value is clipped in the same way.

use std::iter::repeat_n;

use super::backend::Losses;
use super::kernels::widest;
use super::policy::Policy;
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;

/// The losses of a minibatch. An action has A values.
pub struct Loss<'a> {
    rollout: &'a Rollout,
    /// How far ratios may be from 1, and values from those at collection.
    clip: f32,
    value_clip: f32,
    /// The weights of these losses in the loss that is minimised.
    value_coef: f32,
    bounds_coef: f32,
    /// The weight of one sample in the means over the minibatch.
    sample_weight: f32,
    /// The logarithm of the standard deviation of an action.
    log_std: f32,
    /// The reciprocal of that standard deviation.
    inverse_std: f32,
    /// The negated log-density at the mean.
    log_scale: f32,
    action_size: usize,
}

/// Sums over the samples of a group.
pub struct Sums {
    /// All but the KL divergence.
    losses: Losses,
    /// `[A]`: squared differences of the means from the means that acted, divided by the squared noise scales.
    squared_shifts: Vec<f32>,
}

impl<'a> Loss<'a> {
    /// Creates the losses of a minibatch of `samples` samples of `rollout` under `policy`.
    pub fn new(policy: &Policy, rollout: &'a Rollout, samples: usize, config: &PpoConfig) -> Self {
        let log_std = policy.log_std[0];
        let action_size = policy.spaces.action_size;
        Self {
            rollout,
            clip: config.clip as f32,
            value_clip: config.value_clip() as f32,
            value_coef: config.value_coef as f32,
            bounds_coef: config.bounds_coef as f32,
            sample_weight: 1.0 / samples as f32,
            log_std,
            inverse_std: (-log_std).exp(),
            log_scale: repeat_n(log_std + 0.5 * std::f32::consts::TAU.ln(), action_size).sum(),
            action_size,
        }
    }

    /// The sums over no samples.
    pub fn of_none(&self) -> Sums {
        Sums {
            losses: Losses::default(),
            squared_shifts: vec![0.0; self.action_size],
        }
    }

    /// The losses of a group, given the sums of [`Loss::actor`] or [`Loss::critic`].
    pub fn of_group(&self, sums: &Sums) -> Losses {
        // The divergence of Gaussians with the same standard deviation.
        let variance = (2.0 * f64::from(self.log_std)).exp();
        let kl = sums
            .squared_shifts
            .iter()
            .map(|&shift| 0.5 * f64::from(shift) / variance)
            .sum();
        Losses { kl, ..sums.losses }
    }

    /// Writes the gradient `[m, A]` with respect to the `means` `[m, A]` of these samples.
    pub fn actor(&self, samples: &[u32], means: &[f32], grad: &mut [f32], sums: &mut Sums) {
        let width = self.action_size;
        widest!({
            let rows = means.chunks_exact(width).zip(grad.chunks_exact_mut(width));
            for (&sample, (mean, grad)) in samples.iter().zip(rows) {
                self.actor_sample(self.rollout.locate(sample), mean, grad, sums);
            }
        });
    }

    #[inline(always)]
    fn actor_sample(
        &self,
        (block, i): (&RolloutBlock, usize),
        mean: &[f32],
        grad: &mut [f32],
        sums: &mut Sums,
    ) {
        let Sums {
            losses: sums,
            squared_shifts,
        } = sums;
        let row = RolloutBlock::row(mean.len(), i);
        let inverse_scale = 1.0 / block.noise_scales[i];
        // `grad` first holds the distances from the mean in standard deviations, and then the gradient.
        for ((z, action), mean) in grad.iter_mut().zip(&block.actions[row.clone()]).zip(mean) {
            *z = (action - mean) * (self.inverse_std * inverse_scale);
        }
        let log_prob = -0.5 * grad.iter().map(|z| z * z).sum::<f32>() - self.log_scale;
        let ratio = (log_prob - block.log_probs[i]).exp();
        let (surrogate, slope) = self.surrogate(ratio, block.advantages[i]);
        let error = (ratio - 1.0).abs();
        sums.surrogate += f64::from(surrogate);
        sums.clipped += f64::from(error > self.clip);
        sums.ratio_error = sums.ratio_error.max(f64::from(error));
        for ((sum, mean), old_mean) in squared_shifts.iter_mut().zip(mean).zip(&block.means[row]) {
            let shift = (mean - old_mean) * inverse_scale;
            *sum += shift * shift;
        }
        let pull = 2.0 * self.bounds_coef * self.sample_weight;
        let mut excess = 0.0;
        for (z, mean) in grad.iter_mut().zip(mean) {
            let beyond = mean - mean.clamp(-1.0, 1.0);
            excess += beyond * beyond;
            *z = *z * (slope * inverse_scale * self.inverse_std) + pull * beyond;
        }
        sums.excess += f64::from(excess);
    }

    /// The clipped surrogate of a sample, and the derivative of the loss with respect to the logarithm of its ratio.
    #[inline(always)]
    fn surrogate(&self, ratio: f32, advantage: f32) -> (f32, f32) {
        let free = ratio * advantage;
        let bounded = ratio.clamp(1.0 - self.clip, 1.0 + self.clip) * advantage;
        // A NaN ratio takes the second branch and makes the sum NaN.
        if free <= bounded {
            (free, -self.sample_weight * free)
        } else {
            (bounded, 0.0)
        }
    }

    /// Writes the gradient `[m]` with respect to the `values` `[m]` of these samples.
    pub fn critic(&self, samples: &[u32], values: &[f32], grad: &mut [f32], sums: &mut Sums) {
        for ((&sample, &value), grad) in samples.iter().zip(values).zip(grad) {
            let (block, i) = self.rollout.locate(sample);
            let old = block.values[i];
            let target = block.returns[i];
            let step = (value - old).clamp(-self.value_clip, self.value_clip);
            let free = value - target;
            let bounded = old + step - target;
            let inside = (value - old).abs() <= self.value_clip;
            // Where clipping the step makes the error larger, the error does not depend on the value.
            let (error, slope) = if inside || free * free >= bounded * bounded {
                (free, 2.0 * free)
            } else {
                (bounded, 0.0)
            };
            sums.losses.value_error += f64::from(error * error);
            *grad = self.value_coef * self.sample_weight * slope;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::spaces::Spaces;

    fn assert_close(found: &[f32], expected: &[f32]) {
        let close = found
            .iter()
            .zip(expected)
            .all(|(a, b)| (a - b).abs() < 2e-6 * (1.0 + b.abs()));
        assert!(
            close && found.len() == expected.len(),
            "{found:?} instead of {expected:?}"
        );
    }

    /// The expected values come from the formulas of the PyTorch program in `candle/loss.rs`, in doubles, with gradients by
    /// central differences. Both actions have a standard deviation with the logarithm -0.5.
    #[test]
    fn losses_and_gradients_are_those_of_the_formulas() {
        let spaces = Spaces {
            observation_size: 1,
            action_size: 2,
            object_and_goal: None,
            distance: |_, _| 0.0,
        };
        let mut rollout = Rollout::new(1, &[3], &spaces);
        let block = &mut rollout.blocks[0];
        block.actions = vec![0.5, -1.0, -0.3, 0.9, 0.2, 1.5];
        block.means = vec![-0.1, -0.1, 0.4, 0.5, -0.5, 0.5];
        block.advantages = vec![1.0, 0.5, -2.0];
        block.values[..3].copy_from_slice(&[0.2, -0.1, 1.0]);
        block.returns = vec![0.5, 0.1, 1.9];
        block.noise_scales = vec![1.0, 1.5, 0.8];
        let log_std = -0.5f32;
        for (i, log_prob) in block.log_probs.iter_mut().enumerate() {
            let std = block.noise_scales[i] * log_std.exp();
            let z = [0, 1].map(|j| (block.actions[2 * i + j] - block.means[2 * i + j]) / std);
            *log_prob =
                -0.5 * (z[0] * z[0] + z[1] * z[1]) - 2.0 * log_std - std::f32::consts::TAU.ln();
        }
        let mut config = Config::default().ppo;
        (config.clip, config.value_clip) = (0.2, 0.3);
        (config.value_coef, config.bounds_coef) = (2.0, 0.5);
        config.hidden = vec![1];
        let mut policy = Policy::new(&config, spaces);
        policy.log_std.fill(log_std);
        let loss = Loss::new(&policy, &rollout, 3, &config);
        let (mut actor, mut critic) = (loss.of_none(), loss.of_none());
        let mut grad = [0.0; 6];
        loss.actor(
            &[0, 1, 2],
            &[0.1, -0.2, 0.5, 0.3, -0.4, 0.8],
            &mut grad,
            &mut actor,
        );
        assert_close(
            &grad,
            &[0.0, 0.0, 0.130_386_1, -0.097_789_58, 6.613_660_5, 7.715_937],
        );
        let mut grad = [0.0; 3];
        loss.critic(&[0, 1, 2], &[0.3, -0.6, 1.4], &mut grad, &mut critic);
        assert_close(&grad, &[-0.266_666_65, -0.933_333_4, 0.0]);
        let sums = loss.of_group(&actor) + loss.of_group(&critic);
        assert_close(&[-sums.surrogate as f32 / 3.0], &[2.060_326_3]);
        assert_close(&[sums.ratio_error as f32], &[2.892_847_6]);
        assert_eq!(sums.clipped, 2.0);
        assert_close(&[sums.kl as f32 / 3.0], &[0.103_508_65]);
        assert_close(&[sums.value_error as f32 / 3.0], &[0.296_666_7]);
        assert_eq!(sums.excess, 0.0);

        // Means beyond ±1 add 2 · 0.5 · their distance, divided by three samples, to the gradient of the surrogate.
        let grads = [[1.5, -0.2], [1.0, -0.2]].map(|mean| {
            let mut grad = [0.0; 2];
            loss.actor(&[2], &mean, &mut grad, &mut actor);
            grad
        });
        assert!((actor.losses.excess - 0.25).abs() < 1e-6);
        let config = PpoConfig {
            bounds_coef: 0.0,
            ..config.clone()
        };
        let mut free = [0.0; 2];
        let loss = Loss::new(&policy, &rollout, 3, &config);
        loss.actor(&[2], &[1.5, -0.2], &mut free, &mut actor);
        assert_close(
            &[grads[0][0] - free[0], grads[0][1] - free[1]],
            &[0.5 / 3.0, 0.0],
        );
    }
}
