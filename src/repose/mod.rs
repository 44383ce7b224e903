//! The task: a Shadow Hand turns a cube in its palm to one goal orientation after another.

mod conditions;
mod environment;
mod episode;
mod hand;
mod lesson;
mod observation;
mod randomization;
mod reward;
mod sensing;
mod servos;
mod tail;
mod task;

pub use environment::{Diverged, Repose, StepDetails};
pub use episode::{EpisodeStats, Recent, Score, divergence};
pub use hand::{ACTION_SIZE, ACTUATORS, FINGERTIPS, Hand, JOINTS};
pub use lesson::{Lesson, Shaping};
pub use observation::{Group, OBSERVATION, OBSERVATION_SIZE, SPACES};
pub use randomization::{Draw, Randomization};
pub use reward::RewardTerms;
pub use tail::Tail;
pub use task::Task;
