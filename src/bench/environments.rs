//! How many environments learn most in the same time: their measured speed, times what a step was found to bring.

use std::sync::Arc;

use anyhow::Result;

use super::measure::{Found, NEVER, median};
use crate::agent::Agent;
use crate::config::{Config, Settings, Source};
use crate::ranks::Exchange;
use crate::repose::Task;

/// The numbers of environments that are compared, the key of their speed in JSON, and how much a step brings compared with a step of
/// 1024 environments. The worth of a step comes from training runs of 15 M steps with the default settings (`docs/RECIPES.md`).
const COMPARED: [(usize, &str, f64); 3] = [
    (512, "steps_per_s_of_512", 0.56),
    (1024, "steps_per_s_of_1024", 1.0),
    (2048, "steps_per_s_of_2048", 0.74),
];

/// Whole iterations of each training run that are measured, in turn, after one that is not.
const ITERATIONS: usize = 2;

/// Measures training runs with different numbers of environments and tells which learns most in the same time. A number that the
/// settings do not allow is left out, for instance because a long `ppo.horizon` would give too many samples.
pub fn environments(task: &Arc<Task>, config: &Config) -> Result<Found> {
    let given = Source::new("the settings", config.to_text());
    // The training runs, each with the control steps per second of its iterations.
    let mut measured = Vec::new();
    for (envs, key, worth) in COMPARED {
        let number = format!("env.num_envs={envs}").parse().expect("a setting");
        let Ok(config) = Settings::new()
            .file(given.clone())
            .sets(&[number])
            .resolve()
        else {
            continue;
        };
        let agent = Agent::for_task(task, &config, Exchange::alone(config.shards()))?;
        measured.push((envs, key, worth, agent, Vec::new()));
    }
    for round in 0..=ITERATIONS {
        for (.., agent, rates) in &mut measured {
            let speed = agent.iterate(&NEVER)?.steps_per_s();
            rates.extend((round > 0).then_some(speed));
        }
    }
    let mut figures = Vec::new();
    let mut lines = String::new();
    let mut best = None;
    let mut most = 0.0;
    for (envs, key, worth, _, rates) in measured {
        let speed = median(rates);
        let learning = worth * speed;
        figures.push((key, speed));
        lines += &format!(
            "{envs:>5} environments        {speed:>10.0} steps/s   worth {learning:.0} steps/s with 1024\n"
        );
        if learning > most {
            most = learning;
            best = Some(envs);
        }
    }
    if let Some(envs) = best {
        lines += &format!("env.num_envs={envs} learns most in the same time on this machine\n");
        figures.push(("advised_num_envs", envs as f64));
    }
    Ok((figures, lines))
}
