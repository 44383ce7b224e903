//! How far random actions turn the object: a hand that hardly moves it learns slowly.

use std::sync::Arc;

use rand_distr::{Distribution, Normal};
use rayon::prelude::*;

use crate::config::EnvConfig;
use crate::env::Env;
use crate::quat;
use crate::repose::{Repose, Task};
use crate::rng;

/// The number of episodes, and their steps. In the first ones the object settles.
const EPISODES: u64 = 16;
const STEPS: usize = 400;
const SETTLING: usize = 60;

/// The standard deviation of the actions. An untrained policy has the same by default.
const STD: f32 = 0.6;

/// The mobility of the built-in hand in the default task, rad in 100 steps.
const OF_BUILTIN: f64 = 3.6;

/// A sentence about the mobility of a task's hand, in the first stage of the `default` task.
pub fn mobility(task: &Arc<Task>, default: &EnvConfig) -> String {
    let task = &task.at_the_stage_of(default);
    let played = (0..EPISODES)
        .into_par_iter()
        .map(|episode| play(task, episode));
    let (turned, steps, drops) =
        played.reduce(|| (0.0, 0, 0), |a, b| (a.0 + b.0, a.1 + b.1, a.2 + b.2));
    let rate = 100.0 * turned / f64::from(steps.max(1));
    format!(
        "random actions turn `{}` by {rate:.2} rad in 100 steps (the built-in hand: {OF_BUILTIN}), and drop it in {drops} of \
         {EPISODES} episodes; docs/HANDS.md says how to raise the turning rate",
        task.hand.parts.object
    )
}

/// How far the object turned, in how many steps, and whether it was dropped.
fn play(task: &Arc<Task>, episode: u64) -> (f64, u32, u32) {
    let mut env = Repose::new(task);
    let spaces = task.spaces();
    let mut observation = vec![0.0; spaces.observation_size];
    let mut action = vec![0.0; spaces.action_size];
    let mut rng = rng::stream(0, "mobility", episode);
    let normal = Normal::new(0.0, STD).expect("a standard deviation");
    env.reset(rng::stream(0, "mobility of", episode), &mut observation);
    let mut turned = 0.0;
    let mut steps = 0;
    for step in 0..STEPS {
        let before = env.object().orientation;
        action.fill_with(|| normal.sample(&mut rng));
        let end = env.step(&action, &mut observation).end;
        if step >= SETTLING {
            turned += quat::angle_between(env.object().orientation, before);
            steps += 1;
        }
        if end.is_some() {
            return (turned, steps, u32::from(env.episode().dropped));
        }
    }
    (turned, steps, 0)
}
