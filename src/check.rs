//! Whether a hand can learn at all: what actions of zero and random actions do in it, before anything is trained.

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

/// The standard deviation of random actions. An untrained policy has the same by default.
const STD: f32 = 0.6;

/// The distance from the object within which a fingertip reaches it, m. The origin of a fingertip lies behind its surface.
const NEAR: f64 = 0.02;

/// A property of a hand.
struct Row {
    what: &'static str,
    /// The number of decimals with which it is shown.
    decimals: usize,
    /// The value of the built-in hand in the default task.
    of_builtin: f64,
    /// The limits between which hands have learnt.
    good: [f64; 2],
    /// What to do where it is not good.
    advice: &'static str,
    value: fn(&Found) -> f64,
}

const ROWS: [Row; 5] = [
    Row {
        what: "zero actions hold it, of 16 episodes",
        decimals: 0,
        of_builtin: 15.0,
        good: [14.0, f64::INFINITY],
        advice: "start it where the hand holds it with its servos in the middle of their ranges, with the palm up",
        value: |found| EPISODES as f64 - found.still.drops,
    },
    Row {
        what: "tilt of what it rests on, degrees",
        decimals: 0,
        of_builtin: 10.0,
        good: [0.0, 40.0],
        advice: "turn the hand so that the palm faces up",
        value: |found| found.still.tilt / found.still.episodes,
    },
    Row {
        what: "fingertips that reach it",
        decimals: 0,
        of_builtin: 5.0,
        good: [2.0, f64::INFINITY],
        advice: "put it nearer to the fingers",
        value: |found| found.random.near.iter().filter(|near| **near).count() as f64,
    },
    Row {
        what: "random actions turn it, rad in 100 steps",
        decimals: 2,
        of_builtin: 3.61,
        good: [0.3, f64::INFINITY],
        advice: "the section on mobility of docs/HANDS.md says how to raise it",
        value: |found| 100.0 * found.random.turned / found.random.steps.max(1.0),
    },
    Row {
        what: "random actions drop it, of 16 episodes",
        decimals: 0,
        of_builtin: 3.0,
        good: [0.0, 12.0],
        advice: "lower its start, or let the fingers close around it",
        value: |found| found.random.drops,
    },
];

/// What episodes with the same kind of actions have shown. Sums over episodes.
#[derive(Default)]
struct Sums {
    /// The number of episodes at whose end the object rests on something.
    episodes: f64,
    drops: f64,
    steps: f64,
    /// rad
    turned: f64,
    /// Degrees, between the vertical and what carries the object.
    tilt: f64,
    /// Whether a fingertip came near.
    near: Vec<bool>,
}

/// What was found in a hand.
struct Found {
    still: Sums,
    random: Sums,
}

/// What was found in the hand of a task: a table with a verdict in each row, and what to do where it is not good.
pub struct Check {
    /// The table.
    pub table: String,
    /// A sentence for each row that is not good.
    pub warnings: Vec<String>,
}

impl Check {
    /// Plays episodes in the first stage of the `default` task. It takes seconds.
    pub fn of(task: &Arc<Task>, default: &EnvConfig) -> Self {
        let task = &task.at_the_stage_of(default);
        let [still, random] = [0.0, STD].map(|std| {
            let episodes = (0..EPISODES).into_par_iter();
            let played = episodes.map(|episode| play(task, episode, std));
            played.reduce(Sums::default, Sums::plus)
        });
        let played = Found { still, random };
        let object = &task.hand.parts.object;
        let mut table = format!(
            "{:<44}{:>8}  built-in hand  verdict\n",
            format!("`{object}`"),
            "found"
        );
        let mut warnings = Vec::new();
        for Row {
            what,
            decimals,
            of_builtin,
            good: [least, most],
            advice,
            value,
        } in ROWS
        {
            let value = value(&played);
            let mut found = format!("{value:.decimals$}");
            let verdict = if value.is_nan() {
                // It rests on nothing.
                found = "-".to_owned();
                "-"
            } else if (least..=most).contains(&value) {
                "good"
            } else {
                warnings.push(format!("`{object}`: {what}: {found}; {advice}"));
                advice
            };
            table += &format!("{what:<44}{found:>8}  {of_builtin:>13.decimals$}  {verdict}\n");
        }
        Self { table, warnings }
    }
}

impl Sums {
    fn plus(mut self, other: Self) -> Self {
        self.episodes += other.episodes;
        self.drops += other.drops;
        self.steps += other.steps;
        self.turned += other.turned;
        self.tilt += other.tilt;
        self.near
            .resize(self.near.len().max(other.near.len()), false);
        let both = self.near.iter_mut().zip(other.near);
        both.for_each(|(near, other)| *near |= other);
        self
    }
}

/// Plays an episode with normal actions of this standard deviation.
fn play(task: &Arc<Task>, episode: u64, std: f32) -> Sums {
    let mut env = Repose::new(task);
    let spaces = task.spaces();
    let mut observation = vec![0.0; spaces.observation_size];
    let mut action = vec![0.0; spaces.action_size];
    let mut rng = rng::stream(0, "mobility", episode);
    let normal = Normal::new(0.0, std).expect("a standard deviation");
    env.reset(rng::stream(0, "mobility of", episode), &mut observation);
    let tips = &task.hand.fingertips;
    let mut sums = Sums {
        near: vec![false; tips.len()],
        ..Sums::default()
    };
    let reach = task.scene.radius(task.hand.object.body) + NEAR;
    for step in 0..STEPS {
        let before = env.object().orientation;
        action.fill_with(|| normal.sample(&mut rng));
        let end = env.step(&action, &mut observation).end;
        let object = env.object();
        if step >= SETTLING {
            sums.turned += quat::angle_between(object.orientation, before);
            sums.steps += 1.0;
        }
        for (near, &tip) in sums.near.iter_mut().zip(tips) {
            let tip = env.sim.pose(tip).position;
            let apart: f64 = (0..3)
                .map(|axis| (tip[axis] - object.position[axis]).powi(2))
                .sum();
            *near |= apart.sqrt() < reach;
        }
        if end.is_some() {
            sums.drops = f64::from(u8::from(env.episode().dropped));
            return sums;
        }
    }
    if let Some(tilt) = env.sim.tilt(task.hand.object.body) {
        sums.tilt = tilt.to_degrees();
        sums.episodes = 1.0;
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Settings};

    fn check(set: &str) -> Check {
        let sets = [set.parse().unwrap()];
        let config = Settings::new().sets(&sets).resolve().unwrap();
        Check::of(&Task::new(&config).unwrap(), &Config::default().env)
    }

    #[test]
    fn the_built_in_hand_is_good_and_one_that_cannot_learn_is_told_why() {
        let good = check("run.seed=1");
        assert_eq!(good.warnings, [""; 0]);
        for Row {
            what, of_builtin, ..
        } in ROWS
        {
            let row = good.table.lines().find(|line| line.starts_with(what));
            let mut words = row.unwrap()[what.len()..].split_whitespace();
            let found: f64 = words.next().unwrap().parse().unwrap();
            // The last bits of another platform lead to other episodes.
            assert!(
                (found - of_builtin).abs() < 0.2 * of_builtin + 1.0,
                "{what}: {found}"
            );
            assert_eq!(words.next_back(), Some("good"), "{what}");
        }
        for (set, advice) in [
            ("env.gravity=[0,0,19.62]", "with the palm up"),
            ("env.gravity=[0,0,9.81]", "lower its start"),
            ("env.gravity=[0,8,5]", "docs/HANDS.md"),
        ] {
            let found = check(set);
            assert!(
                found.warnings.concat().contains(advice),
                "{set}: {}",
                found.table
            );
        }
    }
}
