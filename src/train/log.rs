//! The row of the log that an iteration makes: each value with its name, from where it is known.

use crate::agent::Iteration;
use crate::env::{Lesson, Recent, Score};
use crate::ppo::UpdateStats;

/// The values of an iteration by name, always the same names in the same order: of the episodes that ended in it, of all its steps,
/// of what was trained, of its evaluation (a score of no episodes where there was none), and of what was learnt.
pub fn row(iteration: &Iteration<Lesson>, ended: &Score, recent: &Recent, evaluation: &Score) -> Vec<(String, f64)> {
    let mut row = Vec::new();
    let mut put = |group: &str, values: &[(&str, f64)]| {
        row.extend(values.iter().map(|(name, value)| (format!("{group}/{name}"), *value)));
    };
    let per_step = |(name, sum): (&'static str, f64)| (name, sum / recent.steps as f64);
    let Score { length, goals, in_tolerance, drop_rate, rot_dist, steps_per_goal, .. } = *ended;
    put("episode", &[("return", ended.episode_return), ("length", length), ("goals", goals)]);
    put("episode", &[("in_tolerance", in_tolerance), ("drop_rate", drop_rate), ("rot_dist", rot_dist)]);
    put("episode", &[("steps_per_goal", steps_per_goal)]);
    put("reward", &recent.reward.named().map(per_step));
    put("training", &recent.shaping.named().map(per_step));
    put("training", &iteration.lesson.named());
    let Score { goals, drop_rate, rot_dist, episode_return, .. } = *evaluation;
    put("eval", &[("goals", goals), ("drop_rate", drop_rate), ("rot_dist", rot_dist), ("return", episode_return)]);
    let UpdateStats { entropy, kl, first_kl, clip_fraction, std, excess, .. } = iteration.update;
    let UpdateStats { policy_loss, value_loss, explained_variance, learning_rate, grad_norm, .. } = iteration.update;
    put("loss", &[("policy", policy_loss), ("value", value_loss)]);
    put("policy", &[("entropy", entropy), ("kl", kl), ("first_kl", first_kl), ("clip_fraction", clip_fraction)]);
    put("policy", &[("std", std), ("excess", excess)]);
    put("value", &[("explained_variance", explained_variance)]);
    put("optim", &[("learning_rate", learning_rate), ("grad_norm", grad_norm)]);
    put("time", &[("collect_s", iteration.collect_s), ("update_s", iteration.update_s)]);
    put("time", &[("steps_per_s", iteration.steps_per_s())]);
    put("sim", &[("diverged", recent.diverged as f64)]);
    row
}

/// The names of the values of any iteration.
pub fn tags(lesson: Lesson) -> Vec<String> {
    let iteration = Iteration { lesson, update: UpdateStats::default(), steps: 0, collect_s: 0.0, update_s: 0.0 };
    let empty = row(&iteration, &Score::of(&[]), &Recent::default(), &Score::of(&[]));
    empty.into_iter().map(|(name, _)| name).collect()
}
