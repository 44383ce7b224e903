//! Where the time of an iteration goes while a trained policy acts.
//!
//! A trained policy grasps the cube, so it makes other contacts than a new one, and the physics spends its time on contacts. So
//! a trained policy acts, whatever nets the settings define. Those nets are timed on the observations that it collects. The
//! environments' own time is computed by subtraction, so it contains the errors of all three measured times.

use std::time::Instant;

use anyhow::{Context, Result};

use super::measure::{NEVER, median};
use super::replay::{RecordingEnv, replay};
use crate::agent::Agent;
use crate::config::Config;
use crate::load::{self, PolicySource};
use crate::ppo::{Ppo, Rollout};
use crate::ranks::Exchange;
use crate::repose::{Lesson, Randomization, Task};
use crate::schedule::in_rounds;

/// The control steps before measuring: from the catch of the cube until most environments turn it.
const BEFORE: usize = 160;

/// The number of iterations that are measured.
const ROUNDS: usize = 9;

/// The parts of an iteration: the name of each for a reader, and its key in JSON.
pub(super) const PARTS: [(&str, &str); 4] = [
    ("physics (MuJoCo)", "iteration_physics_s"),
    ("observe, reward, reset", "iteration_environments_s"),
    ("policy acts", "iteration_policy_s"),
    ("learner", "iteration_learner_s"),
];

/// Returns the seconds of each of the [`PARTS`] of an iteration with these settings, as medians, while the policy of `origin`
/// acts. The time of the environments excludes their physics.
///
/// # Errors
/// Fails if there is no such policy, or if it does not fit the task.
pub(super) fn seconds_of_parts(config: &Config, origin: &PolicySource) -> Result<[f64; 4]> {
    let mut acting = config.ppo.clone();
    let (checkpoint, of_it) = origin.load_for_any_scene()?;
    let net = of_it.net;
    let task = &Task::new(&config.env, &config.hand)?.for_policy(&load::record(&checkpoint, &net)?)?;
    (acting.hidden, acting.activation, acting.symmetry) = (net.hidden, net.activation, net.symmetry);
    let randomization = Randomization::new(task, &config.randomization)?;
    let envs = (0..config.env.num_envs).map(|_| RecordingEnv::new(task, randomization.as_ref())).collect();
    // The lesson at the end of a training, without the torque of an assist, which is not recorded.
    let mut at_end = Lesson::at(config.run.total_steps, config);
    at_end.assist = 0.0;
    let exchange = || Exchange::alone(config.shards());
    let mut agent = Agent::new(envs, &acting, config.run.seed, exchange(), move |_| at_end)?;
    agent.ppo.begin_with(&checkpoint)?;
    let mut learner = Ppo::new(&config.ppo, task.spaces(), config.run.seed, exchange())?;
    let mut seen = learner.rollout(&agent.pool.block_sizes());
    learner.follow_ramps(0, &mut seen);
    let mut found: [Vec<f64>; 4] = Default::default();
    let before = BEFORE.div_ceil(config.ppo.first_horizon());
    for round in 0..before + ROUNDS {
        agent.pool.envs_mut().for_each(RecordingEnv::begin);
        let collecting = Instant::now();
        agent.collect(&NEVER)?.context("nothing stops it")?;
        let collect_s = collecting.elapsed().as_secs_f64();
        if round >= before {
            let physics_s = replay(&mut agent.pool)?;
            for (from, to) in agent.rollout.blocks.iter().zip(&mut seen.blocks) {
                to.observations.copy_from_slice(&from.observations);
                to.rewards.copy_from_slice(&from.rewards);
                to.dones.copy_from_slice(&from.dones);
            }
            let policy_s = act_again(&learner, &mut seen);
            let learning = Instant::now();
            learner.update(&mut seen, round as u64, &NEVER)?.context("nothing stops it")?;
            let learner_s = learning.elapsed().as_secs_f64();
            let acting_s = act_again(&agent.ppo, &mut seen);
            let parts = [physics_s, collect_s - physics_s - acting_s, policy_s, learner_s];
            found.iter_mut().zip(parts).for_each(|(found, part)| found.push(part));
        }
        agent.rollout.carry_over();
        agent.iteration += 1;
    }
    Ok(found.map(median))
}

/// Lets the policy of `ppo` act on the observations of a rollout, as it does while collecting, and returns the seconds.
fn act_again(ppo: &Ppo, rollout: &mut Rollout) -> f64 {
    let (acting, horizon) = (ppo.acting(), rollout.horizon());
    let blocks = rollout.blocks.iter_mut().enumerate().map(|(i, block)| {
        let work = ppo.workspace(block.samples() / horizon);
        (block, ppo.noise(0, i), work)
    });
    let blocks: Vec<_> = blocks.collect();
    let start = Instant::now();
    in_rounds(blocks, horizon, |(block, noise, work), t| {
        acting.act(block, t, noise, work);
        if t + 1 == horizon {
            acting.finish(block, t + 1, work);
        }
    });
    start.elapsed().as_secs_f64()
}
