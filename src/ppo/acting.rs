//! Acting during a rollout: actions drawn from the policy of the iteration, and what rewards and values need of it.

use anyhow::Result;
use rand_distr::{Distribution, StandardNormal};

use super::fused::Workspace;
use super::policy::FrozenPolicy;
use super::rollout::{RolloutBlock, RolloutStep};
use crate::rng::Rng;

/// The policy that collects a rollout, shared by all threads.
pub struct Acting<'a> {
    pub(super) policy: FrozenPolicy<'a>,
    /// The noise scale far away from the goal, and the distances on which it rises to that from 1.
    pub(super) away_scale: f32,
    pub(super) away_range: [f32; 2],
    pub(super) gamma: f32,
    pub(super) reward_scale: f32,
}

impl Acting<'_> {
    /// Sets the noise scales of a step: what `distance` finds in an observation is how far its goal is away, rad. Near it the
    /// policy's own noise is as small as the goal must be met exactly; far from it that would only slow learning down, since both
    /// what a sample tells of the better action and how far an update of a given KL divergence goes are in proportion to it.
    pub fn set_noise_scales(&self, step: &mut RolloutStep, distance: fn(&[f32]) -> f32) {
        let [near, far] = self.away_range;
        let rows = step.observations.chunks_exact(step.observations.len() / step.noise_scales.len());
        for ((scale, exploring), row) in step.noise_scales.iter_mut().zip(step.exploring_scales).zip(rows) {
            *scale = *exploring;
            if self.away_scale > 1.0 {
                let share = ((distance(row) - near) / (far - near)).clamp(0.0, 1.0);
                *scale = exploring.max(1.0 + (self.away_scale - 1.0) * share);
            }
        }
    }

    /// Draws actions for the observations of a step; writes actions, means, log-probabilities and values.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn act(&self, step: &mut RolloutStep, noise: &mut Rng, work: &mut Workspace) -> Result<()> {
        self.policy.forward(step.observations, [Some(step.means), Some(step.values)], work)?;
        let std = self.policy.std();
        let constant: f32 = std.iter().map(|s| s.ln() + 0.5 * std::f32::consts::TAU.ln()).sum();
        let rows = step.actions.chunks_exact_mut(std.len()).zip(step.means.chunks_exact(std.len()));
        let steady = step.exploring_scales.iter().zip(step.steady_noise.chunks_exact(std.len()));
        let noises = step.noise_scales.iter().zip(steady);
        for (((actions, means), log_prob), (scale, (exploring, steady))) in
            rows.zip(step.log_probs.iter_mut()).zip(noises)
        {
            let mut squares = 0.0;
            for (((action, mean), std), steady) in actions.iter_mut().zip(means).zip(std).zip(steady) {
                let drawn: f32 = if *exploring == 1.0 { StandardNormal.sample(noise) } else { *steady };
                *action = mean + scale * std * drawn;
                squares += ((*action - mean) / (scale * std)).powi(2);
            }
            // The density lacks the scale, here and in the losses: it is the same in both, and only their ratio counts.
            *log_prob = -0.5 * squares - constant;
        }
        Ok(())
    }

    /// Scales the rewards of a step and, for each environment whose future was cut off, adds the discounted value of its final
    /// observation, so that the advantages need one array of ends only. `cut_off` `[n]`, `final_observations` `[n, O]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn settle(
        &self,
        rewards: &mut [f32],
        cut_off: impl Iterator<Item = bool>,
        final_observations: &[f32],
        work: &mut Workspace,
    ) -> Result<()> {
        let size = final_observations.len() / rewards.len();
        for ((reward, cut_off), observation) in
            rewards.iter_mut().zip(cut_off).zip(final_observations.chunks_exact(size))
        {
            *reward *= self.reward_scale;
            if cut_off {
                let mut value = [0.0];
                self.policy.forward(observation, [None, Some(&mut value)], work)?;
                *reward += self.gamma * value[0];
            }
        }
        Ok(())
    }

    /// Writes the values of the observations after the last step.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn finish(&self, block: &mut RolloutBlock, work: &mut Workspace) -> Result<()> {
        let (observations, values) = block.after_last();
        self.policy.forward(observations, [None, Some(values)], work)
    }
}
