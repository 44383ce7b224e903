//! Whether a hand can learn at all: what actions of zero and random actions do in it, before anything is trained.

use std::sync::Arc;

use rand_distr::{Distribution, Normal};
use rayon::prelude::*;

use crate::config::EnvConfig;
use crate::env::{End, Env};
use crate::quat;
use crate::repose::{Repose, Task};
use crate::rng;
use crate::statistics::mean;

/// The number of episodes, and their steps. In the first ones the object settles.
const EPISODES: u64 = 16;
const STEPS: usize = 400;
const SETTLING: usize = 60;

/// The standard deviation of random actions. An untrained policy has the same by default.
const STD: f32 = 0.6;

/// The distance from the object within which a fingertip reaches it, m. The origin of a fingertip lies behind its surface.
const NEAR: f64 = 0.02;

/// A property of a hand: what it is called, the number of decimals with which it is shown, the value of the built-in hand in the default
/// task, the limits between which hands have learnt, and what to do where it is not good.
type Row = (&'static str, usize, f64, [f64; 2], &'static str);

/// The properties, in the order in which [`found`] returns their values.
const ROWS: [Row; 5] = [
    (
        "zero actions hold it, of 16 episodes",
        0,
        15.0,
        [14.0, f64::INFINITY],
        "start it where the hand holds it with its servos in the middle of their ranges, with the palm up",
    ),
    (
        "tilt of what it rests on, degrees",
        0,
        10.0,
        [0.0, 40.0],
        "turn the hand so that the palm faces up",
    ),
    (
        "fingertips that reach it",
        0,
        5.0,
        [2.0, f64::INFINITY],
        "put it nearer to the fingers",
    ),
    (
        "random actions turn it, rad in 100 steps",
        2,
        3.73,
        [0.3, f64::INFINITY],
        "the section on mobility of docs/HANDS.md says how to raise it",
    ),
    (
        "random actions drop it, of 16 episodes",
        0,
        3.0,
        [0.0, 12.0],
        "lower its start, or let the fingers close around it",
    ),
];

/// What an episode has shown.
#[derive(Default)]
struct Played {
    dropped: bool,
    steps: f64,
    /// rad
    turned: f64,
    /// Between a floor and what carries the object at the end, rad, if it rests on something.
    tilt: Option<f64>,
    /// Whether each fingertip came near.
    near: Vec<bool>,
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
        let values = found(&task.at_the_stage_of(default));
        let object = format!("`{}`", task.hand.parts.object);
        let mut table = format!("{object:<44}   found  built-in hand  verdict\n");
        let mut warnings = Vec::new();
        for ((what, decimals, of_builtin, [least, most], advice), value) in
            ROWS.into_iter().zip(values)
        {
            let mut found = format!("{value:.decimals$}");
            let verdict = if value.is_nan() {
                // It rests on nothing, or is held by nothing.
                found = "-".to_owned();
                "-"
            } else if (least..=most).contains(&value) {
                "good"
            } else {
                warnings.push(format!("{object}: {what}: {found}; {advice}"));
                advice
            };
            table += &format!("{what:<44}{found:>8}  {of_builtin:>13.decimals$}  {verdict}\n");
        }
        Self { table, warnings }
    }
}

/// The values of [`ROWS`].
fn found(task: &Arc<Task>) -> [f64; 5] {
    let [still, random] = [0.0, STD].map(|std| -> Vec<Played> {
        let episodes = (0..EPISODES).into_par_iter();
        episodes.map(|episode| play(task, episode, std)).collect()
    });
    let drops = |played: &[Played]| played.iter().filter(|one| one.dropped).count() as f64;
    let tilts = Vec::from_iter(still.iter().filter_map(|one| one.tilt));
    let tips = 0..task.hand.fingertips.len();
    let reached = tips.filter(|&tip| random.iter().any(|one| one.near[tip]));
    let [turned, steps] = [|one: &Played| one.turned, |one: &Played| one.steps]
        .map(|value| random.iter().map(value).sum::<f64>());
    [
        EPISODES as f64 - drops(&still),
        mean(&tilts).to_degrees(),
        reached.count() as f64,
        100.0 * turned / steps,
        drops(&random),
    ]
}

/// Plays an episode with normal actions of this standard deviation.
fn play(task: &Arc<Task>, episode: u64, std: f32) -> Played {
    let mut env = Repose::new(task);
    let spaces = task.spaces();
    let mut observation = vec![0.0; spaces.observation_size];
    let mut action = vec![0.0; spaces.action_size];
    let mut rng = rng::stream(0, "mobility", episode);
    let normal = Normal::new(0.0, std).expect("a standard deviation");
    env.reset(rng::stream(0, "mobility of", episode), &mut observation);
    let tips = &task.hand.fingertips;
    let mut played = Played {
        near: vec![false; tips.len()],
        ..Played::default()
    };
    let reach = task.scene.radius(task.hand.object.body) + NEAR;
    for step in 0..STEPS {
        let before = env.object().orientation;
        action.fill_with(|| normal.sample(&mut rng));
        let end = env.step(&action, &mut observation).end;
        let object = env.object();
        if step >= SETTLING {
            played.turned += quat::angle_between(object.orientation, before);
            played.steps += 1.0;
        }
        for (near, &tip) in played.near.iter_mut().zip(tips) {
            let tip = env.sim.pose(tip).position;
            let apart = [0, 1, 2].map(|axis| tip[axis] - object.position[axis]);
            *near |= quat::length(&apart) < reach;
        }
        if end == Some(End::Terminated) {
            played.dropped = true;
            return played;
        }
    }
    played.tilt = env.sim.tilt(task.hand.object.body);
    played
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
        for (what, _, of_builtin, ..) in ROWS {
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
        ] {
            let found = check(set);
            assert!(
                found.warnings.concat().contains(advice),
                "{set}: {}",
                found.table
            );
        }
    }

    #[test]
    fn the_tilt_is_known_whatever_the_timestep_the_friction_and_the_length_of_an_episode() {
        for set in [
            "env.sim_dt=0.005",
            "env.friction_scale=0.9",
            "env.ctrl_dt=0.05",
        ] {
            let table = check(set).table;
            let row = table.lines().find(|line| line.starts_with("tilt"));
            let found = row.unwrap().split_whitespace().nth_back(2).unwrap();
            let degrees: f64 = found.parse().unwrap();
            assert!((5.0..16.0).contains(&degrees), "{set}: {table}");
        }
    }
}
