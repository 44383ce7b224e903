//! The environment: a Shadow Hand turns the object in its palm to one goal orientation after another.
//!
//! Each step has a fixed order: action, physics, errors and reward against the current goal, hold counter, ends, new
//! goal, observation with the next goal.

mod seeing;

use std::sync::Arc;

use anyhow::{Result, ensure};

use super::conditions::Conditions;
use super::divergence::{Diverged, Recorder};
use super::physics::Physics;
use super::randomization::{EpisodePhysics, Randomization};
use super::reward::{Step, task_reward};
use super::servos::Servos;
use super::task::Task;
use super::{EpisodeStats, Lesson, StepSums, add};
use crate::config::SuccessHold;
use crate::env::{End, Env, EnvState, Resumable, SavedEnv, Transition};
use crate::quat::{self, Quat};
use crate::rng::{self, Rng};
use crate::sim::{Pose, Simulation};
use crate::spaces::Spaces;

/// One Shadow Hand with its cube.
pub struct Repose {
    /// Its task.
    pub task: Arc<Task>,
    lesson: Lesson,
    /// The physics state. Call [`Simulation::refresh`] after a modification.
    pub sim: Simulation,
    rng: Rng,
    /// The goal orientation of the next step.
    pub goal: Quat,
    /// The last step, which may have ended the episode before this one. Observations show its action as the previous one.
    pub last: Step,
    servos: Servos,
    conditions: Conditions,
    /// Control steps since the reset, plus those skipped by `skip_ahead`.
    age: u32,
    /// The steps within the tolerance that count towards the current goal.
    pub held: u32,
    episode: EpisodeStats,
    /// The sums since they were last taken.
    sums: StepSums,
    recorder: Recorder,
    /// The last episode that has diverged, until somebody takes it.
    pub diverged: Option<Diverged>,
}

impl Repose {
    /// Goes on with these factors on quantities of the task's physics, by name. The state stays.
    ///
    /// # Errors
    /// Fails if the physics has diverged.
    pub fn vary(&mut self, factors: &[(&str, f64)]) -> Result<()> {
        let changes = Physics::with(&self.task.hand, factors).changes(&self.task.hand);
        let state = self.sim.state();
        self.sim.change_scene(&self.task.scene, &changes);
        self.sim.restore(&state)
    }

    /// Creates an environment of `task`. It must be reset before it is stepped.
    pub fn new(task: &Arc<Task>) -> Self {
        Self::randomized(task, None)
    }

    /// Creates an environment of `task` some of whose episodes are randomised.
    pub fn randomized(task: &Arc<Task>, randomization: Option<&Arc<Randomization>>) -> Self {
        let drawn_delay = randomization.map_or(0, |randomization| randomization.config.delay[1]);
        let delay = task.config.action_delay + drawn_delay;
        let memory = delay.max(task.config.prediction) as usize;
        let scene = randomization.map_or(&task.scene, |randomization| &randomization.nominal);
        Self {
            sim: Simulation::new(scene),
            servos: Servos::new(task.hand.actuators.len(), memory),
            conditions: Conditions::new(randomization),
            task: task.clone(),
            lesson: Lesson::task(&task.config),
            rng: rng::stream(0, "unused", 0),
            goal: quat::IDENTITY,
            last: Step {
                action: vec![0.0; task.hand.actuators.len()],
                ..Step::default()
            },
            age: 0,
            held: 0,
            episode: EpisodeStats::default(),
            sums: StepSums::default(),
            recorder: Recorder::default(),
            diverged: None,
        }
    }

    /// The current rotation error, rad.
    pub fn rot_dist(&self) -> f64 {
        quat::angle_between(self.object().orientation, self.goal)
    }

    /// What this episode has drawn, if it is randomised.
    pub fn draw(&self) -> Option<&EpisodePhysics> {
        self.conditions.draw.as_ref()
    }

    /// The sums since the last call.
    pub fn take_sums(&mut self) -> StepSums {
        std::mem::take(&mut self.sums)
    }

    /// A number up to `most` in magnitude.
    fn noise(&mut self, most: f64) -> f64 {
        rng::uniform(&mut self.rng, -most, most)
    }

    fn draw_rotation(&mut self) -> Quat {
        let mut draw = || rng::uniform(&mut self.rng, 0.0, 1.0);
        quat::uniform([draw(), draw(), draw()])
    }

    /// Writes as controls the targets that take effect now.
    fn send(&mut self) {
        let ctrl = self.sim.ctrl_mut();
        for (actuator, target) in self.task.hand.actuators.iter().zip(&self.servos.due) {
            ctrl[actuator.ctrl] = *target;
        }
    }

    /// Takes one step of the physics under an action, and records what its rewards depend on.
    fn advance(&mut self, action: &[f32]) {
        let rot_dist_before = self.rot_dist();
        self.last
            .action
            .iter_mut()
            .zip(action)
            .for_each(|(clipped, action)| *clipped = action.clamp(-1.0, 1.0));
        self.servos
            .apply(&self.last.action, &self.task.hand.actuators, &self.lesson);
        self.send();
        self.last.push =
            self.conditions
                .push(&self.rng, self.episode.length, &mut self.sim, &self.task);
        let left = quat::mul(self.goal, quat::conj(self.object().orientation));
        let torque = self
            .conditions
            .assist(self.lesson.assist, left, &mut self.sim, &self.task);
        self.recorder
            .record(&self.sim, action, self.last.push, torque);
        self.last.diverged = self.sim.step(self.task.config.substeps());
        if self.last.diverged {
            // MuJoCo may have cleared the controls. Restore what was sent for anyone who reads them.
            self.send();
        }
        self.measure(rot_dist_before);
        self.last.reward = Default::default();
        self.last.training = Default::default();
    }

    /// Rewards a step that did not diverge, and adds it to the sums.
    fn pay(&mut self) {
        let reward = task_reward(&self.task.config, &self.last);
        let training = self.lesson.reward(&self.last);
        let rot_dist = self.last.rot_dist;
        add(&mut self.episode.reward, reward);
        self.episode.rot_dist_sum += rot_dist;
        self.episode.in_tolerance += u32::from(rot_dist <= self.task.config.success_tolerance);
        add(&mut self.sums.task, reward);
        add(&mut self.sums.training, training);
        self.sums.turned += self.last.rot_dist_before - rot_dist;
        self.last.reward = reward;
        self.last.training = training;
    }

    /// Updates the hold counter after a step, and returns whether the goal has now been held long enough.
    fn hold(&mut self) -> bool {
        if self.last.within {
            self.held += 1;
        } else if self.task.config.success_hold == SuccessHold::Consecutive {
            self.held = 0;
        }
        let reached = self.held >= self.lesson.hold;
        if reached {
            self.held = 0;
            self.episode.goals += 1;
        }
        reached
    }

    /// Draws a new goal and resets the hold counter.
    fn replace_goal(&mut self) {
        self.goal = self.draw_rotation();
        let pose = Pose {
            position: self.task.goal_place(),
            orientation: self.goal,
        };
        self.sim.place(self.task.hand.goal, pose);
        self.held = 0;
        // The target may affect the physics of a custom scene, so nothing may depend on its old pose.
        self.sim.refresh();
    }
}

impl Env for Repose {
    type Episode = EpisodeStats;
    type Lesson = Lesson;

    fn spaces(&self) -> Spaces {
        self.task.spaces()
    }

    fn set_lesson(&mut self, lesson: Lesson) {
        self.lesson = lesson;
    }

    fn reset(&mut self, rng: Rng, observation: &mut [f32]) {
        let task = self.task.clone();
        let hand = &task.hand;
        let config = &task.config;
        self.rng = rng;
        self.conditions
            .begin(&self.rng, self.lesson.randomized, &mut self.sim, &task);
        self.sim.reset();
        self.sim.qpos_mut().copy_from_slice(&hand.start);
        for joint in &hand.joints {
            let noise = self.noise(config.reset_dof_pos_noise);
            if joint.is_in_loop {
                continue;
            }
            let angle = &mut self.sim.qpos_mut()[joint.qpos];
            *angle = (*angle + noise).clamp(joint.range[0], joint.range[1]);
        }
        for joint in &hand.joints {
            let noise = self.noise(config.reset_dof_vel_noise);
            if !joint.is_in_loop {
                self.sim.qvel_mut()[joint.dof] = noise;
            }
        }
        if !self.sim.follow() {
            self.sim.qpos_mut().copy_from_slice(&hand.start);
        }
        for (axis, start) in config.goal_position.value.into_iter().enumerate() {
            let noise = self.noise(config.reset_position_noise);
            self.sim.qpos_mut()[hand.object.qpos + axis] = start + noise;
        }
        let orientation = self.draw_rotation();
        self.sim.qpos_mut()[hand.object.qpos + 3..][..4].copy_from_slice(&orientation);
        self.replace_goal();
        let targets = hand.actuators.iter().map(|actuator| {
            let [low, high] = actuator.range;
            self.sim.length(*actuator).clamp(low, high)
        });
        self.servos.reset(targets, self.conditions.delay(&task));
        self.send();
        self.last.action.fill(0.0);
        self.age = 0;
        self.episode = EpisodeStats {
            randomized: self.conditions.draw.is_some(),
            ..Default::default()
        };
        self.recorder = Recorder::default();
        self.show(observation);
    }

    fn skip_ahead(&mut self, fraction: f64) {
        self.age = (fraction * f64::from(self.task.config.max_episode_steps())) as u32;
    }

    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition {
        self.advance(action);
        self.age += 1;
        self.episode.length += 1;
        self.episode.diverged = self.last.diverged;
        self.episode.dropped = !self.last.diverged && self.last.dropped;
        self.sums.steps += 1;
        self.sums.diverged += u64::from(self.last.diverged);
        let reached = if self.last.diverged {
            let draw = self.conditions.draw.clone();
            let length = self.episode.length;
            self.diverged = self
                .recorder
                .tail()
                .map(|tail| Diverged { length, draw, tail });
            false
        } else {
            self.pay();
            self.hold()
        };
        let end = if self.last.diverged || self.episode.dropped {
            Some(End::Terminated)
        } else {
            let time_is_up = self.age >= self.task.config.max_episode_steps();
            let chance = self.lesson.redirect_chance;
            let goal_ends = if reached {
                self.lesson.goals_end
            } else {
                // A goal that was not reached is given up at random, so the state needs no clock.
                chance > 0.0 && rng::uniform(&mut self.rng, 0.0, 1.0) < chance
            };
            time_is_up
                .then_some(End::Truncated)
                .or(goal_ends.then_some(End::Redirected))
        };
        // When the goal is cut off, its final observation must show the old goal. `redirect` replaces it afterwards.
        if reached && !self.lesson.goals_end {
            self.replace_goal();
        }
        self.show(observation);
        Transition {
            reward: self.lesson.total(self.last.reward, self.last.training) as f32,
            end,
        }
    }

    /// Draws another goal and resets the hold counter.
    fn redirect(&mut self, observation: &mut [f32]) {
        self.replace_goal();
        self.show(observation);
    }

    fn episode(&self) -> EpisodeStats {
        self.episode
    }
}

impl Resumable for Repose {
    fn save(&self, state: &mut EnvState) {
        state.counters.extend(rng::position(&self.rng));
        state.counters.extend([self.age, self.held].map(u64::from));
        state.counters.push(u64::from(self.episode.randomized));
        state.put_list(self.sim.state());
        state.numbers.extend(self.goal);
        state
            .numbers
            .extend(self.last.action.iter().copied().map(f64::from));
        state.numbers.extend(&self.servos.targets);
        self.episode.save(state);
        state.put_list(self.servos.sent.iter().copied());
    }

    fn restore(&mut self, state: &mut SavedEnv, observation: &mut [f32]) -> Result<()> {
        self.rng = rng::at(state.counters()?);
        let [age, held, randomized] = state.counters()?;
        // `age` has no tighter limit: a fork may have shorter episodes.
        ensure!(
            age <= u64::from(u32::MAX / 2) && held <= age,
            "impossible episode: at step {age} its goal has been held for {held} steps"
        );
        self.age = age as u32;
        self.held = held as u32;
        ensure!(
            randomized <= 1,
            "the mark of a randomised episode is {randomized}, not 0 or 1"
        );
        self.conditions
            .begin(&self.rng, randomized as f64, &mut self.sim, &self.task);
        self.sim.restore(state.list()?)?;
        // A fork may also have no forces on the object, but its parent's state has one.
        self.sim.push(self.task.hand.object.body, [0.0; 3]);
        self.sim.twist(self.task.hand.object.body, [0.0; 3]);
        self.goal = state.numbers()?;
        ensure!(
            (quat::length(&self.goal) - 1.0).abs() < 1e-6,
            "the goal is not a unit quaternion: {:?}",
            self.goal
        );
        let actuators = self.task.hand.actuators.len();
        self.last
            .action
            .iter_mut()
            .zip(state.next(actuators)?)
            .for_each(|(own, x)| *own = *x as f32);
        let mut actions = self.last.action.iter();
        ensure!(
            actions.all(|action| (-1.0..=1.0).contains(action)),
            "the previous action is outside [-1, 1]: {:?}",
            self.last.action
        );
        let targets = state.next(actuators)?;
        self.episode = EpisodeStats {
            randomized: self.conditions.draw.is_some(),
            ..EpisodeStats::saved(state)?
        };
        let sent = state.list()?;
        ensure!(
            sent.len().is_multiple_of(actuators),
            "it has {} targets of earlier steps",
            sent.len()
        );
        self.servos
            .restore(targets, sent, self.conditions.delay(&self.task));
        self.sums = StepSums::default();
        self.recorder = Recorder::default();
        self.show(observation);
        Ok(())
    }
}
