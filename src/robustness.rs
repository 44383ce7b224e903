//! The robustness of a policy: its score on hands and cubes that it was not trained for, as a table, JSON and a picture. One
//! change at a time affects the physics, what it observes, or when its actions take effect.

use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Result};
use serde_json::{Map, Value, json};

use crate::config::Override;
use crate::draw::{self, BarChart, Picture, PictureFile};
use crate::evaluate::{Actor, Episodes, Trial};
use crate::os::{self, Destination, Interrupted, Requests, number, say};
use crate::repose::{Score, Task, measure};
use crate::statistics::mean;

/// Single changes: the start of the name of a row, the setting, and its values.
const CHANGES: [(&str, &str, &[&str]); 9] = [
    ("friction", FRICTION, &["0.5", "0.7", "1.3"]),
    ("cube mass", MASS, &["0.5", "2.0"]),
    (
        "cube size",
        "env.cube_size_scale",
        &["0.8", "0.9", "1.1", "1.2"],
    ),
    ("gains", "env.gains_scale", &["0.75", "1.5"]),
    ("damping", "env.damping_scale", &["0.3", "3.0"]),
    ("delay", "env.action_delay", &["1", "2", "3"]),
    ("noise", "env.noise", &[NOISE, TWICE_THE_NOISE]),
    ("sim_dt", "env.sim_dt", &["0.005", "0.002"]),
    ("cone", "env.cone", &["\"elliptic\""]),
];

const FRICTION: &str = "env.friction_scale";
const MASS: &str = "env.cube_mass_scale";
const NOISE: &str = "{ joint_pos = 0.01, joint_vel = 0.02, cube_pos = 0.002, cube_quat = 0.02, fingertips = 0.002 }";
const TWICE_THE_NOISE: &str = "{ joint_pos = 0.02, joint_vel = 0.04, cube_pos = 0.004, cube_quat = 0.04, fingertips = 0.004 }";

/// The values of friction and mass that are combined.
const FRICTIONS: [&str; 4] = ["0.5", "0.7", "1.0", "1.3"];
const MASSES: [&str; 3] = ["0.5", "1.0", "2.0"];

/// A row of the table: what is changed.
#[derive(Clone)]
struct Condition {
    name: String,
    sets: Vec<Override>,
}

impl Condition {
    /// Whether it belongs to the grid of friction and mass.
    fn is_in_grid(&self) -> bool {
        self.sets.len() == 2
    }
}

/// A row of the table with its score.
struct Scored {
    condition: Condition,
    task: Arc<Task>,
    score: Score,
    /// The goals as a fraction of the goals without any change.
    kept: f64,
}

/// What comes out.
pub struct TableOutput {
    /// Whether the table is printed as JSON.
    pub json: bool,
    /// The picture of the table.
    pub picture: Option<Destination>,
}

/// Loads the task with changes.
pub type Loading<'a> = dyn Fn(&[Override]) -> Result<Arc<Task>> + 'a;

/// Plays the actor at `place` under each condition and prints the table. If interrupted, prints the rows so far.
///
/// # Errors
/// Fails if the task cannot be loaded without a change, if an episode panics, or if the picture cannot be written.
pub fn robustness(
    task: &Loading,
    actor: &Actor,
    place: &str,
    episodes: Episodes,
    report: &TableOutput,
    requests: &Requests,
) -> Result<ExitCode> {
    let output = report
        .picture
        .as_ref()
        .map(PictureFile::create)
        .transpose()?;
    let Episodes { seed, count, .. } = episodes;
    let rows = played(playable(task)?, actor, episodes, requests)?;
    let interrupted = requests.stop.load(std::sync::atomic::Ordering::Relaxed);
    let text = match report.json {
        true => format!("{}\n", as_json(&rows, count, seed, place)),
        false => table(&rows, count, seed, place),
    };
    os::print(&text)?;
    match output {
        Some(file) if interrupted => {
            say!("{}: interrupted, not written", file.output.path.display());
        }
        Some(file) => picture(&rows, count, place).write(file)?,
        None => {}
    }
    Ok(if interrupted {
        os::exit_code(requests.signal())
    } else {
        ExitCode::SUCCESS
    })
}

/// The conditions with their tasks. Leaves out a condition that the task cannot take, such as another size of an object with a mesh, and
/// says so. Thus problems are found before anything is played, which takes minutes.
fn playable(task: &Loading) -> Result<Vec<(Condition, Arc<Task>)>> {
    let mut playable = Vec::new();
    for condition in conditions() {
        match task(&condition.sets).with_context(|| format!("row `{}`", condition.name)) {
            Ok(task) => playable.push((condition, task)),
            Err(reason) if playable.is_empty() => return Err(reason),
            Err(reason) => say!("left out: {reason:#}"),
        }
    }
    Ok(playable)
}

/// Plays these conditions, and those with equal settings once. Returns the rows until an interruption.
fn played(
    playable: Vec<(Condition, Arc<Task>)>,
    actor: &Actor,
    episodes: Episodes,
    requests: &Requests,
) -> Result<Vec<Scored>> {
    let configs: Vec<_> = playable.iter().map(|(_, task)| &task.config).collect();
    let different = (0..configs.len())
        .filter(|&i| !configs[..i].contains(&configs[i]))
        .count();
    let bar = os::progress_bar(
        (different * episodes.count) as u64,
        "episodes",
        "robustness",
    );
    let mut rows: Vec<Scored> = Vec::new();
    for (condition, task) in playable {
        let known = rows
            .iter()
            .find(|row| row.task.config == task.config)
            .map(|row| row.score);
        bar.set_message(condition.name.clone());
        let played = match known {
            Some(known) => Ok(known),
            None => Trial {
                task: &task,
                actor,
                episodes,
                stop: &requests.stop,
            }
            .score(&bar, &mut |_| {}),
        };
        if played
            .as_ref()
            .is_err_and(|error| error.is::<Interrupted>())
        {
            break;
        }
        let score = played?;
        if let Some(warning) = score.divergence().filter(|_| known.is_none()) {
            say!("warning: {}: {warning}", condition.name);
        }
        let nominal = rows
            .first()
            .map_or(score["goals"], |nominal| nominal.score["goals"]);
        // Without any goals there is no fraction.
        let kept = if nominal > 0.0 {
            score["goals"] / nominal
        } else {
            f64::NAN
        };
        rows.push(Scored {
            condition,
            task,
            score,
            kept,
        });
    }
    Ok(rows)
}

/// All rows: the task itself, the single changes, and the grid.
fn conditions() -> Vec<Condition> {
    let mut conditions = vec![Condition {
        name: "nominal".into(),
        sets: Vec::new(),
    }];
    for (name, key, values) in CHANGES {
        for value in values {
            let name = match *value {
                NOISE => "noise".to_owned(),
                TWICE_THE_NOISE => "twice the noise".to_owned(),
                value => format!("{name} {}", value.trim_matches('"')),
            };
            conditions.push(Condition {
                name,
                sets: vec![Override::new(key, value)],
            });
        }
    }
    for friction in FRICTIONS {
        for mass in MASSES {
            conditions.push(Condition {
                name: format!("friction {friction}, cube mass {mass}"),
                sets: vec![Override::new(FRICTION, friction), Override::new(MASS, mass)],
            });
        }
    }
    conditions
}

/// The mean fraction of goals over the single changes, each counted as at most 1.
fn mean_kept(rows: &[Scored]) -> f64 {
    let kept = rows
        .iter()
        .skip(1)
        .filter(|row| !row.condition.is_in_grid() && row.task.config != rows[0].task.config)
        .map(|row| row.kept.clamp(0.0, 1.0));
    mean(&Vec::from_iter(kept))
}

fn as_json(rows: &[Scored], episodes: usize, seed: u64, checkpoint: &str) -> Value {
    let list = rows.iter().map(|row| {
        let value = |set: &Override| {
            let value: toml::Value = set.value.parse().expect("the values are TOML");
            (set.key.clone(), json!(value))
        };
        json!({
            "name": row.condition.name,
            "set": Map::from_iter(row.condition.sets.iter().map(value)),
            measure("goals").key: row.score["goals"],
            "goals_ci95": row.score.goals_ci95,
            measure("drop_rate").key: row.score["drop_rate"],
            "kept": row.kept,
        })
    });
    json!({
        "episodes": episodes, "seed": seed, "checkpoint": checkpoint, "rows": list.collect::<Value>(),
        "mean_kept": mean_kept(rows),
    })
}

fn table(rows: &[Scored], episodes: usize, seed: u64, checkpoint: &str) -> String {
    let mut text = format!("checkpoint {checkpoint}\n{episodes} episodes a row, seed {seed}\n\n");
    text += &format!(
        "{:<30} {:>5}  {:<15} {:>7} {:>6}\n",
        "", "goals", "95 % interval", "drops", "kept"
    );
    for Scored {
        condition,
        score,
        kept,
        ..
    } in rows
    {
        let [low, high] = score.goals_ci95.map(|goals| number(goals, 2));
        let drops = format!("{} %", measure("drop_rate").text(score["drop_rate"]));
        let goals = number(score["goals"], 2);
        let kept = number(*kept, 2);
        text += &format!(
            "{:<30} {goals:>5}  {:<15} {drops:>7} {kept:>6}\n",
            condition.name,
            format!("{low} … {high}")
        );
    }
    text + &format!(
        "\nmean kept over the single changes, each at most 1: {}\n",
        number(mean_kept(rows), 3)
    )
}

fn picture(rows: &[Scored], episodes: usize, checkpoint: &str) -> BarChart {
    let bars = rows
        .iter()
        .filter(|row| !row.condition.is_in_grid())
        .map(|row| {
            let nominal = rows[0].score["goals"];
            draw::NamedBar {
                name: row.condition.name.clone(),
                value: row.kept,
                interval: row.score.goals_ci95.map(|goals| goals / nominal),
                note: format!(
                    "{:.2} goals, {:.0} % drops",
                    row.score["goals"],
                    100.0 * row.score["drop_rate"]
                ),
            }
        });
    let grid: Vec<f64> = rows
        .iter()
        .filter(|row| row.condition.is_in_grid())
        .map(|row| row.kept)
        .collect();
    let of_mass = |mass| grid.iter().skip(mass).step_by(MASSES.len());
    let cells = (0..MASSES.len())
        .map(|mass| of_mass(mass).copied().collect())
        .collect();
    let named = |name: &str, values: &[&str]| {
        values
            .iter()
            .map(|value| format!("{name} {value}"))
            .collect()
    };
    BarChart {
        title: format!("Goals kept under a change: {checkpoint}, {episodes} episodes a row"),
        bars: bars.collect(),
        columns: named("friction", &FRICTIONS),
        rows: named("mass", &MASSES),
        cells,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Settings};
    use crate::repose::EpisodeStats;

    fn row(condition: Condition, goals: u32, kept: f64) -> Scored {
        let config = Settings::new().sets(&condition.sets).resolve().unwrap();
        let task = Task::new(&config).unwrap();
        let episode = EpisodeStats {
            length: 10,
            goals,
            ..Default::default()
        };
        Scored {
            condition,
            task,
            score: Score::of(&[episode, episode], 0.01),
            kept,
        }
    }

    #[test]
    fn the_rows_are_those_that_are_published_and_each_changes_the_task() {
        let conditions = conditions();
        let names: Vec<&str> = conditions[..22]
            .iter()
            .map(|condition| condition.name.as_str())
            .collect();
        let expected = "nominal, friction 0.5, friction 0.7, friction 1.3, cube mass 0.5, cube mass 2.0, cube size 0.8, \
                        cube size 0.9, cube size 1.1, cube size 1.2, gains 0.75, gains 1.5, damping 0.3, damping 3.0, \
                        delay 1, delay 2, delay 3, noise, twice the noise, sim_dt 0.005, sim_dt 0.002, cone elliptic";
        assert_eq!(names.join(", "), expected);
        assert_eq!(conditions.len(), 22 + 12);
        let nominal = Config::default();
        for condition in &conditions[1..22] {
            assert_ne!(
                Settings::new().sets(&condition.sets).resolve().unwrap(),
                nominal,
                "{}",
                condition.name
            );
        }
    }

    #[test]
    fn what_is_kept_is_averaged_over_the_single_changes_and_never_more_than_all() {
        let conditions = conditions();
        let kept = [1.0, 0.5, 1.2];
        let mut rows: Vec<Scored> = conditions[..3]
            .iter()
            .zip(kept)
            .map(|(of, kept)| row(of.clone(), 2, kept))
            .collect();
        rows.push(row(conditions[24].clone(), 2, 0.1));
        assert_eq!(mean_kept(&rows), 0.75);
        // The second row changes nothing about a task that has half the friction anyway.
        let friction = |kept| row(conditions[1].clone(), 2, kept);
        let mass = row(conditions[4].clone(), 2, 0.5);
        assert_eq!(mean_kept(&[friction(1.0), friction(1.0), mass]), 0.5);
        let of_nothing: Vec<Scored> = conditions[..3]
            .iter()
            .map(|of| row(of.clone(), 0, f64::NAN))
            .collect();
        assert!(
            mean_kept(&of_nothing).is_nan()
                && as_json(&of_nothing, 2, 3, "x")["mean_kept"].is_null()
        );
        let value = as_json(&rows, 2, 3, "x");
        assert_eq!(
            value["rows"][1]["set"],
            json!({ "env.friction_scale": 0.5 })
        );
        assert_eq!(value["rows"][2]["kept"], 1.2);
        let keys: Vec<&str> = value["rows"][0]
            .as_object()
            .unwrap()
            .keys()
            .map(String::as_str)
            .collect();
        assert_eq!(
            keys,
            [
                "name",
                "set",
                "goals_per_episode",
                "goals_ci95",
                "drop_rate",
                "kept"
            ]
        );
        assert!(
            table(&rows, 2, 3, "x")
                .lines()
                .any(|line| line.starts_with("friction 0.5") && line.ends_with("0.50"))
        );
    }
}
