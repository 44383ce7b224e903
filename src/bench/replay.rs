//! Environments that record the input of their physics, and its replay without them.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, ensure};
use rayon::prelude::*;

use crate::env::{Env, EnvPool, Transition};
use crate::repose::{EpisodePhysics, EpisodeStats, Lesson, Randomization, Repose, Task};
use crate::rng::Rng;
use crate::schedule::in_rounds;
use crate::sim::{Scene, Simulation};
use crate::spaces::Spaces;

/// A state from which the physics continues: at the beginning of a burst, or of an episode in it.
struct Start {
    /// The number of recorded steps before it.
    after: usize,
    state: Box<[f64]>,
    /// What its episode has drawn.
    draw: Option<EpisodePhysics>,
    /// Its scene, from the beginning of the replay on.
    scene: Scene,
}

/// An environment that records the input of its physics and can replay it. This is the only difference from the environment of a
/// training run.
pub struct RecordingEnv {
    env: Repose,
    randomization: Option<Arc<Randomization>>,
    starts: Vec<Start>,
    /// The controls of each step, and the random force on the object, if there are such forces.
    steps: Vec<(Vec<f64>, Option<[f64; 3]>)>,
    /// The physics alone.
    bare: Simulation,
    /// What the last episode in a replay has drawn, and its scene.
    drawn: (Option<EpisodePhysics>, Scene),
}

impl RecordingEnv {
    /// Creates an environment of `task`.
    pub fn new(task: &Arc<Task>, randomization: Option<&Arc<Randomization>>) -> Self {
        let nominal = randomization.map_or(&task.scene, |randomization| &randomization.nominal);
        Self {
            env: Repose::randomized(task, randomization),
            randomization: randomization.cloned(),
            starts: Vec::new(),
            steps: Vec::new(),
            bare: Simulation::new(nominal),
            drawn: (None, nominal.clone()),
        }
    }

    /// Forgets what was recorded and begins at the present state.
    pub fn begin(&mut self) {
        self.steps.clear();
        self.starts.clear();
        self.start();
    }

    fn start(&mut self) {
        self.starts.push(Start {
            after: self.steps.len(),
            state: self.env.sim.state(),
            draw: self.env.draw().cloned(),
            scene: self.drawn.1.clone(),
        });
    }

    /// Prepares the scenes of a replay, and begins it.
    fn prepare(&mut self) {
        for Start { draw, scene, .. } in &mut self.starts {
            if *draw != self.drawn.0 {
                let randomization = self.randomization.as_ref().expect("it has drawn");
                let (base, changes) = randomization.scene_of(draw.as_ref(), &self.env.task.hand);
                self.drawn = (draw.clone(), base.varied(&changes));
            }
            scene.clone_from(&self.drawn.1);
        }
        self.go_on(0);
    }

    fn replay(&mut self, step: usize) {
        let (ctrl, push) = &self.steps[step];
        if let Some(force) = *push {
            self.bare.push(self.env.task.hand.object.body, force);
        }
        self.bare.ctrl_mut().copy_from_slice(ctrl);
        self.bare.step_whole(self.env.task.config.substeps());
        self.go_on(step + 1);
    }

    /// Continues from the recorded state after this number of steps, if there is one.
    fn go_on(&mut self, steps: usize) {
        if let Some(start) = self.starts.iter().find(|start| start.after == steps) {
            self.bare.change_scene(&start.scene, &[]);
            self.bare
                .restore(&start.state)
                .expect("a state of the same scene");
        }
    }
}

impl Env for RecordingEnv {
    type Episode = EpisodeStats;
    type Lesson = Lesson;

    fn spaces(&self) -> Spaces {
        self.env.spaces()
    }

    fn set_lesson(&mut self, lesson: Lesson) {
        self.env.set_lesson(lesson);
    }

    fn reset(&mut self, rng: Rng, observation: &mut [f32]) {
        self.env.reset(rng, observation);
        self.start();
    }

    fn skip_ahead(&mut self, fraction: f64) {
        self.env.skip_ahead(fraction);
    }

    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition {
        let transition = self.env.step(action, observation);
        self.steps
            .push((self.env.sim.ctrl().to_vec(), self.env.last.push));
        transition
    }

    fn redirect(&mut self, observation: &mut [f32]) {
        self.env.redirect(observation);
    }

    fn episode(&self) -> EpisodeStats {
        self.env.episode()
    }
}

/// Replays the physics of what the environments of `pool` have recorded since [`RecordingEnv::begin`], in the same blocks, and
/// returns the seconds that the steps took.
///
/// # Errors
/// Fails if the replay does not end in the states of the environments: then it did not compute the same physics.
pub fn replay(pool: &mut EnvPool<RecordingEnv>) -> Result<f64> {
    let mut envs: Vec<&mut RecordingEnv> = pool.envs_mut().collect();
    envs.par_iter_mut().for_each(|env| env.prepare());
    let steps = envs[0].steps.len();
    let start = Instant::now();
    in_rounds(&mut pool.blocks, steps, |block, step| {
        block
            .members
            .iter_mut()
            .for_each(|member| member.env.replay(step));
    });
    let seconds = start.elapsed().as_secs_f64();
    let mut envs = pool.envs_mut();
    ensure!(
        envs.all(|env| env.bare.qpos() == env.env.sim.qpos()),
        "the replay of the physics did not end in the states of the environments"
    );
    Ok(seconds)
}
