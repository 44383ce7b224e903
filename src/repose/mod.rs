//! The task: a Shadow Hand turns a cube in its palm to one goal orientation after another.

mod conditions;
mod divergence;
mod environment;
mod episode;
mod hand;
mod lesson;
mod mirror;
mod observation;
mod physics;
mod prediction;
mod randomization;
mod record;
mod reward;
mod score;
mod sensing;
mod servos;
mod task;

pub use divergence::{Diverged, Tail, divergence};
pub use environment::Repose;
pub use episode::{EpisodeStats, StepSums};
pub use hand::{ACTUATORS, FINGERTIPS, Hand, JOINTS};
pub use lesson::Lesson;
pub use observation::{Group, Layout};
pub use physics::{Physics, QUANTITIES, Quantity, add_settings, physical};
pub use randomization::{EpisodePhysics, Randomization};
pub use record::Record;
pub use reward::{
    Description, Step, TaskReward, TrainingReward, add, named, task_reward, task_terms,
    training_terms,
};
pub use score::{Better, HEADLINE, MEASURES, Measure, OF_EVALUATIONS, OF_TRAINING, Score, measure};
pub use task::Task;
