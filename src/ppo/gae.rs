//! Generalised advantage estimation.

use super::rollout::RolloutBlock;

/// Computes advantages and returns of a block. Where an episode, or the time under a goal, was cut off, the reward already
/// includes the discounted value of the final observation. Its `dones` are set where the return ends with this step, for
/// whatever reason.
///
/// `gamma` is the factor on a reward for each step that it comes later. At a `lambda` of 1, later rewards count alone (unbiased,
/// noisy). At 0, the next value replaces them.
///
/// J. Schulman et al., "High-dimensional continuous control using generalized advantage estimation" (2016), eq. 16.
pub fn gae(block: &mut RolloutBlock, gamma: f32, lambda: f32) {
    let RolloutBlock {
        rewards,
        values,
        dones,
        advantages,
        returns,
        ..
    } = block;
    let envs = values.len() - rewards.len();
    for env in 0..envs {
        let mut advantage = 0.0;
        for i in (env..rewards.len()).step_by(envs).rev() {
            let live = if dones[i] { 0.0 } else { 1.0 };
            let delta = rewards[i] + gamma * live * values[i + envs] - values[i];
            advantage = delta + gamma * lambda * live * advantage;
            advantages[i] = advantage;
            returns[i] = advantage + values[i];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::rollout::Rollout;
    use super::*;
    use crate::spaces::Spaces;

    /// A block of three steps.
    fn block(rewards: &[f32], values: &[f32], dones: &[bool]) -> RolloutBlock {
        let spaces = Spaces {
            observation_size: 1,
            action_size: 1,
            object_and_goal: None,
            distance: |_, _| 0.0,
        };
        let mut block = Rollout::new(3, &[rewards.len() / 3], &spaces)
            .blocks
            .remove(0);
        block.rewards.copy_from_slice(rewards);
        block.values.copy_from_slice(values);
        block.dones.copy_from_slice(dones);
        block
    }

    #[test]
    fn advantages_are_those_worked_out_by_hand() {
        // Two environments, three steps, γ = 0.5, λ = 0.5. The second environment ends with step 1.
        let rewards = [1.0, 1.0, 2.0, 2.0, 3.0, 3.0];
        let values = [4.0, 4.0, 8.0, 8.0, 2.0, 2.0, 6.0, 6.0];
        let mut block = block(
            &rewards,
            &values,
            &[false, false, false, true, false, false],
        );
        gae(&mut block, 0.5, 0.5);
        // First:  δ2 = 3 + 3 - 2 = 4, δ1 = 2 + 1 - 8 = -5, δ0 = 1 + 4 - 4 = 1; A2 = 4, A1 = -5 + 4/4 = -4, A0 = 1 - 4/4 = 0
        // Second: δ2 = 4, δ1 = 2 - 8 = -6 (nothing after the end), δ0 = 1; A2 = 4, A1 = -6, A0 = 1 - 6/4 = -0.5
        assert_eq!(block.advantages, [0.0, -0.5, -4.0, -6.0, 4.0, 4.0]);
        assert_eq!(block.returns, [4.0, 3.5, 4.0, 2.0, 6.0, 6.0]);
    }

    #[test]
    fn with_lambda_one_the_returns_are_discounted_sums() {
        let mut block = block(&[1.0, 2.0, 4.0], &[0.3, 0.1, 0.7, 8.0], &[false; 3]);
        gae(&mut block, 0.5, 1.0);
        // 1 + 2/2 + 4/4 + 8/8, 2 + 4/2 + 8/4, 4 + 8/2
        for (found, expected) in block.returns.iter().zip([4.0, 6.0, 8.0]) {
            assert!((found - expected).abs() < 1e-6, "{:?}", block.returns);
        }
    }
}
