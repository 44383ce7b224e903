//! Measuring the speed of this machine: the physics alone, the environments around it, the learner, whole iterations and their
//! parts.

mod iteration;
mod measure;
mod replay;

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result};
use rand_distr::{Distribution, StandardNormal};
use serde_json::json;

use crate::agent::Agent;
use crate::cli::{BenchArgs, Part, usage_error};
use crate::config::{Config, expect_used, user_file};
use crate::draw::{self, BarChart, HeatMap, NamedBar, Picture};
use crate::env::{End, Env, EnvPool, StepBuffers};
use crate::load::PolicySource;
use crate::os::{self, OutputFile};
use crate::ppo::{flops_per_sample, matmul_gflops, time_gradient_steps};
use crate::ranks::Exchange;
use crate::repose::{ACTION_SIZE, Lesson, OBSERVATION_SIZE, Randomization, Task};
use crate::rng;
use crate::schedule::in_rounds;
use iteration::{PARTS, seconds_of_parts};
use measure::{NEVER, median};
use replay::{BarePool, RecordingEnv};

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
    if args.only != Some(Part::Iteration) && (args.ckpt.is_some() || args.out.is_some()) {
        return Err(usage_error("bench", "--ckpt and --out apply only to --only iteration").into());
    }
    let output = args.out.as_deref().map(OutputFile::create).transpose()?;
    output.as_ref().map(draw::picture_format).transpose()?;
    let mut config = Config::resolve(user_file(args.settings.config.as_deref())?.as_ref(), &args.settings.set)?;
    config.run.threads = args.threads.unwrap_or(config.run.threads);
    os::start_threads(config.run.threads)?;
    let task = Task::new(&config.env)?;
    let asked = |part: Part| args.only.is_none_or(|only| only == part);
    let mut figures = Vec::new();
    let mut lines = format!(
        "{} threads, {} environments, nets {:?}, minibatches of {}\n",
        rayon::current_num_threads(),
        config.env.num_envs,
        config.ppo.hidden,
        config.samples_per_minibatch(),
    );
    if asked(Part::Physics) {
        let (physics, pool, share) = physics_and_pool(&task, &config)?;
        figures.extend([("physics_steps_per_s", physics), ("pool_steps_per_s", pool), ("pool_share", share)]);
        lines += &format!("physics alone (mj_step)   {physics:>10.0} steps/s\n");
        lines += &format!("environments              {pool:>10.0} steps/s   {:.1} % of the physics\n", 100.0 * share);
    }
    if asked(Part::Learner) {
        let (samples, gflops, matmul) = learner(&task, &config)?;
        figures.extend([("learner_samples_per_s", samples), ("learner_gflops", gflops), ("matmul_gflops", matmul)]);
        lines += &format!("learner                   {samples:>10.0} samples/s {gflops:.1} GFLOP/s\n");
        lines += &format!("its matrix products alone                      {matmul:.1} GFLOP/s\n");
    }
    if asked(Part::Training) {
        let end_to_end = end_to_end(&task, &config)?;
        figures.push(("end_to_end_steps_per_s", end_to_end));
        let hours = config.run.total_steps as f64 / end_to_end / 3600.0;
        let total = config.run.total_steps as f64 / 1e6;
        figures.push(("default_training_hours", hours));
        lines +=
            &format!("end to end                {end_to_end:>10.0} steps/s   {total:.0} M steps take {hours:.1} h\n");
    }
    if args.only == Some(Part::Iteration) {
        let origin = PolicySource::find(args.ckpt.as_deref().unwrap_or(Path::new("builtin")))?;
        let seconds = seconds_of_parts(&task, &config, &origin)?;
        figures.extend(PARTS.iter().zip(seconds).map(|(part, seconds)| (part.key, seconds)));
        lines += &table(seconds);
        output.map_or(Ok(()), |output| picture(&config, seconds).write(output))?;
    }
    if args.json {
        let figures = figures.into_iter().map(|(name, value)| (name.to_owned(), json!(value)));
        let mut figures = serde_json::Map::from_iter(figures);
        figures.insert("threads".into(), json!(rayon::current_num_threads()));
        figures.insert("hidden".into(), json!(config.ppo.hidden));
        figures.insert("num_envs".into(), json!(config.env.num_envs));
        os::print(&format!("{}\n", serde_json::Value::Object(figures)))
    } else {
        os::print(&lines)
    }
}

/// Returns the seconds and shares of the parts of an iteration as lines.
fn table(seconds: [f64; 4]) -> String {
    let all: f64 = seconds.iter().sum();
    let line = |(part, seconds): (&iteration::Part, f64)| {
        format!("{:<26}{:>10.1} ms        {:.1} %\n", part.name, 1e3 * seconds, 100.0 * seconds / all)
    };
    PARTS.iter().zip(seconds).map(line).collect()
}

/// Returns a picture of the shares of the parts of an iteration.
fn picture(config: &Config, seconds: [f64; 4]) -> BarChart {
    let all: f64 = seconds.iter().sum();
    let bar = |(part, seconds): (iteration::Part, f64)| {
        let (value, note) = (seconds / all, format!("{:.0} ms, {:.0} %", 1e3 * seconds, 100.0 * seconds / all));
        NamedBar { name: part.name.to_owned(), value, interval: [value; 2], note }
    };
    let title =
        format!("one iteration of {} steps, nets {:?}: {:.2} s", config.steps_per_iteration(), config.ppo.hidden, all);
    let map = HeatMap { columns: Vec::new(), rows: Vec::new(), cells: Vec::new() };
    BarChart { title, bars: PARTS.into_iter().zip(seconds).map(bar).collect(), map }
}

/// The inputs and outputs of a block of environments in a burst.
struct BlockRows {
    /// The actions of all steps of the burst.
    actions: Vec<f32>,
    observations: Vec<f32>,
    final_observations: Vec<f32>,
    rewards: Vec<f32>,
    ends: Vec<Option<End>>,
}

impl BlockRows {
    fn new(envs: usize) -> Self {
        Self {
            actions: Vec::new(),
            observations: vec![0.0; envs * OBSERVATION_SIZE],
            final_observations: vec![0.0; envs * OBSERVATION_SIZE],
            rewards: vec![0.0; envs],
            ends: vec![None; envs],
        }
    }
}

/// Returns the env steps per second of bare physics and of the pool, as medians of the rounds, and the median of their ratios.
fn physics_and_pool(task: &Arc<Task>, config: &Config) -> Result<(f64, f64, f64)> {
    let envs = config.env.num_envs;
    let bursts = STEPS.div_ceil(envs * BURST);
    let mut noise = rng::stream(config.run.seed, "bench", 0);
    let mut draw =
        || config.ppo.std.by_equal_factors(0) as f32 * Distribution::<f32>::sample(&StandardNormal, &mut noise);
    let randomization = Randomization::new(task, &config.randomization)?;
    let randomization = randomization.as_ref();
    let mut pool = EnvPool::new(config.run.seed, (0..envs).map(|_| RecordingEnv::new(task, randomization)).collect());
    let mut lesson = Lesson::task(&config.env);
    lesson.randomized = Lesson::at(0, config).randomized;
    pool.set_lesson(lesson);
    let mut bare = BarePool::new(task, randomization, envs);
    let mut rows: Vec<BlockRows> = pool.block_sizes().into_iter().map(BlockRows::new).collect();
    pool.reset(rows.iter_mut().map(|rows| &mut rows.observations[..]).collect());
    let mut burst = |pool: &mut EnvPool<RecordingEnv>, steps: usize| {
        for rows in &mut rows {
            rows.actions = (0..steps * rows.rewards.len() * ACTION_SIZE).map(|_| draw()).collect();
        }
        pool.envs_mut().for_each(RecordingEnv::begin);
        play(pool, &mut rows, steps)
    };
    // Unmeasured steps first, so that most cubes lie in the hand; fewer of them for many environments.
    burst(&mut pool, (2 * STEPS / envs).clamp(4, 64));
    let mut rates: [Vec<f64>; 3] = Default::default();
    for _ in 0..ROUNDS {
        let (mut pool_seconds, mut bare_seconds) = (0.0, 0.0);
        for _ in 0..bursts {
            pool_seconds += burst(&mut pool, BURST);
            bare_seconds += bare.replay(&mut pool)?;
        }
        let done = (bursts * BURST * envs) as f64;
        rates[0].push(done / bare_seconds);
        rates[1].push(done / pool_seconds);
        rates[2].push(bare_seconds / pool_seconds);
    }
    let [physics, pool, share] = rates.map(median);
    Ok((physics, pool, share))
}

/// Steps a pool with these actions, as a training does, and returns the seconds that the steps took.
fn play<E: Env>(pool: &mut EnvPool<E>, rows: &mut [BlockRows], steps: usize) -> f64 {
    let blocks: Vec<_> = pool.blocks_mut().iter_mut().zip(rows).collect();
    let start = Instant::now();
    in_rounds(blocks, steps, |(envs, rows), step| {
        let size = envs.count() * ACTION_SIZE;
        let buffers = StepBuffers {
            rewards: &mut rows.rewards,
            ends: &mut rows.ends,
            observations: &mut rows.observations,
            final_observations: &mut rows.final_observations,
        };
        envs.step(&rows.actions[step * size..][..size], buffers).expect("environments do not panic");
    });
    start.elapsed().as_secs_f64()
}

/// Returns the samples per second and GFLOP/s of gradient steps, and the GFLOP/s of their matrix products alone.
fn learner(task: &Arc<Task>, config: &Config) -> Result<(f64, f64, f64)> {
    let mut agent = Agent::for_task(task, config, Exchange::alone(config.shards()))?;
    agent.collect(&NEVER)?;
    let Agent { ppo, rollout, .. } = &mut agent;
    let size = config.samples_per_minibatch();
    let flops = flops_per_sample(ppo.policy());
    time_gradient_steps(ppo, rollout, 2)?;
    let samples = size as f64 / median(time_gradient_steps(ppo, rollout, REPEATS)?);
    let matmul = median(matmul_gflops(ppo, size, REPEATS));
    Ok((samples, 1e-9 * flops * samples, matmul))
}

/// Returns the env steps per second of whole iterations of a training with these settings, without the first one if there are
/// more.
fn end_to_end(task: &Arc<Task>, config: &Config) -> Result<f64> {
    let mut agent = Agent::for_task(task, config, Exchange::alone(config.shards()))?;
    let begun = Instant::now();
    let mut rates = Vec::new();
    for _ in 0..=END_TO_END_ITERATIONS {
        rates.push(agent.iterate(&NEVER)?.context("nothing stops it")?.steps_per_s());
        if begun.elapsed().as_secs_f64() > END_TO_END_S {
            break;
        }
    }
    Ok(median(if rates.len() > 1 { rates.split_off(1) } else { rates }))
}
