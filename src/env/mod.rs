//! Environments: what an agent acts in, and many of them stepped at once.
//!
//! Knows physics, not learning: actions come in and observations go out as `f32` slices.

mod episode;
mod hand;
mod lesson;
mod observation;
mod pool;
mod repose;
mod reward;
mod state;
mod tail;
mod task;

pub use episode::{EpisodeStats, Recent, Score, divergence};
pub use hand::{ACTION_SIZE, ACTUATORS, FINGERTIPS, Hand, JOINTS};
pub use lesson::{Lesson, Shaping};
pub use observation::{OBSERVATION, OBSERVATION_SIZE, Part, SPACES};
pub use pool::{EnvBlock, EnvPool, StepBuffers, stepping};
pub use repose::{Diverged, Repose, StepDetails};
pub use reward::RewardTerms;
pub use state::{EnvState, SavedEnv};
pub use tail::Tail;
pub use task::Task;

use anyhow::Result;

use crate::rng::Rng;
use crate::spaces::Spaces;

/// Why what can be earned ends here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// There is no future: nothing can be earned after this step.
    Terminated,
    /// Only time is up: the value of the final observation stands for what would have come.
    Truncated,
    /// The episode goes on, but under another goal: the value of the observation under the old one stands for what would have
    /// come.
    Redirected,
}

/// What one step earned and whether it was a last one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// Reward, before any scaling.
    pub reward: f32,
    /// Set on the last step of an episode, or under a goal.
    pub end: Option<End>,
}

/// One environment with continuous actions.
pub trait Env: Send {
    /// What is known about a finished episode.
    type Episode: Send;

    /// What is trained at some moment of a run, if that changes.
    type Lesson: Copy + Send;

    /// Its observations and actions, as a learner must know them.
    const SPACES: Spaces;

    /// Trains this lesson from now on.
    fn set_lesson(&mut self, lesson: Self::Lesson);

    /// Starts an episode whose randomness is all drawn from `rng`, and writes the first observation.
    fn reset(&mut self, rng: Rng, observation: &mut [f32]);

    /// Makes the episode just started end early, as if `share` (in [0, 1)) of its greatest length had passed.
    fn skip_ahead(&mut self, share: f64);

    /// Takes one step and writes the observation after it, also where it ends the episode.
    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition;

    /// Goes on under another goal after a step that ended with [`End::Redirected`], and writes the observation that shows it.
    fn redirect(&mut self, observation: &mut [f32]);

    /// The episode so far.
    fn episode(&self) -> Self::Episode;
}

/// An environment that can be saved in the middle of an episode.
pub trait Resumable: Env {
    /// Adds to `state` all that its future depends on, always as many numbers and counters.
    fn save(&self, state: &mut EnvState);

    /// Takes what it has saved from the front of `state`, and writes the observation to act on next; the future is then bit
    /// for bit that of the environment that saved it.
    ///
    /// # Errors
    /// Numbers that it cannot have saved.
    fn restore(&mut self, state: &mut SavedEnv, observation: &mut [f32]) -> Result<()>;
}
