//! Measuring the speed of this machine: the physics alone, the environments around it, the learner, and whole iterations.

mod environments;
mod measure;
mod replay;

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use rand::RngExt;
use rand_distr::StandardNormal;
use serde_json::json;

use crate::agent::{Agent, step_block};
use crate::cli::{BenchArgs, Part};
use crate::config::{Config, Settings, expect_used};
use crate::env::EnvPool;
use crate::os;
use crate::ppo::{Rollout, flops_per_sample, matmul_gflops, time_gradient_steps};
use crate::ranks::Exchange;
use crate::repose::{Lesson, Randomization, Task};
use crate::rng::{self, Rng};
use crate::schedule::in_rounds;
use environments::environments;
use measure::{Found, NEVER, median};
use replay::{RecordingEnv, replay};

/// The number of rounds of measuring physics and pool.
const ROUNDS: usize = 5;

/// The minimum number of measured control steps in a round, over all environments.
const STEPS: usize = 32_768;

/// Control steps of each environment in a burst. Pool and physics take short bursts because the speed of a machine drifts within a
/// second.
const BURST: usize = 4;

/// The number of gradient steps and of matrix products that are measured.
const REPEATS: usize = 11;

/// The time after which no further whole iteration is started, s.
const END_TO_END_S: f64 = 8.0;

/// The maximum number of whole iterations after the first one.
const END_TO_END_ITERATIONS: usize = 4;

/// Runs the benchmark and prints the results.
///
/// # Errors
/// Fails if a setting or the scene cannot be used.
pub fn bench(args: &BenchArgs) -> Result<()> {
    expect_used(&args.settings.set, "bench")?;
    let mut config = Settings::new()
        .user_file(args.settings.config.as_deref())?
        .sets(&args.settings.set)
        .resolve()?;
    config.run.threads = args.threads.unwrap_or(config.run.threads);
    os::start_threads(config.run.threads)?;
    let task = Task::new(&config)?;
    let record = task.record().with(config.ppo.symmetry);
    let task = task.for_policy(&record)?;
    config.env = task.config.clone();
    let threads = rayon::current_num_threads();
    let num_envs = config.env.num_envs;
    let hidden = &config.ppo.hidden;
    let mut figures = json!({ "threads": threads, "num_envs": num_envs, "hidden": hidden });
    let samples = config.samples_per_minibatch();
    let mut lines = format!(
        "{threads} thread{}, {num_envs} environments, nets {hidden:?}, minibatches of {samples}\n",
        if threads == 1 { "" } else { "s" }
    );
    let measures: [(Part, Measurement); 4] = [
        (Part::Physics, physics_and_pool),
        (Part::Learner, learner),
        (Part::Training, end_to_end),
        (Part::Environments, environments),
    ];
    for (_, measure) in measures
        .into_iter()
        .filter(|(part, _)| args.only.is_none_or(|only| only == *part))
    {
        let (found, text) = measure(&task, &config)?;
        found
            .into_iter()
            .for_each(|(key, value)| figures[key] = json!(value));
        lines += &text;
    }
    os::print(&if args.json {
        format!("{figures}\n")
    } else {
        lines
    })
}

/// The measurement of a part.
type Measurement = fn(&Arc<Task>, &Config) -> Result<Found>;

/// Environments that record their physics, and the random actions that they take.
struct Bursts {
    pool: EnvPool<RecordingEnv>,
    rollout: Rollout,
    noise: Rng,
    std: f32,
}

impl Bursts {
    fn new(task: &Arc<Task>, config: &Config) -> Result<Self> {
        let randomization = Randomization::new(task, &config.randomization)?;
        let envs = (0..config.env.num_envs)
            .map(|_| RecordingEnv::new(task, randomization.as_ref()))
            .collect();
        let mut pool = EnvPool::new(config.run.seed, envs, &Exchange::alone(1));
        let mut lesson = Lesson::task(&config.env);
        lesson.randomized = Lesson::at(0, config).randomized;
        pool.set_lesson(lesson);
        let mut rollout = Rollout::new(BURST, &pool.block_sizes(), &task.spaces());
        pool.reset(rollout.first_observations_mut());
        Ok(Self {
            pool,
            rollout,
            noise: rng::stream(config.run.seed, "bench", 0),
            std: config.ppo.std.at(0) as f32,
        })
    }

    /// Steps the environments through a burst, and tells the seconds that it took.
    fn step(&mut self) -> f64 {
        let Self {
            pool,
            rollout,
            noise,
            std,
        } = self;
        for action in rollout
            .blocks
            .iter_mut()
            .flat_map(|block| &mut block.actions)
        {
            *action = *std * noise.sample::<f32, _>(StandardNormal);
        }
        pool.envs_mut().for_each(RecordingEnv::begin);
        let start = Instant::now();
        let stepped = in_rounds(
            pool.blocks.iter_mut().zip(&mut rollout.blocks),
            BURST,
            |(envs, rollout), t| {
                step_block(envs, rollout, t).expect("environments do not panic");
            },
        );
        drop(stepped);
        start.elapsed().as_secs_f64()
    }
}

/// Measures the env steps per second of bare physics and of the pool, as medians of the rounds, and the median of their ratios.
fn physics_and_pool(task: &Arc<Task>, config: &Config) -> Result<Found> {
    let envs = config.env.num_envs;
    let mut bursts = Bursts::new(task, config)?;
    // Unmeasured steps first, so that most cubes lie in the hand. Many environments take fewer of them.
    for _ in 0..(2 * STEPS / envs).clamp(4, 64) / BURST {
        bursts.step();
    }
    let in_round = STEPS.div_ceil(envs * BURST);
    let mut rates: [Vec<f64>; 3] = Default::default();
    for _ in 0..ROUNDS {
        let mut pool_seconds = 0.0;
        let mut bare_seconds = 0.0;
        for _ in 0..in_round {
            pool_seconds += bursts.step();
            bare_seconds += replay(&mut bursts.pool)?;
        }
        let done = (in_round * BURST * envs) as f64;
        let found = [
            done / bare_seconds,
            done / pool_seconds,
            bare_seconds / pool_seconds,
        ];
        rates
            .iter_mut()
            .zip(found)
            .for_each(|(rates, rate)| rates.push(rate));
    }
    let [physics, pool, share] = rates.map(median);
    Ok((
        vec![
            ("physics_steps_per_s", physics),
            ("pool_steps_per_s", pool),
            ("pool_share", share),
        ],
        format!(
            "physics alone (mj_step)   {physics:>10.0} steps/s\n\
             environments              {pool:>10.0} steps/s   {:.1} % of the physics\n",
            100.0 * share
        ),
    ))
}

/// Measures the samples per second and GFLOP/s of gradient steps, and the GFLOP/s of their matrix products alone.
fn learner(task: &Arc<Task>, config: &Config) -> Result<Found> {
    let mut agent = Agent::for_task(task, config, Exchange::alone(config.shards()))?;
    agent.collect(&NEVER)?;
    let Agent { ppo, rollout, .. } = &mut agent;
    let size = config.samples_per_minibatch();
    time_gradient_steps(ppo, rollout, 2)?;
    let (seconds, waiting) = time_gradient_steps(ppo, rollout, REPEATS)?;
    let samples = size as f64 / median(seconds);
    let gflops = 1e-9 * flops_per_sample(&ppo.policy) * samples;
    let matmul = median(matmul_gflops(ppo, size, REPEATS));
    let lines = format!(
        "learner                   {samples:>10.0} samples/s {gflops:.1} GFLOP/s\n\
         its matrix products alone                      {matmul:.1} GFLOP/s\n\
         its threads wait          {:>10.1} % of the time\n",
        100.0 * waiting
    );
    let figures = vec![
        ("learner_samples_per_s", samples),
        ("learner_gflops", gflops),
        ("matmul_gflops", matmul),
        ("learner_waits", waiting),
    ];
    Ok((figures, lines))
}

/// Measures the env steps per second of whole iterations of a training run with these settings, without the first one if there are
/// more.
fn end_to_end(task: &Arc<Task>, config: &Config) -> Result<Found> {
    let mut agent = Agent::for_task(task, config, Exchange::alone(config.shards()))?;
    let begun = Instant::now();
    let mut rates = Vec::new();
    for _ in 0..=END_TO_END_ITERATIONS {
        rates.push(agent.iterate(&NEVER)?.steps_per_s());
        if begun.elapsed().as_secs_f64() > END_TO_END_S {
            break;
        }
    }
    let speed = median(if rates.len() > 1 {
        rates.split_off(1)
    } else {
        rates
    });
    let total = config.run.total_steps as f64;
    let hours = total / speed / 3600.0;
    let millions = total / 1e6;
    Ok((
        vec![
            ("end_to_end_steps_per_s", speed),
            ("default_training_hours", hours),
        ],
        format!(
            "end to end                {speed:>10.0} steps/s   {millions:.0} M steps take {hours:.1} h\n"
        ),
    ))
}
