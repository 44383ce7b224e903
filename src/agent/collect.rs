//! Collecting a rollout: the policy acts and the environments step, block by block, on all threads.
//!
//! Each block of environments goes through its steps independently, with the policy that all share: no thread waits for the
//! others before the rollout is complete.

use anyhow::Result;

use crate::env::{End, Env, EnvBlock, EnvPool, StepBuffers};
use crate::ppo::{Acting, Ppo, RolloutBlock, Workspace};
use crate::rng::Rng;

/// Arrays that a block of environments needs besides the rollout.
pub(super) struct Scratch {
    ends: Vec<Option<End>>,
    final_observations: Vec<f32>,
    pub work: Workspace,
}

impl Scratch {
    /// Creates the arrays for each block of `pool` and the policy of `ppo`.
    pub(super) fn of_blocks<E: Env>(pool: &EnvPool<E>, ppo: &Ppo) -> Vec<Self> {
        let block = |envs| Self {
            ends: vec![None; envs],
            final_observations: vec![0.0; envs * E::SPACES.observation_size],
            work: ppo.workspace(envs),
        };
        pool.block_sizes().into_iter().map(block).collect()
    }
}

/// A block that is collecting a rollout.
pub(super) struct Collecting<'a, E: Env> {
    pub envs: &'a mut EnvBlock<E>,
    pub rollout: &'a mut RolloutBlock,
    pub scratch: &'a mut Scratch,
    pub noise: Rng,
    pub result: Result<()>,
}

impl<E: Env> Collecting<'_, E> {
    /// Steps the environments with the actions of step `t`, and values what was cut off; after the last step, values what comes next.
    ///
    /// # Errors
    /// Fails with the environment's number if an environment panics.
    pub(super) fn step(&mut self, acting: &Acting, t: usize, last: bool) -> Result<()> {
        let Scratch { ends, final_observations, work } = &mut *self.scratch;
        let rollout = &mut *self.rollout;
        let (row, actions) = (rollout.step(t, 1), rollout.step(t, E::SPACES.action_size));
        let next = rollout.step(t + 1, E::SPACES.observation_size);
        let (rewards, observations) = (&mut rollout.rewards[row.clone()], &mut rollout.observations[next]);
        let buffers = StepBuffers { rewards, ends, observations, final_observations };
        self.envs.step(&rollout.actions[actions], buffers)?;
        rollout.dones[row.clone()].iter_mut().zip(&*ends).for_each(|(done, end)| *done = end.is_some());
        let cut_off = ends.iter().map(|&end| matches!(end, Some(End::Truncated | End::Redirected)));
        acting.scale_and_bootstrap(&mut rollout.rewards[row], cut_off, final_observations, work);
        if last {
            acting.finish(rollout, t + 1, work);
        }
        Ok(())
    }
}
