//! Environments that an agent acts in, and pools that step many of them at once. Nothing here depends on the hand.
//!
//! Actions come in and observations go out as `f32` slices.

mod pool;
mod state;

pub use pool::{Autoreset, EnvBlock, EnvPool, Member};
pub use state::{EnvState, SavedEnv};

use anyhow::Result;

use crate::rng::Rng;
use crate::spaces::Spaces;

/// The reason why a return ends at a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum End {
    /// There is no future: no reward follows this step.
    Terminated,
    /// Only the time is up: the value of the final observation replaces the future rewards.
    Truncated,
    /// The episode continues, but under another goal: the value of the observation under the old goal replaces the future
    /// rewards.
    Redirected,
}

/// The result of one step.
#[derive(Debug, PartialEq)]
pub struct Transition {
    /// Reward, before any scaling.
    pub reward: f32,
    /// Set on the last step of an episode or under a goal.
    pub end: Option<End>,
}

/// One environment with continuous actions.
pub trait Env: Send {
    /// The record of a finished episode.
    type Episode: Send;

    /// The variant of the task that is trained at a given step of a run.
    type Lesson: Copy + Send;

    /// The description of observations and actions that a learner needs.
    fn spaces(&self) -> Spaces;

    /// Switches to `lesson` from the next step on.
    fn set_lesson(&mut self, lesson: Self::Lesson);

    /// Starts an episode that draws all its randomness from `rng`, and writes the first observation.
    fn reset(&mut self, rng: Rng, observation: &mut [f32]);

    /// Makes the episode just started end early, as if the `fraction` (in [0, 1)) of its maximum length had passed.
    fn skip_ahead(&mut self, fraction: f64);

    /// Takes one step and writes the observation after it, even if the step ends the episode.
    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition;

    /// Continues under another goal after a step that ended with [`End::Redirected`], and writes the observation that shows it.
    fn redirect(&mut self, observation: &mut [f32]);

    /// The record of the episode so far.
    fn episode(&self) -> Self::Episode;
}

/// An environment that can be saved in the middle of an episode.
pub trait Resumable: Env {
    /// Appends to `state` everything that its future depends on, always the same number of values.
    fn save(&self, state: &mut EnvState);

    /// Reads from the front of `state` what [`Self::save`] wrote, and writes the observation to act on next. From then on it
    /// behaves bit for bit like the environment that was saved.
    ///
    /// # Errors
    /// Fails if these values cannot have been saved by such an environment.
    fn restore(&mut self, state: &mut SavedEnv, observation: &mut [f32]) -> Result<()>;
}
