//! Environments that record the input of their physics, and its replay without them.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, ensure};
use rayon::prelude::*;

use crate::env::{Env, EnvPool, Transition};
use crate::repose::{ACTION_SIZE, EpisodePhysics, EpisodeStats, Lesson, Randomization, Repose, Task};
use crate::rng::Rng;
use crate::schedule::in_rounds;
use crate::sim::{FreeJoint, Scene, Simulation, SimulationState};
use crate::spaces::Spaces;

/// The record of what an environment did in a burst.
struct Recording {
    /// Its state at the beginning, and what its episode has drawn.
    start: (SimulationState, Option<EpisodePhysics>),
    /// Its controls, step by step.
    ctrl: Vec<f64>,
    /// The random force on the cube in each step, if there are such forces.
    pushes: Vec<Option<[f64; 3]>>,
    /// The episodes that began: the number of steps before each, its first state, and what it has drawn.
    resets: Vec<(usize, SimulationState, Option<EpisodePhysics>)>,
    steps: usize,
}

/// An environment that records the input of its physics. This is the only difference from the environment of a training.
pub(super) struct RecordingEnv {
    env: Repose,
    recording: Recording,
}

impl RecordingEnv {
    /// Creates an environment of `task`.
    pub(super) fn new(task: &Arc<Task>, randomization: Option<&Arc<Randomization>>) -> Self {
        let env = Repose::randomized(task, randomization);
        let start = (env.simulation().state(), None);
        let recording = Recording { start, ctrl: Vec::new(), pushes: Vec::new(), resets: Vec::new(), steps: 0 };
        Self { env, recording }
    }

    /// Forgets what was recorded and begins at the present state.
    pub(super) fn begin(&mut self) {
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

    fn skip_ahead(&mut self, fraction: f64) {
        self.env.skip_ahead(fraction);
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
    sim: Simulation,
    /// What the last episode has drawn, and its scene.
    drawn: (Option<EpisodePhysics>, Scene),
    /// The scenes of the episodes that begin in the next burst.
    resets: Vec<Scene>,
}

impl Replay {
    fn new(nominal: &Scene) -> Self {
        Self { sim: Simulation::new(nominal), drawn: (None, nominal.clone()), resets: Vec::new() }
    }

    /// Prepares what the replay of a burst needs: its first state and its scenes.
    fn prepare(&mut self, recording: &Recording, scene_of: impl Fn(Option<&EpisodePhysics>) -> Scene) {
        let (state, draw) = &recording.start;
        if *draw != self.drawn.0 {
            self.drawn = (draw.clone(), scene_of(draw.as_ref()));
        }
        self.sim.start_replay(state, &self.drawn.1);
        self.resets = recording.resets.iter().map(|(_, _, draw)| scene_of(draw.as_ref())).collect();
        if let (Some((_, _, draw)), Some(scene)) = (recording.resets.last(), self.resets.last()) {
            self.drawn = (draw.clone(), scene.clone());
        }
    }

    fn step(&mut self, recording: &Recording, step: usize, cube: FreeJoint, substeps: usize) {
        if let Some(force) = recording.pushes[step] {
            self.sim.push(cube.body, force);
        }
        self.sim.ctrl_mut().copy_from_slice(&recording.ctrl[step * ACTION_SIZE..][..ACTION_SIZE]);
        self.sim.step_whole(substeps);
        if let Ok(i) = recording.resets.binary_search_by_key(&(step + 1), |&(after, ..)| after) {
            self.sim.start_replay(&recording.resets[i].1, &self.resets[i]);
        }
    }
}

/// The physics alone of a pool of environments.
pub(super) struct BarePool<'a> {
    task: &'a Task,
    randomization: Option<&'a Arc<Randomization>>,
    nominal: Scene,
    replays: Vec<Replay>,
}

impl<'a> BarePool<'a> {
    /// Creates the physics of `envs` environments of `task`.
    pub(super) fn new(task: &'a Task, randomization: Option<&'a Arc<Randomization>>, envs: usize) -> Self {
        let nominal = randomization.map_or(task.scene(), |randomization| randomization.nominal()).clone();
        let replays = (0..envs).map(|_| Replay::new(&nominal)).collect();
        Self { task, randomization, nominal, replays }
    }

    /// Replays what the environments of `pool` have recorded since [`RecordingEnv::begin`], and returns the seconds that the steps
    /// took.
    ///
    /// # Errors
    /// Fails if the replay does not end in the states of the environments: then it did not compute the same physics.
    pub(super) fn replay(&mut self, pool: &mut EnvPool<RecordingEnv>) -> Result<f64> {
        let sizes = pool.block_sizes();
        let recordings: Vec<&Recording> = pool.envs_mut().map(|env| &env.recording).collect();
        let Self { task, randomization, nominal, replays } = self;
        let (task, randomization, nominal) = (*task, *randomization, &*nominal);
        let scene_of = |draw: Option<&EpisodePhysics>| match (randomization, draw) {
            (Some(randomization), Some(draw)) => randomization.scene_of(draw, task),
            _ => nominal.clone(),
        };
        replays.par_iter_mut().zip(&recordings).for_each(|(replay, recording)| replay.prepare(recording, scene_of));
        let seconds = replay(replays, &recordings, &sizes, task);
        drop(recordings);
        let same =
            replays.iter().zip(pool.envs_mut()).all(|(bare, env)| bare.sim.qpos() == env.env.simulation().qpos());
        ensure!(same, "the replay of the physics did not end in the states of the environments");
        Ok(seconds)
    }
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
