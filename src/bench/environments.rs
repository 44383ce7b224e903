//! How many environments learn most in the same time: their measured speed, times what a step was found to bring.

use std::sync::Arc;

use anyhow::{Context, Result};

use super::measure::{Found, NEVER, median};
use crate::agent::Agent;
use crate::config::Config;
use crate::ranks::Exchange;
use crate::repose::{Repose, Task};

/// The numbers of environments that are compared, the key of their speed in JSON, and how much a step brings compared with a step of
/// 1024 environments. The worth of a step comes from trainings of 15 M steps with the default settings (`docs/RECIPES.md`).
const COMPARED: [(usize, &str, f64); 3] =
    [(512, "steps_per_s_of_512", 0.56), (1024, "steps_per_s_of_1024", 1.0), (2048, "steps_per_s_of_2048", 0.74)];

/// Whole iterations of each training that are measured, in turn, after one that is not.
const ITERATIONS: usize = 2;

/// Measures trainings with different numbers of environments and tells which learns most in the same time. A number that the settings do
/// not allow is left out, for instance because a long `ppo.horizon` would give too many samples.
pub(super) fn environments(task: &Arc<Task>, config: &Config) -> Result<Found> {
    let mut trainings: Vec<(usize, &str, f64, Agent<Repose>)> = Vec::new();
    for (envs, key, share) in COMPARED {
        let number = format!("env.num_envs={envs}").parse().expect("a setting");
        let Ok(config) = config.changed(None, &[number]) else { continue };
        trainings.push((envs, key, share, Agent::for_task(task, &config, Exchange::alone(config.shards()))?));
    }
    let mut rates = vec![Vec::new(); trainings.len()];
    for round in 0..=ITERATIONS {
        for ((.., agent), rates) in trainings.iter_mut().zip(&mut rates) {
            let speed = agent.iterate(&NEVER)?.context("nothing stops it")?.steps_per_s();
            rates.extend((round > 0).then_some(speed));
        }
    }
    let speeds = rates.into_iter().map(median);
    let found: Vec<_> =
        trainings.iter().zip(speeds).map(|((envs, key, share, _), v)| (*envs, *key, *share, v)).collect();
    let line = |&(envs, _, share, speed): &(usize, _, f64, f64)| {
        format!("{envs:>5} environments        {speed:>10.0} steps/s   worth {:.0} steps/s with 1024\n", share * speed)
    };
    let mut lines: String = found.iter().map(line).collect();
    let best = found.iter().max_by(|a, b| (a.2 * a.3).total_cmp(&(b.2 * b.3)));
    let mut figures: Vec<(&'static str, f64)> = found.iter().map(|&(_, key, _, speed)| (key, speed)).collect();
    if let Some(&(envs, ..)) = best {
        lines += &format!("env.num_envs={envs} learns most in the same time on this machine\n");
        figures.push(("advised_num_envs", envs as f64));
    }
    Ok((figures, lines))
}
