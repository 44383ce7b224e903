//! The log row of an iteration. Each value is named by the type that owns it. This module adds the groups and the order.

use super::outcome::Outcome;
use crate::ppo::{Rollout, RolloutBlock};
use crate::ranks::Exchange;
use crate::repose::{EpisodeStats, OF_EVALUATIONS, OF_TRAINING, Score};
use crate::run::{self, Descriptions, Histogram, histogram};
use crate::tags::tag;

/// The scores of the episodes that ended in an iteration.
pub struct Ended {
    /// The score of the episodes of the task as it is.
    pub nominal: Score,
    /// The score of the randomised episodes, if the training run has such.
    pub randomized: Option<Score>,
}

impl Ended {
    /// Computes the scores of `episodes` with control steps of `ctrl_dt` seconds, in a training run with or without randomised ones.
    pub fn new(episodes: &[EpisodeStats], ctrl_dt: f64, randomizes: bool) -> Self {
        let (drawn, nominal): (Vec<_>, Vec<_>) = episodes
            .iter()
            .copied()
            .partition(|episode| episode.randomized);
        Self {
            nominal: Score::of(&nominal, ctrl_dt),
            randomized: randomizes.then(|| Score::of(&drawn, ctrl_dt)),
        }
    }

    /// The score to show: the score of the task as it is, if such episodes ended.
    pub fn shown(&self) -> &Score {
        self.randomized
            .as_ref()
            .filter(|_| self.nominal.episodes == 0)
            .unwrap_or(&self.nominal)
    }
}

/// The values of an iteration by name, always the same names in the same order. They cover the episodes that ended in
/// it, all its steps, the lesson and the evaluation (a score of no episodes if there was none). Then come the update and the
/// timings, with the traffic of the exchange.
pub fn row(outcome: &Outcome, ended: &Ended) -> Vec<(String, f64)> {
    let Outcome {
        iteration,
        steps,
        evaluation,
        traffic,
        ..
    } = outcome;
    let mut row = Vec::new();
    let mut put = |group: &str, values: &mut dyn Iterator<Item = (&'static str, f64)>| {
        row.extend(values.map(|(name, value)| (format!("{group}{name}"), value)));
    };
    put(
        "episode/",
        &mut ended.nominal.named(OF_TRAINING).into_iter(),
    );
    if let Some(randomized) = &ended.randomized {
        put(
            "randomized/",
            &mut randomized.named(OF_TRAINING).into_iter(),
        );
    }
    put("reward/", &mut steps.task_named());
    put("training/", &mut steps.training_named());
    put("training/", &mut iteration.lesson.named());
    put("eval/", &mut evaluation.named(OF_EVALUATIONS).into_iter());
    put("", &mut iteration.update.named().into_iter());
    put("time/", &mut iteration.time_named().into_iter());
    put("time/", &mut traffic.iter().copied());
    put(
        "sim/",
        &mut [("diverged", steps.diverged as f64)].into_iter(),
    );
    row
}

/// The names of the values of any iteration, in a training run with or without randomised episodes.
pub fn tags(randomizes: bool) -> Vec<String> {
    let traffic = Exchange::alone(1).take_traffic();
    let empty = row(
        &Outcome {
            traffic,
            ..Outcome::default()
        },
        &Ended::new(&[], 0.0, randomizes),
    );
    empty.into_iter().map(|(name, _)| name).collect()
}

// What is logged besides numbers and settings.
const ACTIONS: &str = "histogram/actions";
const ADVANTAGES: &str = "histogram/advantages";

/// The values with these names and all other things that are logged, with their descriptions.
pub fn described(names: &[String]) -> Descriptions {
    let all = names
        .iter()
        .map(String::as_str)
        .chain([ACTIONS, ADVANTAGES, run::SETTINGS]);
    all.map(|name| {
        (
            name.to_owned(),
            tag(name).map(|known| known.description).unwrap_or_default(),
        )
    })
    .collect()
}

/// The histograms of the rollout that was just learnt from.
pub fn histograms(rollout: &Rollout) -> Vec<(&'static str, Histogram)> {
    let all = |of: fn(&RolloutBlock) -> &[f32]| histogram(rollout.blocks.iter().flat_map(of));
    vec![
        (ACTIONS, all(|block| &block.actions)),
        (ADVANTAGES, all(|block| &block.advantages)),
    ]
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::agent::{Agent, Iteration};
    use crate::config::{Config, Settings};
    use crate::ppo::{Losses, UpdateStats};
    use crate::repose::{Lesson, StepSums, Task, TaskReward};

    #[test]
    fn everything_that_is_logged_is_described() {
        for (tag, description) in described(&tags(true)) {
            assert!(description.ends_with('.'), "{tag}: {description}");
        }
    }

    #[test]
    fn histograms_are_those_of_the_quantities_whose_names_they_have() {
        let sets = [
            "env.num_envs=8",
            "ppo.horizon=4",
            "ppo.hidden=[8]",
            "ppo.minibatches=2",
        ];
        let config = Settings::new()
            .sets(&sets.map(|set| set.parse().unwrap()))
            .resolve()
            .unwrap();
        let mut agent =
            Agent::for_task(&Task::new(&config).unwrap(), &config, Exchange::alone(1)).unwrap();
        agent.iterate(&AtomicBool::new(false)).unwrap();
        let found = histograms(&agent.rollout);
        let [(ACTIONS, actions), (ADVANTAGES, advantages)] = &found[..] else {
            panic!("{found:?}")
        };
        let count = |histogram: &Histogram| histogram.bucket.iter().sum::<f64>();
        assert_eq!([count(actions), count(advantages)], [32.0 * 20.0, 32.0]);
        assert!(actions.min < -0.5, "{found:?}");
        assert!(
            advantages.sum.abs() < 1e-3 && (advantages.sum_squares - 32.0).abs() < 1e-2,
            "{advantages:?}"
        );
    }

    /// The row of the test below between the scores of episodes and of the evaluation, and after them: every column with a value of
    /// its own.
    const BETWEEN: &str = "reward/rotation 20, reward/distance 21, reward/action 22, reward/bonus 23, reward/fall 24, \
        training/progress 25, training/approach 31, training/within 26, training/drop 27, training/turned 32, \
        training/tolerance 0.1, training/hold 50, training/task_reward 1, training/drop_reward 0, training/randomized 0, \
        training/act_moving_average 0.25, training/assist 0";
    const AFTER: &str = "loss/policy 1, loss/value 2, policy/entropy 4, policy/kl 5, policy/first_kl 6, \
        policy/clip_fraction 8, policy/std 10, policy/excess 3, value/explained_variance 11, optim/learning_rate 12, \
        optim/grad_norm 9, time/collect_s 13, time/update_s 17, time/steps_per_s 2, time/exchange_s 29, \
        time/exchange_bytes 30, sim/diverged 28";

    /// All logged values are different, so that swapped values are detected.
    #[test]
    fn each_value_of_a_row_stands_beside_its_own_name() {
        let lesson = Lesson::task(&Config::default().env);
        let update = UpdateStats {
            losses: Losses {
                surrogate: -1.0,
                value_error: 2.0,
                excess: 3.0,
                kl: 5.0,
                clipped: 8.0,
                ratio_error: 0.0,
            },
            first: Losses {
                kl: 6.0,
                ratio_error: 7.0,
                ..Losses::default()
            },
            entropy: 4.0,
            grad_norm: 9.0,
            std: 10.0,
            explained_variance: 11.0,
            learning_rate: 12.0,
        };
        let iteration = Iteration {
            lesson,
            update,
            steps: 60,
            collect_s: 13.0,
            update_s: 17.0,
        };
        let reward = [20.0, 21.0, 22.0, 23.0, 24.0];
        let training = [25.0, 31.0, 26.0, 27.0];
        let steps = StepSums {
            steps: 1,
            task: reward,
            training,
            turned: 0.32,
            diverged: 28,
            unpredicted: 0,
        };
        let episode = |reward, length, goals| EpisodeStats {
            length,
            goals,
            in_tolerance: length / 4,
            rot_dist_sum: 1.5 * f64::from(length),
            reward,
            dropped: length < 100,
            ..Default::default()
        };
        let other = EpisodeStats {
            randomized: true,
            ..episode(TaskReward::default(), 200, 8)
        };
        let ended = |randomizes| Ended::new(&[episode(reward, 80, 2), other], 0.01, randomizes);
        let whole = EpisodeStats {
            turned: 16.8,
            ..episode(TaskReward::default(), 1000, 5)
        };
        let evaluation = Score::of(
            &[
                whole,
                episode(TaskReward::default(), 200, 1),
                episode(reward, 50, 0),
            ],
            0.01,
        );
        let traffic = [("exchange_s", 29.0), ("exchange_bytes", 30.0)];
        let outcome = Outcome {
            iteration,
            steps,
            evaluation,
            traffic,
            ..Outcome::default()
        };
        let row = |ended: &Ended| {
            let row = row(&outcome, ended);
            row.iter()
                .map(|(name, value)| format!("{name} {value}"))
                .collect::<Vec<_>>()
                .join(", ")
        };
        let names = |row: &str| {
            row.split(", ")
                .map(|cell| cell.split_once(' ').unwrap().0.to_owned())
                .collect::<Vec<_>>()
        };
        let of = |group: &str, columns: &[&str], score: &Score| {
            columns
                .iter()
                .map(|column| format!("{group}/{column} {}", score[*column]))
                .collect::<Vec<_>>()
                .join(", ")
        };
        let nominal = ended(false);
        let episode_columns = of("episode", &OF_TRAINING, &nominal.nominal);
        let evaluated = of("eval", &OF_EVALUATIONS, &outcome.evaluation);
        let expected = [&episode_columns, BETWEEN, &evaluated, AFTER].join(", ");
        assert_eq!(row(&nominal), expected);
        assert_eq!(tags(false), names(&expected));
        // Randomised episodes are apart, in columns that only such a training run has.
        let both = ended(true);
        let apart = of("randomized", &OF_TRAINING, &both.randomized.unwrap());
        assert!(
            apart.starts_with("randomized/return 0, randomized/length 200, randomized/goals 8"),
            "{apart}"
        );
        let expected = [&episode_columns, &apart, BETWEEN, &evaluated, AFTER].join(", ");
        assert_eq!(row(&both), expected);
        assert_eq!(tags(true), names(&expected));
        let shown = [vec![other], vec![other, episode(reward, 80, 2)]]
            .map(|all| Ended::new(&all, 0.01, true).shown()["goals"]);
        assert_eq!(
            shown,
            [8.0, 2.0],
            "the task as it is, where such episodes ended"
        );
    }
}
