//! Lets a policy play: in a window, as a film, or for its score: whole episodes, a table or one JSON object, and the trace of
//! the first episodes.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::{Context, Result, ensure};
use serde_json::{Map, Value, json};

use crate::cli::{Baseline, PlayArgs};
use crate::config::{Config, Override};
use crate::env::{RewardTerms, Score, Task};
use crate::evaluate::{Actor, Episodes, evaluate};
use crate::film::Film;
use crate::load::{self, Origin};
use crate::ppo::Policy;
use crate::run::{self, Requests};
use crate::scenery::task_to_see;
use crate::sim::Quality;
use crate::trace::Trace;
use crate::train::Outcome;
use crate::window::{self, Window};

/// Plays as asked: in a window, as a film, or without either; and prints the score of what is not played in a window.
///
/// # Errors
/// A checkpoint, setting or scene that cannot be used; a window that cannot be opened; a trace or film that cannot be written.
pub fn play(args: &PlayArgs) -> Result<Outcome> {
    let loaded = match args.policy {
        Some(_) => None,
        None => Some(Loaded::find(args.ckpt.as_deref(), &args.set)?),
    };
    let config = match &loaded {
        Some(loaded) => loaded.config.clone(),
        None => Config::resolve(None, of_the_task(&args.set)?)?,
    };
    run::start_threads(args.threads)?;
    if wants_window(args) && show(args, &config, loaded.as_ref())? {
        return Ok(Outcome::Finished);
    }
    let actor = match (&loaded, args.policy) {
        (Some(loaded), _) if args.stochastic => Actor::Stochastic(loaded.policy.freeze()?),
        (Some(loaded), _) => Actor::Mean(loaded.policy.freeze()?),
        (None, Some(Baseline::Random)) => Actor::Random,
        (None, _) => Actor::Zero,
    };
    let checkpoint = loaded.as_ref().map(|loaded| loaded.origin.to_string());
    // Opened before playing: a place that cannot be written to should not cost the score.
    let output = args.trace.as_deref().map(run::OutputFile::create).transpose()?;
    let mut requests = Requests::none();
    let mut trace = output.as_ref().map(|_| Trace::new(&config.env, checkpoint.as_deref()));
    let played = match &args.video {
        Some(path) => {
            requests = Requests::listen()?;
            film(path, &config, &actor, args, &requests, trace.as_mut())?
        }
        None => {
            let never = AtomicBool::new(false);
            score(&Task::new(&config.env)?, &actor, episodes(args, 256), &never, trace.as_mut())?
        }
    };
    let Some(score) = played else { return Ok(Outcome::Stopped(requests.exit_code())) };
    if let (Some(output), Some(trace)) = (output, trace) {
        output.finish(trace.finish().as_bytes())?;
    }
    if args.json {
        run::print(&format!("{}\n", json_score(&score, checkpoint.as_deref(), args.seed)));
        return Ok(Outcome::Finished);
    }
    let name = match &actor {
        Actor::Mean(_) => "policy",
        Actor::Stochastic(_) => "policy, stochastic",
        Actor::Random => "random actions",
        Actor::Zero | Actor::Wave => "zero actions",
    };
    if let Some(checkpoint) = &checkpoint {
        run::print(&format!("checkpoint {checkpoint}\n"));
    }
    let mut columns = vec![(name, score)];
    if loaded.is_some() && args.video.is_none() {
        let never = AtomicBool::new(false);
        let zero = self::score(&Task::new(&config.env)?, &Actor::Zero, episodes(args, 256), &never, None)?;
        columns.push(("zero actions", zero.context("nothing interrupts these episodes")?));
    }
    run::print(&table(&columns));
    Ok(Outcome::Finished)
}

fn wants_window(args: &PlayArgs) -> bool {
    let otherwise = args.headless || args.json || args.trace.is_some() || args.video.is_some();
    args.window || !otherwise && window::PRESENT && run::has_display()
}

/// Plays in a window; false if none can be opened and none was asked for by name.
fn show(args: &PlayArgs, config: &Config, loaded: Option<&Loaded>) -> Result<bool> {
    let task = task_to_see(&config.env, &args.shot, [1280, 720], Quality::High)?;
    let (names, actors, first) = match (loaded, args.policy) {
        (Some(loaded), _) => {
            let policy = &loaded.policy;
            let actors = vec![Actor::Mean(policy.freeze()?), Actor::Stochastic(policy.freeze()?)];
            (vec!["deterministic", "stochastic"], actors, usize::from(args.stochastic))
        }
        (None, policy) => {
            let first = usize::from(policy == Some(Baseline::Random));
            (vec!["zero", "random"], vec![Actor::Zero, Actor::Random], first)
        }
    };
    let window = match Window::open(&task, names, first) {
        Err(error) if !args.window => {
            run::say(&format!("note: {error:#}\n  Playing on as with --headless."));
            return Ok(false);
        }
        window => window?,
    };
    run::say(&window.play(&task, &actors, episodes(args, u64::MAX))?);
    Ok(true)
}

/// Plays the episodes one after the other and films them. Interrupted, it leaves the film of what was played.
fn film(
    path: &Path,
    config: &Config,
    actor: &Actor,
    args: &PlayArgs,
    requests: &Requests,
    mut trace: Option<&mut Trace>,
) -> Result<Option<Score>> {
    let task = task_to_see(&config.env, &args.shot, [640, 480], Quality::Fast)?;
    let all = episodes(args, 1);
    let mut film = Film::create(path, &task, args.fps, all.count as u64)?;
    let mut played = Vec::new();
    for first in all.first..all.first + all.count {
        let one = Episodes { first, count: 1, ..all };
        let result = evaluate(&task, actor, one, requests.stop(), &mut |moment| {
            if let Some(trace) = &mut trace {
                trace.record(&moment);
            }
            film.observe(&moment)
        });
        match result {
            Ok(Some(stats)) => played.extend(stats),
            Ok(None) => break,
            Err(error) => return Err(film.abandon().unwrap_or(error)),
        }
    }
    run::say(&format!("{}: {}", path.display(), film.finish()?));
    Ok((played.len() == all.count).then(|| Score::of(&played)))
}

/// The episodes that are asked for, or else so many.
fn episodes(args: &PlayArgs, otherwise: u64) -> Episodes {
    let count = args.episodes.unwrap_or(otherwise) as usize;
    Episodes { seed: args.seed, purpose: "score", first: 0, count }
}

/// A policy, with the configuration that it was trained with and `--set` on top.
struct Loaded {
    origin: Origin,
    config: Config,
    policy: Policy,
}

impl Loaded {
    fn find(place: Option<&Path>, overrides: &[Override]) -> Result<Self> {
        let overrides = of_the_task(overrides)?;
        let origin = match (place, run::newest_checkpoint()) {
            (Some(place), _) => Origin::of(place)?,
            (None, Some(newest)) => Origin::File(newest),
            (None, None) => {
                run::say("there is no run here: playing the policy that is built in");
                Origin::BuiltIn
            }
        };
        let (checkpoint, config) = origin.load(overrides)?;
        let policy = load::policy(&checkpoint, &config).with_context(|| format!("cannot play the policy {origin}"))?;
        Ok(Self { origin, config, policy })
    }
}

/// Refuses settings that are not of the task: they would change nothing, or the shape of the policy.
fn of_the_task(overrides: &[Override]) -> Result<&[Override]> {
    for set in overrides {
        let of_env = set.key.starts_with("env.");
        ensure!(of_env, "--set {}: only the task (env.*) can be changed for a policy that is played", set.key);
    }
    Ok(overrides)
}

/// The score of the episodes; none if interrupted.
fn score(
    task: &Arc<Task>,
    actor: &Actor,
    episodes: Episodes,
    interrupted: &AtomicBool,
    mut trace: Option<&mut Trace>,
) -> Result<Option<Score>> {
    let progress = run::Bar::new(episodes.count as u64, "episodes");
    let played = evaluate(task, actor, episodes, interrupted, &mut |moment| {
        if let Some(trace) = &mut trace {
            trace.record(&moment);
        }
        if moment.step.is_some_and(|(_, end)| end.is_some()) {
            progress.count();
        }
        Ok(())
    })?;
    Ok(played.map(|played| Score::of(&played)))
}

/// One object with everything that is known; what has no value is null.
fn json_score(score: &Score, checkpoint: Option<&str>, seed: u64) -> Value {
    let terms = RewardTerms::NAMES.iter().zip(score.reward.values());
    let reward: Map<String, Value> = terms.map(|(name, value)| ((*name).to_owned(), json!(value))).collect();
    json!({
        "episodes": score.episodes,
        "env_steps": score.env_steps,
        "goals_per_episode": score.goals,
        "goals_ci95": score.goals_ci95,
        "in_tolerance": score.in_tolerance,
        "rot_dist": score.rot_dist,
        "steps_per_goal": score.steps_per_goal,
        "drop_rate": score.drop_rate,
        "episode_length": score.length,
        "return": score.episode_return,
        "reward": reward,
        "diverged": score.diverged,
        "checkpoint": checkpoint,
        "seed": seed,
    })
}

/// A row for each figure, a column for each score.
fn table(columns: &[(&str, Score)]) -> String {
    let number = |value: f64, decimals: usize| match value.is_nan() {
        true => "-".to_owned(),
        false => format!("{value:.decimals$}"),
    };
    let interval = |[low, high]: [f64; 2]| format!("{} … {}", number(low, 3), number(high, 3));
    type Figure<'a> = Box<dyn Fn(&Score) -> String + 'a>;
    let mut rows: Vec<(String, Figure)> = vec![
        ("episodes".into(), Box::new(|s| s.episodes.to_string())),
        ("goals per episode".into(), Box::new(|s| number(s.goals, 3))),
        ("  95 % interval".into(), Box::new(|s| interval(s.goals_ci95))),
        ("steps in tolerance, %".into(), Box::new(|s| number(100.0 * s.in_tolerance, 2))),
        ("rotation error, rad".into(), Box::new(|s| number(s.rot_dist, 3))),
        ("steps per goal".into(), Box::new(|s| number(s.steps_per_goal, 0))),
        ("drop rate, %".into(), Box::new(|s| number(100.0 * s.drop_rate, 1))),
        ("episode length, steps".into(), Box::new(|s| number(s.length, 1))),
        ("return".into(), Box::new(|s| number(s.episode_return, 2))),
    ];
    for (i, term) in RewardTerms::NAMES.iter().enumerate() {
        rows.push((format!("  {term}"), Box::new(move |s| number(s.reward.values()[i], 2))));
    }
    rows.push(("diverged episodes".into(), Box::new(|s| s.diverged.to_string())));
    let mut text = format!("{:<24}", "");
    columns.iter().for_each(|(name, _)| text += &format!("{name:>20}"));
    for (label, figure) in rows {
        text += &format!("\n{label:<24}");
        columns.iter().for_each(|(_, score)| text += &format!("{:>20}", figure(score)));
    }
    text + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::EpisodeStats;

    #[test]
    fn the_json_of_a_score_has_the_documented_keys_and_null_for_what_is_not_known() {
        let value = json_score(&Score::of(&[EpisodeStats { length: 10, ..Default::default() }]), None, 3);
        let keys: Vec<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
        let expected = "episodes env_steps goals_per_episode goals_ci95 in_tolerance rot_dist steps_per_goal drop_rate \
                        episode_length return reward diverged checkpoint seed";
        assert_eq!(keys.join(" "), expected);
        assert!(value["steps_per_goal"].is_null() && value["checkpoint"].is_null());
        assert_eq!(value["reward"].as_object().unwrap().len(), 5);
        assert_eq!(value["seed"], 3);
    }

    #[test]
    fn the_table_has_a_column_for_each_score() {
        let score = Score::of(&[EpisodeStats { length: 10, goals: 2, ..Default::default() }]);
        let text = table(&[("policy", score), ("zero actions", score)]);
        let goals = text.lines().find(|line| line.starts_with("goals per episode")).unwrap();
        assert_eq!(goals.matches("2.000").count(), 2, "{text}");
    }

    #[test]
    fn only_the_task_can_be_changed_for_a_policy() {
        let set = |text: &str| [text.parse::<Override>().unwrap()];
        assert!(of_the_task(&set("env.sim_dt=0.002")).is_ok());
        assert!(of_the_task(&set("ppo.hidden=[3]")).is_err());
    }
}
