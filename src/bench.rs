//! Measuring the speed of this machine: the physics alone, the environments around it, the learner, and whole iterations.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;
use serde_json::json;

use crate::agent::Agent;
use crate::cli::{BenchArgs, Part};
use crate::config::{Config, expect_used, user_file};
use crate::env::{
    ACTION_SIZE, Draw, End, Env, EnvPool, EpisodeStats, Lesson, OBSERVATION_SIZE, Randomization, Repose, StepBuffers,
    Task, Transition,
};
use crate::ppo::{flops_per_sample, matmul_gflops, time_gradient_steps};
use crate::rng::{self, Rng};
use crate::run;
use crate::schedule::in_rounds;
use crate::sim::{BareSimulation, FreeJoint, Scene, SimulationState};
use crate::spaces::Spaces;

/// The number of rounds of measuring physics and pool.
const ROUNDS: usize = 5;

/// The minimum number of measured control steps in a round, over all environments.
const STEPS: usize = 32_768;

/// Control steps of each environment in a turn. Pool and physics take short turns because the speed of a machine drifts within a
/// second.
const TURN: usize = 4;

/// The number of gradient steps and of matrix products that are measured.
const REPEATS: usize = 11;

/// The time after which no further whole iteration is started, s.
const END_TO_END_S: f64 = 8.0;

/// The maximum number of whole iterations after the first one.
const END_TO_END_ITERATIONS: usize = 4;

/// The stop flag of what is measured, which is never set.
static NEVER: AtomicBool = AtomicBool::new(false);

/// Runs the benchmark and prints the results.
///
/// # Errors
/// Fails if a setting or the scene cannot be used.
pub fn bench(args: &BenchArgs) -> Result<()> {
    expect_used(&args.settings.set, "bench")?;
    let mut config = Config::resolve(user_file(args.settings.config.as_deref())?.as_ref(), &args.settings.set)?;
    config.run.threads = args.threads.unwrap_or(config.run.threads);
    run::start_threads(config.run.threads)?;
    let task = Task::new(&config.env)?;
    let asked = |part: Part| args.only.is_none_or(|only| only == part);
    let mut figures = Vec::new();
    let mut lines = format!(
        "{} threads, {} environments, nets {:?}, minibatches of {}\n",
        rayon::current_num_threads(),
        config.env.num_envs,
        config.ppo.hidden,
        config.steps_per_iteration() / config.ppo.minibatches as u64,
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
    if args.json {
        let figures = figures.into_iter().map(|(name, value)| (name.to_owned(), json!(value)));
        let mut figures = serde_json::Map::from_iter(figures);
        figures.insert("threads".into(), json!(rayon::current_num_threads()));
        figures.insert("hidden".into(), json!(config.ppo.hidden));
        figures.insert("num_envs".into(), json!(config.env.num_envs));
        run::print(&format!("{}\n", serde_json::Value::Object(figures)))
    } else {
        run::print(&lines)
    }
}

/// The record of what an environment did in a turn.
struct Recording {
    /// Its state at the beginning, and what its episode has drawn.
    start: (SimulationState, Option<Draw>),
    /// Its controls, step by step.
    ctrl: Vec<f64>,
    /// The random force on the cube in each step, if there are such forces.
    pushes: Vec<Option<[f64; 3]>>,
    /// The episodes that began: the number of steps before each, its first state, and what it has drawn.
    resets: Vec<(usize, SimulationState, Option<Draw>)>,
    steps: usize,
}

/// An environment that records the input of its physics. This is the only difference from the environment of a training.
struct RecordingEnv {
    env: Repose,
    recording: Recording,
}

impl RecordingEnv {
    fn new(task: &Arc<Task>, randomization: Option<&Arc<Randomization>>) -> Self {
        let env = Repose::randomized(task, randomization);
        let (ctrl, pushes) = (Vec::with_capacity(TURN * ACTION_SIZE), Vec::with_capacity(TURN));
        let start = (env.simulation().state(), None);
        let recording = Recording { start, ctrl, pushes, resets: Vec::new(), steps: 0 };
        Self { env, recording }
    }

    fn begin(&mut self) {
        self.recording.start = (self.env.simulation().state(), self.env.draw().cloned());
        self.recording.ctrl.clear();
        self.recording.pushes.clear();
        self.recording.resets.clear();
        self.recording.steps = 0;
    }
}

impl Env for RecordingEnv {
    type Episode = EpisodeStats;
    type Lesson = Lesson;
    const SPACES: Spaces = Repose::SPACES;

    fn set_lesson(&mut self, lesson: Lesson) {
        self.env.set_lesson(lesson);
    }

    fn reset(&mut self, rng: Rng, observation: &mut [f32]) {
        self.env.reset(rng, observation);
        let draw = self.env.draw().cloned();
        self.recording.resets.push((self.recording.steps, self.env.simulation().state(), draw));
    }

    fn skip_ahead(&mut self, share: f64) {
        self.env.skip_ahead(share);
    }

    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition {
        let transition = self.env.step(action, observation);
        self.recording.pushes.push(self.env.last_step().push);
        self.recording.ctrl.extend_from_slice(self.env.simulation().ctrl());
        self.recording.steps += 1;
        transition
    }

    fn redirect(&mut self, observation: &mut [f32]) {
        self.env.redirect(observation);
    }

    fn episode(&self) -> EpisodeStats {
        self.env.episode()
    }
}

/// The physics alone of an environment.
struct Replay {
    sim: BareSimulation,
    /// What the last episode has drawn, and its scene.
    drawn: (Option<Draw>, Scene),
    /// The scenes of the episodes that begin in the next turn.
    resets: Vec<Scene>,
}

impl Replay {
    fn new(nominal: &Scene) -> Self {
        Self { sim: BareSimulation::new(nominal), drawn: (None, nominal.clone()), resets: Vec::new() }
    }

    /// Prepares what the replay of a turn needs: its first state and its scenes.
    fn prepare(&mut self, recording: &Recording, scene_of: impl Fn(Option<&Draw>) -> Scene) {
        let (state, draw) = &recording.start;
        if *draw != self.drawn.0 {
            self.drawn = (draw.clone(), scene_of(draw.as_ref()));
        }
        self.sim.start(state, &self.drawn.1);
        self.resets = recording.resets.iter().map(|(_, _, draw)| scene_of(draw.as_ref())).collect();
        if let (Some((_, _, draw)), Some(scene)) = (recording.resets.last(), self.resets.last()) {
            self.drawn = (draw.clone(), scene.clone());
        }
    }

    fn step(&mut self, recording: &Recording, step: usize, cube: FreeJoint, substeps: usize) {
        if let Some(force) = recording.pushes[step] {
            self.sim.push(cube.body, force);
        }
        self.sim.step(&recording.ctrl[step * ACTION_SIZE..][..ACTION_SIZE], substeps);
        if let Ok(i) = recording.resets.binary_search_by_key(&(step + 1), |&(after, ..)| after) {
            self.sim.start(&recording.resets[i].1, &self.resets[i]);
        }
    }
}

/// The inputs and outputs of a block of environments in a turn.
struct BlockRows {
    /// The actions of all steps of the turn.
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
    let turns = STEPS.div_ceil(envs * TURN);
    let mut noise = rng::stream(config.run.seed, "bench", 0);
    let mut draw = || config.ppo.std_bounds(0)[1] as f32 * Distribution::<f32>::sample(&StandardNormal, &mut noise);
    let randomization = Randomization::new(task, &config.randomization)?;
    let randomization = randomization.as_ref();
    let mut pool = EnvPool::new(config.run.seed, (0..envs).map(|_| RecordingEnv::new(task, randomization)).collect());
    let scene = randomization.map_or(task.scene(), |randomization| randomization.nominal());
    let scene_of = |draw: Option<&Draw>| match (randomization, draw) {
        (Some(randomization), Some(draw)) => randomization.scene_of(draw, task),
        _ => scene.clone(),
    };
    let mut bare: Vec<Replay> = (0..envs).map(|_| Replay::new(scene)).collect();
    let mut rows: Vec<BlockRows> = pool.block_sizes().into_iter().map(BlockRows::new).collect();
    pool.reset(rows.iter_mut().map(|rows| &mut rows.observations[..]).collect());
    let mut turn = |pool: &mut EnvPool<RecordingEnv>, steps: usize| {
        for rows in &mut rows {
            rows.actions = (0..steps * rows.rewards.len() * ACTION_SIZE).map(|_| draw()).collect();
        }
        pool.envs_mut().for_each(RecordingEnv::begin);
        play(pool, &mut rows, steps)
    };
    // Unmeasured steps first, so that most cubes lie in the hand; fewer of them for many environments.
    turn(&mut pool, (2 * STEPS / envs).clamp(4, 64));
    let mut rates: [Vec<f64>; 3] = Default::default();
    for _ in 0..ROUNDS {
        let (mut pool_seconds, mut bare_seconds) = (0.0, 0.0);
        for _ in 0..turns {
            pool_seconds += turn(&mut pool, TURN);
            let sizes = pool.block_sizes();
            let recordings: Vec<&Recording> = pool.envs_mut().map(|env| &env.recording).collect();
            bare.par_iter_mut().zip(&recordings).for_each(|(bare, recording)| bare.prepare(recording, scene_of));
            bare_seconds += replay(&mut bare, &recordings, &sizes, task);
            drop(recordings);
            // The replay computed the same physics only if it ended in the same states.
            let same =
                bare.iter().zip(pool.envs_mut()).all(|(bare, env)| bare.sim.qpos() == env.env.simulation().qpos());
            ensure!(same, "the replay of the physics did not end in the states of the environments");
        }
        let done = (turns * TURN * envs) as f64;
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

/// Replays the recordings in the same blocks and returns the seconds that the steps took.
fn replay(bare: &mut [Replay], recordings: &[&Recording], sizes: &[usize], task: &Task) -> f64 {
    let (cube, substeps) = (task.hand().cube, task.config().substeps());
    let steps = recordings[0].steps;
    let mut all = bare.iter_mut().zip(recordings);
    let blocks: Vec<Vec<_>> = sizes.iter().map(|&size| all.by_ref().take(size).collect()).collect();
    let start = Instant::now();
    in_rounds(blocks, steps, |block, step| {
        for (bare, recording) in block {
            bare.step(recording, step, cube, substeps);
        }
    });
    start.elapsed().as_secs_f64()
}

/// Returns the samples per second and GFLOP/s of gradient steps, and the GFLOP/s of their matrix products alone.
fn learner(task: &Arc<Task>, config: &Config) -> Result<(f64, f64, f64)> {
    let mut agent = Agent::of_task(task, config)?;
    agent.collect(&NEVER)?;
    let Agent { ppo, rollout, .. } = &mut agent;
    let size = rollout.samples() / config.ppo.minibatches;
    let flops = flops_per_sample(ppo.policy());
    time_gradient_steps(ppo, rollout, 2)?;
    let samples = size as f64 / median(time_gradient_steps(ppo, rollout, REPEATS)?);
    let matmul = median(matmul_gflops(ppo, size, REPEATS));
    Ok((samples, 1e-9 * flops * samples, matmul))
}

/// Returns the env steps per second of whole iterations of a training with these settings, without the first one if there are
/// more.
fn end_to_end(task: &Arc<Task>, config: &Config) -> Result<f64> {
    let mut agent = Agent::of_task(task, config)?;
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

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
