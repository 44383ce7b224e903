//! Environments: what an agent acts in, and many of them stepped at once.
//!
//! Knows physics, not learning: actions come in and observations go out as `f32` slices.

mod episode;
mod hand;
mod pool;
mod repose;
mod reward;

pub use episode::{EpisodeStats, Score};
pub use hand::{ACTION_SIZE, Hand, OBSERVATION_SIZE};
pub use pool::{EnvBlock, EnvPool, StepBuffers};
pub use repose::{Recent, Repose, StepDetails, Task};
pub use reward::RewardTerms;

use crate::rng::Rng;

/// Why an episode is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// There is no future: nothing can be earned after this step.
    Terminated,
    /// Only time is up: the value of the final observation stands for what would have come.
    Truncated,
}

/// What one step earned and whether it was the last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// Reward, before any scaling.
    pub reward: f32,
    /// Set on the last step of an episode.
    pub end: Option<End>,
}

/// One environment with continuous actions.
pub trait Env: Send {
    /// What is known about a finished episode.
    type Episode: Send;

    /// Numbers in an observation.
    fn observation_size(&self) -> usize;

    /// Numbers in an action.
    fn action_size(&self) -> usize;

    /// Starts an episode whose randomness is all drawn from `rng`, and writes the first observation.
    fn reset(&mut self, rng: Rng, observation: &mut [f32]);

    /// Makes the episode just started end early, as if `share` (in [0, 1)) of its greatest length had passed.
    fn skip_ahead(&mut self, share: f64);

    /// Takes one step and writes the observation after it, also where it ends the episode.
    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition;

    /// The episode so far.
    fn episode(&self) -> Self::Episode;
}
