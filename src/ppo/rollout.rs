//! The steps of one iteration: allocated once, written row by row, read once.
//!
//! It lies in memory as the environments are stepped, block by block, so that each block is written by one thread at a time
//! and needs nothing of the others.

use std::ops::Range;

use crate::spaces::Spaces;

/// T steps of N environments; O numbers in an observation, A in an action.
pub struct Rollout {
    /// In the order of the environments.
    pub blocks: Vec<RolloutBlock>,
    /// Of each sample, block after block, the block that holds it.
    block_of: Vec<u32>,
    /// Of each block its first sample.
    firsts: Vec<u32>,
}

/// T steps of the n environments of a block; all arrays are time-major.
pub struct RolloutBlock {
    /// `[T + 1, n, O]`, raw: as the environments write them
    pub observations: Vec<f32>,
    /// `[T, n, A]`
    pub actions: Vec<f32>,
    /// `[T, n, A]`, of the distribution that the actions were drawn from
    pub means: Vec<f32>,
    /// `[T, n]`, of the actions
    pub log_probs: Vec<f32>,
    /// `[T, n]`, times the standard deviations of the policy are those of the actions
    pub noise_scales: Vec<f32>,
    /// `[T + 1, n]`
    pub values: Vec<f32>,
    /// `[T, n]`, scaled, and bootstrapped where the future was cut off
    pub rewards: Vec<f32>,
    /// `[T, n]`
    pub dones: Vec<bool>,
    /// `[T, n]`, set by the update
    pub advantages: Vec<f32>,
    /// `[T, n]`, set by the update
    pub returns: Vec<f32>,
    sizes: [usize; 4],
}

impl Rollout {
    /// An empty rollout of `horizon` steps of blocks of so many environments.
    pub fn new(horizon: usize, block_sizes: &[usize], spaces: &Spaces) -> Self {
        let block = |&envs: &usize| RolloutBlock::new([horizon, envs, spaces.observation_size, spaces.action_size]);
        let blocks: Vec<RolloutBlock> = block_sizes.iter().map(block).collect();
        let (mut block_of, mut firsts) = (Vec::new(), Vec::new());
        for (i, block) in blocks.iter().enumerate() {
            firsts.push(block_of.len() as u32);
            block_of.resize(block_of.len() + block.samples(), i as u32);
        }
        Self { blocks, block_of, firsts }
    }

    /// The number of steps T.
    pub fn horizon(&self) -> usize {
        self.blocks[0].sizes[0]
    }

    /// Samples in it: T × N.
    pub fn samples(&self) -> usize {
        self.block_of.len()
    }

    /// The block that holds a sample, and the sample's row in the block's arrays.
    pub fn locate(&self, sample: u32) -> (&RolloutBlock, usize) {
        let block = self.block_of[sample as usize] as usize;
        (&self.blocks[block], (sample - self.firsts[block]) as usize)
    }

    /// Makes the observations after the last step those of the next iteration's first.
    pub fn carry_over(&mut self) {
        self.blocks.iter_mut().for_each(RolloutBlock::carry_over);
    }

    /// The observations `[n, O]` of each block that the first step acts on.
    pub fn first_observations_mut(&mut self) -> Vec<&mut [f32]> {
        self.blocks.iter_mut().map(RolloutBlock::first_observations_mut).collect()
    }
}

impl RolloutBlock {
    fn new(sizes @ [horizon, envs, observation_size, action_size]: [usize; 4]) -> Self {
        let steps = horizon * envs;
        Self {
            observations: vec![0.0; (steps + envs) * observation_size],
            actions: vec![0.0; steps * action_size],
            means: vec![0.0; steps * action_size],
            log_probs: vec![0.0; steps],
            noise_scales: vec![1.0; steps],
            values: vec![0.0; steps + envs],
            rewards: vec![0.0; steps],
            dones: vec![false; steps],
            advantages: vec![0.0; steps],
            returns: vec![0.0; steps],
            sizes,
        }
    }

    /// Samples in it: T × n.
    pub fn samples(&self) -> usize {
        self.rewards.len()
    }

    /// The observations `[T, n, O]` that were acted on.
    pub fn acted_on(&self) -> &[f32] {
        let [_, _, size, _] = self.sizes;
        &self.observations[..self.samples() * size]
    }

    /// The row of a sample in an array `[T, n, width]`.
    pub fn row(width: usize, sample: usize) -> Range<usize> {
        sample * width..(sample + 1) * width
    }

    /// The observations `[n, O]` that the first step acts on.
    pub fn first_observations_mut(&mut self) -> &mut [f32] {
        let [_, envs, size, _] = self.sizes;
        &mut self.observations[..envs * size]
    }

    /// Where row `t` lies in an array `[T, n, width]`.
    pub fn step(&self, t: usize, width: usize) -> Range<usize> {
        let size = self.sizes[1] * width;
        t * size..(t + 1) * size
    }

    fn carry_over(&mut self) {
        let [horizon, envs, size, _] = self.sizes;
        self.observations.copy_within(horizon * envs * size.., 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_the_last_step_is_what_the_next_iteration_starts_from() {
        let mut block = RolloutBlock::new([2, 3, 4, 1]);
        let after_the_last = block.step(2, 4);
        block.observations[after_the_last].fill(7.0);
        assert!(block.first_observations_mut().iter().all(|&x| x == 0.0));
        block.carry_over();
        assert_eq!(block.first_observations_mut(), [7.0; 12]);
        assert_eq!(block.observations[block.step(0, 4)], [7.0; 12]);
    }

    #[test]
    fn every_sample_is_found_in_its_block() {
        let spaces = Spaces { observation_size: 4, action_size: 1, cube_and_goal: None, distance: |_| 0.0 };
        let rollout = Rollout::new(2, &[8, 8, 3], &spaces);
        assert_eq!(rollout.samples(), 38);
        let found = |sample| {
            let (block, row) = rollout.locate(sample);
            (rollout.blocks.iter().position(|other| std::ptr::eq(other, block)).unwrap(), row)
        };
        assert_eq!([0, 15, 16, 31, 32, 37].map(found), [(0, 0), (0, 15), (1, 0), (1, 15), (2, 0), (2, 5)]);
    }
}
