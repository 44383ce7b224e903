//! The samples of one iteration: allocated once, written row by row, then read by the update.
//!
//! Memory is laid out in the blocks in which environments are stepped. So one thread at a time writes each block,
//! independently of the others.

use std::ops::Range;

use crate::spaces::Spaces;

/// T steps of N environments, with O values in an observation and A in an action.
pub struct Rollout {
    /// The number of steps T.
    pub horizon: usize,
    /// Blocks, in the order of the environments.
    pub blocks: Vec<RolloutBlock>,
    /// For each sample, in block order: the index of its block, and its row there.
    places: Vec<(u32, u32)>,
}

/// T steps of the n environments of a block. All arrays are time-major.
pub struct RolloutBlock {
    /// `[T + 1, n, O]`: raw, as the environments write them
    pub observations: Vec<f32>,
    /// `[T, n, A]`
    pub actions: Vec<f32>,
    /// `[T, n, A]`: means of the distributions that the actions were drawn from
    pub means: Vec<f32>,
    /// `[T, n]`: log-probabilities of the actions
    pub log_probs: Vec<f32>,
    /// `[T, n]`: factors on the policy's standard deviations
    pub noise_scales: Vec<f32>,
    /// `[T + 1, n]`
    pub values: Vec<f32>,
    /// `[T, n]`: scaled, and bootstrapped where the future was cut off
    pub rewards: Vec<f32>,
    /// `[T, n]`
    pub dones: Vec<bool>,
    /// `[T, n]`: set by the update
    pub advantages: Vec<f32>,
    /// `[T, n]`: set by the update
    pub returns: Vec<f32>,
    envs: usize,
    observation_size: usize,
}

impl Rollout {
    /// Creates an empty rollout of `horizon` steps for blocks with these numbers of environments.
    pub fn new(horizon: usize, block_sizes: &[usize], spaces: &Spaces) -> Self {
        let Spaces {
            observation_size,
            action_size,
            ..
        } = *spaces;
        let block = |&envs: &usize| {
            let steps = horizon * envs;
            RolloutBlock {
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
                envs,
                observation_size,
            }
        };
        let blocks: Vec<_> = block_sizes.iter().map(block).collect();
        let numbered = blocks.iter().enumerate();
        Self {
            horizon,
            places: numbered
                .flat_map(|(i, block)| (0..block.samples() as u32).map(move |row| (i as u32, row)))
                .collect(),
            blocks,
        }
    }

    /// The number of samples, T × N.
    pub fn samples(&self) -> usize {
        self.places.len()
    }

    /// The block that holds a sample, and the sample's row in the block's arrays.
    pub fn locate(&self, sample: u32) -> (&RolloutBlock, usize) {
        let (block, row) = self.places[sample as usize];
        (&self.blocks[block as usize], row as usize)
    }

    /// Changes it to `horizon` steps. It then begins with the same observations and is otherwise empty.
    pub fn resize(&mut self, horizon: usize, spaces: &Spaces) {
        let sizes: Vec<usize> = self.blocks.iter().map(|block| block.envs).collect();
        let mut resized = Self::new(horizon, &sizes, spaces);
        for (new, old) in resized
            .first_observations_mut()
            .zip(self.first_observations_mut())
        {
            new.copy_from_slice(old);
        }
        *self = resized;
    }

    /// Moves the observations after the last step to the first step, for the next iteration.
    pub fn carry_over(&mut self) {
        for block in &mut self.blocks {
            let last = block.samples() * block.observation_size;
            block.observations.copy_within(last.., 0);
        }
    }

    /// The observation `[O]` of each environment that the first step acts on.
    pub fn first_observations_mut(&mut self) -> impl Iterator<Item = &mut [f32]> {
        self.blocks.iter_mut().flat_map(|block| {
            let rows = block.observations.chunks_exact_mut(block.observation_size);
            rows.take(block.envs)
        })
    }
}

impl RolloutBlock {
    /// The number of samples, T × n.
    pub fn samples(&self) -> usize {
        self.rewards.len()
    }

    /// The observations `[T, n, O]` that were acted on.
    pub fn acted_on(&self) -> &[f32] {
        &self.observations[..self.samples() * self.observation_size]
    }

    /// The range of a sample in an array `[T, n, width]`.
    pub fn row(width: usize, sample: usize) -> Range<usize> {
        sample * width..(sample + 1) * width
    }

    /// The range of step `t` in an array `[T, n, width]`.
    pub fn step(&self, t: usize, width: usize) -> Range<usize> {
        let size = self.envs * width;
        t * size..(t + 1) * size
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPACES: Spaces = Spaces {
        observation_size: 4,
        action_size: 1,
        object_and_goal: None,
        distance: |_, _| 0.0,
    };

    #[test]
    fn what_follows_the_last_step_is_what_the_next_iteration_starts_from() {
        let mut rollout = Rollout::new(2, &[3], &SPACES);
        let after_the_last = rollout.blocks[0].step(2, 4);
        rollout.blocks[0].observations[after_the_last].fill(7.0);
        assert!(rollout.first_observations_mut().eq([[0.0; 4]; 3]));
        rollout.carry_over();
        assert!(rollout.first_observations_mut().eq([[7.0; 4]; 3]));
        let block = &rollout.blocks[0];
        assert_eq!(block.observations[block.step(0, 4)], [7.0; 12]);
    }

    #[test]
    fn every_sample_is_found_in_its_block() {
        let rollout = Rollout::new(2, &[8, 8, 3], &SPACES);
        assert_eq!(rollout.samples(), 38);
        let found = |sample| {
            let (block, row) = rollout.locate(sample);
            (
                rollout
                    .blocks
                    .iter()
                    .position(|other| std::ptr::eq(other, block))
                    .unwrap(),
                row,
            )
        };
        assert_eq!(
            [0, 15, 16, 31, 32, 37].map(found),
            [(0, 0), (0, 15), (1, 0), (1, 15), (2, 0), (2, 5)]
        );
    }
}
