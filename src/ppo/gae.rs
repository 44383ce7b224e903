//! Generalised advantage estimation on plain slices.

/// The weights of later rewards and values.
#[derive(Clone, Copy, Debug)]
pub struct Discount {
    /// The factor on a reward for each step that it comes later.
    pub gamma: f32,
    /// The λ of GAE. At 1, later rewards count alone (unbiased, noisy); at 0, the next value replaces them.
    pub lambda: f32,
}

/// Computes advantages and returns of a rollout of T steps of N environments; all arrays are time-major.
///
/// Inputs: `rewards` `[T, N]`, to which the discounted value of the final observation is already added where an
/// episode, or the time under a goal, was cut off; `values` `[T + 1, N]`; `dones` `[T, N]`, set where the return ends
/// with this step, for whatever reason. Outputs: `advantages` and `returns` `[T, N]`.
///
/// J. Schulman et al., "High-dimensional continuous control using generalized advantage estimation" (2016), eq. 16.
pub fn gae(
    Discount { gamma, lambda }: Discount,
    rewards: &[f32],
    values: &[f32],
    dones: &[bool],
    advantages: &mut [f32],
    returns: &mut [f32],
) {
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
    use super::*;

    #[test]
    fn advantages_are_those_worked_out_by_hand() {
        // Two environments, three steps, γ = 0.5, λ = 0.5; the second environment ends with step 1.
        let rewards = [1.0, 1.0, 2.0, 2.0, 3.0, 3.0];
        let values = [4.0, 4.0, 8.0, 8.0, 2.0, 2.0, 6.0, 6.0];
        let dones = [false, false, false, true, false, false];
        let (mut advantages, mut returns) = ([0.0; 6], [0.0; 6]);
        gae(Discount { gamma: 0.5, lambda: 0.5 }, &rewards, &values, &dones, &mut advantages, &mut returns);
        // First:  δ2 = 3 + 3 - 2 = 4, δ1 = 2 + 1 - 8 = -5, δ0 = 1 + 4 - 4 = 1; A2 = 4, A1 = -5 + 4/4 = -4, A0 = 1 - 4/4 = 0
        // Second: δ2 = 4, δ1 = 2 - 8 = -6 (nothing after the end), δ0 = 1; A2 = 4, A1 = -6, A0 = 1 - 6/4 = -0.5
        assert_eq!(advantages, [0.0, -0.5, -4.0, -6.0, 4.0, 4.0]);
        assert_eq!(returns, [4.0, 3.5, 4.0, 2.0, 6.0, 6.0]);
    }

    #[test]
    fn with_lambda_one_the_returns_are_discounted_sums() {
        let (rewards, values, dones) = ([1.0, 2.0, 4.0], [0.3, 0.1, 0.7, 8.0], [false; 3]);
        let (mut advantages, mut returns) = ([0.0; 3], [0.0; 3]);
        gae(Discount { gamma: 0.5, lambda: 1.0 }, &rewards, &values, &dones, &mut advantages, &mut returns);
        // 1 + 2/2 + 4/4 + 8/8, 2 + 4/2 + 8/4, 4 + 8/2
        for (found, expected) in returns.iter().zip([4.0, 6.0, 8.0]) {
            assert!((found - expected).abs() < 1e-6, "{returns:?}");
        }
    }
}
