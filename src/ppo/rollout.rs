//! The steps of one iteration: allocated once, written row by row, read once.

/// T steps of N environments, time-major; O numbers in an observation, A in an action.
pub struct Rollout {
    /// `[T + 1, N, O]`, raw
    pub observations: Vec<f32>,
    /// `[T, N, A]`
    pub actions: Vec<f32>,
    /// `[T, N, A]`, of the distribution that the actions were drawn from
    pub means: Vec<f32>,
    /// `[T, N]`, of the actions
    pub log_probs: Vec<f32>,
    /// `[T + 1, N]`
    pub values: Vec<f32>,
    /// `[T, N]`, scaled, and bootstrapped where truncated
    pub rewards: Vec<f32>,
    /// `[T, N]`
    pub dones: Vec<bool>,
    sizes: [usize; 4],
}

/// Row t of a rollout, and the observations that follow it.
pub struct RolloutStep<'a> {
    /// `[N, O]`
    pub observations: &'a [f32],
    /// `[N, O]`
    pub next_observations: &'a mut [f32],
    /// `[N, A]`
    pub actions: &'a mut [f32],
    /// `[N, A]`
    pub means: &'a mut [f32],
    /// `[N]`
    pub log_probs: &'a mut [f32],
    /// `[N]`
    pub values: &'a mut [f32],
    /// `[N]`
    pub rewards: &'a mut [f32],
    /// `[N]`
    pub dones: &'a mut [bool],
}

impl Rollout {
    /// An empty rollout of `horizon` steps of `envs` environments.
    pub fn new(horizon: usize, envs: usize, observation_size: usize, action_size: usize) -> Self {
        let steps = horizon * envs;
        Self {
            observations: vec![0.0; (steps + envs) * observation_size],
            actions: vec![0.0; steps * action_size],
            means: vec![0.0; steps * action_size],
            log_probs: vec![0.0; steps],
            values: vec![0.0; steps + envs],
            rewards: vec![0.0; steps],
            dones: vec![false; steps],
            sizes: [horizon, envs, observation_size, action_size],
        }
    }

    /// The number of steps T.
    pub fn horizon(&self) -> usize {
        self.sizes[0]
    }

    /// Samples in it: T × N.
    pub fn samples(&self) -> usize {
        self.rewards.len()
    }

    /// The observations `[N, O]` that the first step acts on.
    pub fn first_observations_mut(&mut self) -> &mut [f32] {
        let [_, envs, size, _] = self.sizes;
        &mut self.observations[..envs * size]
    }

    /// The observations `[N, O]` after the last step, and where their values `[N]` go.
    pub fn after_last(&mut self) -> (&[f32], &mut [f32]) {
        let [horizon, envs, size, _] = self.sizes;
        (&self.observations[horizon * envs * size..], &mut self.values[horizon * envs..])
    }

    /// Row `t`.
    pub fn step_mut(&mut self, t: usize) -> RolloutStep<'_> {
        let [_, n, o, a] = self.sizes;
        let (before, after) = self.observations.split_at_mut((t + 1) * n * o);
        RolloutStep {
            observations: &before[t * n * o..],
            next_observations: &mut after[..n * o],
            actions: &mut self.actions[t * n * a..][..n * a],
            means: &mut self.means[t * n * a..][..n * a],
            log_probs: &mut self.log_probs[t * n..][..n],
            values: &mut self.values[t * n..][..n],
            rewards: &mut self.rewards[t * n..][..n],
            dones: &mut self.dones[t * n..][..n],
        }
    }

    /// Makes the observations after the last step those of the next iteration's first.
    pub fn carry_over(&mut self) {
        let [horizon, envs, size, _] = self.sizes;
        self.observations.copy_within(horizon * envs * size.., 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_the_last_step_is_what_the_next_iteration_starts_from() {
        let mut rollout = Rollout::new(2, 3, 4, 1);
        rollout.step_mut(1).next_observations.fill(7.0);
        assert!(rollout.first_observations_mut().iter().all(|&x| x == 0.0));
        rollout.carry_over();
        assert_eq!(rollout.first_observations_mut(), [7.0; 12]);
        assert_eq!(rollout.step_mut(0).observations, [7.0; 12]);
    }
}
