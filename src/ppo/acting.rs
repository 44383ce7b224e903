//! Acting during a rollout: actions drawn from the policy of the iteration, and what rewards and values need of it.

use rand_distr::{Distribution, StandardNormal};

use super::kernels::Workspace;
use super::policy::FrozenPolicy;
use super::rollout::RolloutBlock;
use crate::config::PpoConfig;
use crate::rng::Rng;
use crate::spaces::Spaces;

/// The policy that collects a rollout, shared by all threads.
pub struct Acting<'a> {
    pub(super) policy: FrozenPolicy<'a>,
    pub(super) config: &'a PpoConfig,
    /// The noise scale far away from the goal.
    pub(super) away_scale: f32,
}

impl Acting<'_> {
    /// Draws actions for the observations of step `t`; writes actions, means, noise scales, log-probabilities and values.
    pub fn act(&self, block: &mut RolloutBlock, t: usize, noise: &mut Rng, work: &mut Workspace) {
        let Spaces { observation_size, action_size, .. } = *self.policy.spaces();
        let [seen, acted, one] = [observation_size, action_size, 1].map(|width| block.step(t, width));
        let observations = &block.observations[seen];
        let (actions, means) = (&mut block.actions[acted.clone()], &mut block.means[acted]);
        self.policy.forward(observations, Some(means), Some(&mut block.values[one.clone()]), work);
        let std = self.policy.std();
        let constant: f32 = std.iter().map(|s| s.ln() + 0.5 * std::f32::consts::TAU.ln()).sum();
        let rows = actions.chunks_exact_mut(action_size).zip(means.chunks_exact(action_size));
        let rows = rows.zip(observations.chunks_exact(observation_size));
        let figures = block.noise_scales[one.clone()].iter_mut().zip(&mut block.log_probs[one]);
        for (((actions, means), observation), (scale, log_prob)) in rows.zip(figures) {
            *scale = self.noise_scale(observation);
            let mut squares = 0.0;
            for ((action, mean), std) in actions.iter_mut().zip(means).zip(std) {
                let drawn: f32 = StandardNormal.sample(noise);
                *action = mean + *scale * std * drawn;
                squares += ((*action - mean) / (*scale * std)).powi(2);
            }
            // The density lacks the scale, here and in the losses: it is the same in both, and only their ratio counts.
            *log_prob = -0.5 * squares - constant;
        }
    }

    /// What the noise is multiplied by. Near the goal the policy's own noise is as small as the goal must be met exactly; far from
    /// it that would only slow learning down, since both what a sample tells of the better action and how far an update of a given
    /// KL divergence goes are in proportion to it.
    fn noise_scale(&self, observation: &[f32]) -> f32 {
        if self.away_scale <= 1.0 {
            return 1.0;
        }
        let [near, far] = self.config.away_range.map(|distance| distance as f32);
        let share = (((self.policy.spaces().distance)(observation) - near) / (far - near)).clamp(0.0, 1.0);
        1.0 + (self.away_scale - 1.0) * share
    }

    /// Scales the rewards of a step and, for each environment whose future was cut off, adds the discounted value of its final
    /// observation, so that the advantages need one array of ends only. `cut_off` `[n]`, `final_observations` `[n, O]`.
    pub fn settle(
        &self,
        rewards: &mut [f32],
        cut_off: impl Iterator<Item = bool>,
        final_observations: &[f32],
        work: &mut Workspace,
    ) {
        let size = final_observations.len() / rewards.len();
        for ((reward, cut_off), observation) in
            rewards.iter_mut().zip(cut_off).zip(final_observations.chunks_exact(size))
        {
            *reward *= self.config.reward_scale as f32;
            if cut_off {
                let mut value = [0.0];
                self.policy.forward(observation, None, Some(&mut value), work);
                *reward += self.config.gamma as f32 * value[0];
            }
        }
    }

    /// Writes the values of the observations after the last step.
    pub fn finish(&self, block: &mut RolloutBlock, horizon: usize, work: &mut Workspace) {
        let (seen, one) = (block.step(horizon, self.policy.spaces().observation_size), block.step(horizon, 1));
        self.policy.forward(&block.observations[seen], None, Some(&mut block.values[one]), work);
    }
}
