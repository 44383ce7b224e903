//! An update: advantages, then epochs of gradient steps on minibatches, then the normaliser.

use std::f64::consts::{E, TAU};
use std::ops::Add;
use std::sync::atomic::AtomicBool;

use anyhow::{Context, Result, ensure};
use rayon::prelude::*;

use super::Ppo;
use super::adam::{Adam, norm, sum_of_squares};
use super::backend::Losses;
use super::gae::gae;
use super::learning_rate;
use super::parameters::View;
use super::rollout::{Rollout, RolloutBlock};
use crate::os::expect_no_stop;
use crate::ranks::tree_sum;
use crate::rng;

/// The position of a gradient step among the steps that move the policy. The learning rate follows how far they have moved it.
pub enum Stage {
    /// Before all of them: only the critic learns.
    CriticAlone,
    /// The first step of an update: the policy is still unchanged since it acted.
    First,
    /// Any other.
    Later,
}

/// Statistics of an update: means over its minibatches unless stated otherwise.
#[derive(Clone, Debug, Default)]
pub struct UpdateStats {
    /// The losses.
    pub losses: Losses,
    /// The losses of the first minibatch alone, before any gradient step: KL divergence and ratio error are zero up to rounding.
    pub first: Losses,
    /// Entropy of the action distribution at noise scale 1, nats.
    pub entropy: f64,
    /// Norm of the whole gradient, before clipping.
    pub grad_norm: f64,
    /// Standard deviation at noise scale 1, after the update.
    pub std: f64,
    /// 1 - Var(returns - values) / Var(returns), with the values predicted during collection.
    pub explained_variance: f64,
    /// The learning rate after the update.
    pub learning_rate: f64,
}

impl UpdateStats {
    /// The logged statistics, each with its group and name.
    pub fn named(&self) -> [(&'static str, f64); 11] {
        [
            ("loss/policy", -self.losses.surrogate),
            ("loss/value", self.losses.value_error),
            ("policy/entropy", self.entropy),
            ("policy/kl", self.losses.kl),
            ("policy/first_kl", self.first.kl),
            ("policy/clip_fraction", self.losses.clipped),
            ("policy/std", self.std),
            ("policy/excess", self.losses.excess),
            ("value/explained_variance", self.explained_variance),
            ("optim/learning_rate", self.learning_rate),
            ("optim/grad_norm", self.grad_norm),
        ]
    }
}

impl Ppo {
    /// Learns from a rollout that this policy collected, then adds its observations to the normaliser. The normaliser
    /// does not change during collection and learning, so the first minibatch sees exactly the policy that acted.
    ///
    /// # Errors
    /// Fails if a loss, gradient or weight is not finite. The policy must then not be used or saved. Fails as interrupted if `stop`
    /// was set in the meantime. The learner must then be restored before it is used again.
    pub fn update(
        &mut self,
        rollout: &mut Rollout,
        iteration: u64,
        stop: &AtomicBool,
    ) -> Result<UpdateStats> {
        // Runs on a worker thread: each of the many short parallel sections would put an outside thread to sleep and
        // wake it.
        rayon::scope(|_| {
            let explained_variance = self.prepare(rollout);
            self.backend.begin(&self.policy, rollout);
            if iteration == self.actor_from && self.config.critic_first > 0 {
                // The bias of its moments is corrected by the number of steps, which must be the same for both nets.
                self.adam = Adam::new(self.policy.layout.count());
            }
            let samples = rollout.samples();
            let size = self
                .config
                .minibatch_of(self.exchange.of_all(samples), rollout.horizon);
            let own = self.exchange.own_shards();
            let shuffles = own
                .map(|shard| rng::stream(self.seed, "shuffle", iteration << 32 | shard as u64))
                .collect();
            let mut minibatches = self.exchange.epochs(samples, size, shuffles);
            let mut steps = Vec::new();
            for epoch in 0..self.config.epochs {
                for (part, samples) in minibatches().iter().enumerate() {
                    expect_no_stop(stop)?;
                    let stage = if self.is_critic_alone(iteration) {
                        Stage::CriticAlone
                    } else if steps.is_empty() {
                        Stage::First
                    } else {
                        Stage::Later
                    };
                    let step = self.minibatch_step(rollout, samples, stage);
                    steps.push(step.with_context(|| format!("epoch {epoch}, minibatch {part}"))?);
                }
            }
            for View { name, range, .. } in self.policy.layout.views() {
                ensure!(
                    self.policy.parameters[range].iter().all(|x| x.is_finite()),
                    "the update made `{name}` infinite or NaN: the training run has failed and stops here"
                );
            }
            // The normaliser is part of the policy, which does not change while the critic learns alone.
            if !self.is_critic_alone(iteration) {
                let seen: Vec<_> = rollout.blocks.iter().map(RolloutBlock::acted_on).collect();
                self.policy.see(&seen, &self.exchange);
            }
            Ok(self.stats(&steps, explained_variance))
        })
    }

    /// Computes the returns and advantages, and normalises the advantages to mean 0 and standard deviation 1. The result is the
    /// explained variance.
    pub fn prepare(&self, rollout: &mut Rollout) -> f64 {
        let [gamma, lambda] = [self.config.gamma, self.config.lambda].map(|factor| factor as f32);
        rollout
            .blocks
            .par_iter_mut()
            .for_each(|block| gae(block, gamma, lambda));
        let (_, spread) = self.mean_and_variance(rollout, |block| &block.returns);
        let (mean, residual) = self.mean_and_variance(rollout, |block| &block.advantages);
        let scale = 1.0 / (residual.sqrt() + 1e-8);
        for x in rollout
            .blocks
            .iter_mut()
            .flat_map(|block| &mut block.advantages)
        {
            *x = ((f64::from(*x) - mean) * scale) as f32;
        }
        if spread > 0.0 {
            1.0 - residual / spread
        } else {
            f64::NAN
        }
    }

    /// The mean and variance of one array over all samples of the update.
    fn mean_and_variance(&self, rollout: &Rollout, of: fn(&RolloutBlock) -> &[f32]) -> (f64, f64) {
        let sum = |term: &(dyn Fn(f64) -> f64 + Sync)| {
            self.exchange.sum(
                &rollout.blocks,
                |blocks| {
                    let values = blocks.iter().flat_map(of);
                    values.map(|&x| term(f64::from(x))).sum()
                },
                f64::add,
            )
        };
        let count = self.exchange.of_all(rollout.samples()) as f64;
        let mean = sum(&|x| x) / count;
        (mean, sum(&|x| (x - mean).powi(2)) / count)
    }

    /// Takes one gradient step on the minibatch of these samples of this rank. The results are the mean losses and the norm of the gradient before clipping.
    ///
    /// # Errors
    /// Fails if one of them is not finite. Nothing has moved then.
    pub fn minibatch_step(
        &mut self,
        rollout: &Rollout,
        samples: &[u32],
        stage: Stage,
    ) -> Result<(Losses, f64)> {
        let nets = self.policy.layout.nets();
        let groups = self.exchange.groups(samples);
        let count = self.exchange.of_all(samples.len());
        let sums = self.backend.gradients(
            &self.policy,
            &self.config,
            rollout,
            &groups,
            count,
            &mut self.of_groups,
        )?;
        let squares = self.slices.reduce_scatter(
            &mut self.gradient,
            |parameters, out| match stage {
                Stage::CriticAlone if parameters.start < nets[0].end => out.fill(0.0),
                _ => tree_sum(out, &self.of_groups, parameters),
            },
            sum_of_squares,
        );
        let grad_norm = norm(&squares, &nets);
        let losses = self.losses(&sums, count);
        for (what, value) in [
            ("the loss", losses.total(&self.config)),
            ("the norm of the gradient", grad_norm),
        ] {
            ensure!(
                value.is_finite(),
                "{what} is {value}: the training run has failed and stops here"
            );
        }
        if let Stage::Later = stage {
            self.learning_rate = learning_rate::adapted(
                self.learning_rate,
                losses.kl,
                self.config.desired_kl.at(self.env_steps),
                self.config.learning_rate_range,
            );
        }
        // As in PyTorch's clip_grad_norm_, including the constant that prevents a division by zero.
        let scale = (self.config.max_grad_norm / (grad_norm + 1e-6)).min(1.0);
        let mut own = self.slices.own.clone();
        if let Stage::CriticAlone = stage {
            own = own.start.max(nets[1].start).min(own.end)..own.end;
        }
        let parameters = &mut self.policy.parameters;
        self.adam
            .step(parameters, &self.gradient, own, (self.learning_rate, scale));
        self.slices.all_gather(parameters);
        Ok((losses, grad_norm))
    }

    /// The mean losses of a minibatch of `count` samples, given the sums of each group on this rank.
    pub fn losses(&self, sums: &[Losses], count: usize) -> Losses {
        let own = sums
            .chunks(sums.len() / self.exchange.own_shards().len())
            .map(|groups| groups.iter().copied().reduce(Losses::add).expect("a group"))
            .collect();
        self.exchange.in_order(own, Losses::add).means(count)
    }

    /// The statistics of an update with these steps: the mean losses and the norm of the gradient of each.
    fn stats(&self, steps: &[(Losses, f64)], explained_variance: f64) -> UpdateStats {
        let mean = |sum: f64| sum / steps.len() as f64;
        let losses = steps
            .iter()
            .map(|(losses, _)| *losses)
            .reduce(Losses::add)
            .expect("a step")
            .means(steps.len());
        // The entropy of the Gaussian at noise scale 1.
        let of_action = f64::from(self.policy.log_std[0]) + 0.5 * (TAU * E).ln();
        UpdateStats {
            losses,
            first: steps[0].0,
            entropy: of_action * self.policy.spaces.action_size as f64,
            grad_norm: mean(steps.iter().map(|(_, norm)| norm).sum()),
            std: f64::from(self.policy.std()),
            explained_variance,
            learning_rate: self.learning_rate,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::ranks::Exchange;
    use crate::spaces::Spaces;

    const SPACES: Spaces = Spaces {
        observation_size: 3,
        action_size: 2,
        object_and_goal: None,
        distance: |_, _| 0.0,
    };

    #[test]
    fn the_entropy_is_the_one_of_a_gaussian_with_this_standard_deviation() {
        let config = Config::default().ppo;
        let ppo = Ppo::new(&config, SPACES, 0, Exchange::alone(1)).unwrap();
        // With a standard deviation of 0.6: ln 0.6 + ln(2πe) / 2 = 0.908 113 for each of the two actions.
        let entropy = ppo.stats(&[(Losses::default(), 0.0)], 0.0).entropy;
        assert!((entropy - 2.0 * 0.908_113).abs() < 1e-5, "{entropy}");
    }
}
