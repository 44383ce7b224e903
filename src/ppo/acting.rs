//! Acting during a rollout: draws actions from the current policy and bootstraps rewards with its values.

use std::iter::repeat_n;

use rand_distr::{Distribution, StandardNormal};

use super::kernels::Workspace;
use super::policy::FrozenPolicy;
use super::rollout::RolloutBlock;
use crate::config::PpoConfig;
use crate::rng::Rng;
use crate::spaces::Spaces;

/// The policy that collects a rollout, shared by all threads.
pub struct Acting<'a> {
    pub(super) frozen: FrozenPolicy<'a>,
    pub(super) config: &'a PpoConfig,
    /// The noise scale far from the goal.
    pub(super) away_scale: f32,
}

impl Acting<'_> {
    /// Draws actions for the observations of step `t`. Writes actions, means, noise scales, log-probabilities and values.
    pub fn act(&self, block: &mut RolloutBlock, t: usize, noise: &mut Rng, work: &mut Workspace) {
        let Spaces {
            observation_size,
            action_size,
            ..
        } = self.frozen.policy.spaces;
        let [seen, acted, one] =
            [observation_size, action_size, 1].map(|width| block.step(t, width));
        let observations = &block.observations[seen];
        let actions = &mut block.actions[acted.clone()];
        let means = &mut block.means[acted];
        self.frozen
            .compute(observations, [means, &mut block.values[one.clone()]], work);
        let std = self.frozen.policy.std();
        let constant: f32 =
            repeat_n(std.ln() + 0.5 * std::f32::consts::TAU.ln(), action_size).sum();
        let rows = actions
            .chunks_exact_mut(action_size)
            .zip(means.chunks_exact(action_size))
            .zip(observations.chunks_exact(observation_size));
        let figures = block.noise_scales[one.clone()]
            .iter_mut()
            .zip(&mut block.log_probs[one]);
        for (((actions, means), observation), (scale, log_prob)) in rows.zip(figures) {
            *scale = self.noise_scale(observation);
            let mut squares = 0.0;
            for (action, mean) in actions.iter_mut().zip(means) {
                let drawn: f32 = StandardNormal.sample(noise);
                *action = mean + *scale * std * drawn;
                squares += ((*action - mean) / (*scale * std)).powi(2);
            }
            // The log-density omits the scale, here and in the losses, because it would cancel in the ratio of the two.
            *log_prob = -0.5 * squares - constant;
        }
    }

    /// The factor on the policy's noise. Near the goal, the policy's own noise is as small as the required
    /// precision demands. Far from it, so little noise would only slow learning down. What a sample reveals about
    /// better actions is proportional to the noise. So is the distance by which an update with a given KL divergence
    /// moves the policy.
    fn noise_scale(&self, observation: &[f32]) -> f32 {
        if self.away_scale <= 1.0 {
            return 1.0;
        }
        let [near, far] = self.config.away_range.map(|distance| distance as f32);
        let spaces = &self.frozen.policy.spaces;
        let fraction =
            (((spaces.distance)(spaces, observation) - near) / (far - near)).clamp(0.0, 1.0);
        1.0 + (self.away_scale - 1.0) * fraction
    }

    /// Scales the rewards `[n]` of a step. Where the future of an environment was cut off, also adds the discounted value of
    /// its final observation `[O]`. So advantages need only one array of ends.
    pub fn scale_and_bootstrap<'o>(
        &self,
        rewards: &mut [f32],
        cut_off: impl Iterator<Item = Option<&'o [f32]>>,
        work: &mut Workspace,
    ) {
        for (reward, cut_off) in rewards.iter_mut().zip(cut_off) {
            *reward *= self.config.reward_scale as f32;
            if let Some(observation) = cut_off {
                let mut value = [0.0];
                self.frozen
                    .compute(observation, [&mut [], &mut value], work);
                *reward += self.config.gamma as f32 * value[0];
            }
        }
    }

    /// Writes the values of the observations after the last step.
    pub fn finish(&self, block: &mut RolloutBlock, horizon: usize, work: &mut Workspace) {
        let seen = block.step(horizon, self.frozen.policy.spaces.observation_size);
        let one = block.step(horizon, 1);
        self.frozen.compute(
            &block.observations[seen],
            [&mut [], &mut block.values[one]],
            work,
        );
    }
}
