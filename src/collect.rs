//! Collecting a rollout: the policy acts and the environments step, block by block, on all threads.
//!
//! Each block of environments goes through its steps independently, with the policy that all share: no thread waits for the
//! others before the rollout is complete.

use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Result;

use crate::env::{End, Env, EnvBlock, EnvPool, StepBuffers};
use crate::ppo::{Acting, Ppo, Rollout, RolloutBlock, Workspace};
use crate::rng::Rng;
use crate::schedule::in_rounds;

/// Arrays that a collection needs besides the rollout, per block.
pub struct Scratch {
    blocks: Vec<BlockScratch>,
}

struct BlockScratch {
    ends: Vec<Option<End>>,
    final_observations: Vec<f32>,
    work: Workspace,
}

impl Scratch {
    /// Creates the arrays for the environments of `pool` and the policy of `ppo`.
    pub fn new<E: Env>(pool: &EnvPool<E>, ppo: &Ppo) -> Self {
        let block = |envs| BlockScratch {
            ends: vec![None; envs],
            final_observations: vec![0.0; envs * E::SPACES.observation_size],
            work: ppo.workspace(envs),
        };
        Self { blocks: pool.block_sizes().into_iter().map(block).collect() }
    }
}

/// A block that is collecting a rollout.
struct Collecting<'a, E: Env> {
    envs: &'a mut EnvBlock<E>,
    rollout: &'a mut RolloutBlock,
    scratch: &'a mut BlockScratch,
    noise: Rng,
    result: Result<()>,
}

/// Steps the pool through a whole rollout with the learner's actions. Returns false if `interrupted` was set meanwhile: the
/// blocks may then be at different steps, and the pool must be restored before it collects again.
///
/// # Errors
/// Fails with the environment's number if an environment panics.
pub fn collect<E: Env>(
    pool: &mut EnvPool<E>,
    ppo: &Ppo,
    rollout: &mut Rollout,
    iteration: u64,
    scratch: &mut Scratch,
    interrupted: &AtomicBool,
) -> Result<bool> {
    let (acting, horizon) = (ppo.acting(), rollout.horizon());
    let parts = pool.blocks_mut().iter_mut().zip(&mut rollout.blocks).zip(&mut scratch.blocks);
    let blocks = parts.map(|((envs, rollout), scratch)| {
        let noise = ppo.noise(iteration, envs.number());
        Collecting { envs, rollout, scratch, noise, result: Ok(()) }
    });
    let collected = in_rounds(blocks, horizon, |block, t| {
        if block.result.is_ok() && !interrupted.load(Ordering::Relaxed) {
            block.result = block.step(&acting, t, t + 1 == horizon);
        }
    });
    collected.into_iter().try_for_each(|block| block.result)?;
    Ok(!interrupted.load(Ordering::Relaxed))
}

impl<E: Env> Collecting<'_, E> {
    fn step(&mut self, acting: &Acting, t: usize, last: bool) -> Result<()> {
        let BlockScratch { ends, final_observations, work } = &mut *self.scratch;
        let rollout = &mut *self.rollout;
        acting.act(rollout, t, &mut self.noise, work);
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
