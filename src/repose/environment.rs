//! The environment: a Shadow Hand turns the cube in its palm to one goal orientation after another.
//!
//! The order within a step is fixed: action, physics, errors and reward against the current goal, hold counter, ends, new
//! goal, observation with the next goal.

use std::sync::Arc;

use anyhow::{Result, ensure};

use super::conditions::Conditions;
use super::observation::{Cells, SPACES};
use super::randomization::{Draw, Randomization};
use super::servos::{Servos, Targets};
use super::tail::{Recorder, Tail};
use super::task::Task;
use super::{ACTION_SIZE, EpisodeStats, Lesson, Recent, RewardTerms, Shaping};
use crate::config::{EnvConfig, SuccessHold};
use crate::env::{End, Env, EnvState, Resumable, SavedEnv, Transition};
use crate::quat::{self, Quat};
use crate::rng::{self, Rng};
use crate::sim::{Physics, Pose, Simulation, Velocity};
use crate::spaces::Spaces;

/// One Shadow Hand with its cube.
pub struct Repose {
    task: Arc<Task>,
    lesson: Lesson,
    sim: Simulation,
    rng: Rng,
    goal: Quat,
    /// The previous action as observed: clipped to [-1, 1].
    previous_action: [f32; ACTION_SIZE],
    servos: Servos,
    conditions: Conditions,
    /// Control steps since the reset, plus those skipped by `skip_ahead`.
    age: u32,
    held: u32,
    episode: EpisodeStats,
    recent: Recent,
    last: StepDetails,
    recorder: Recorder,
    diverged: Option<Diverged>,
}

/// The end of an episode whose physics diverged.
#[derive(Clone, Debug)]
pub struct Diverged {
    /// The length of the episode in control steps, including the last one.
    pub length: u32,
    /// What the episode has drawn, if it was randomised.
    pub draw: Option<Draw>,
    /// The last steps of the episode.
    pub tail: Tail,
}

/// Details of the last step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepDetails {
    /// The goal during the step.
    pub goal: Quat,
    /// Rotation error after the step, rad.
    pub rot_dist: f64,
    /// Distance of the cube from the goal position after the step, m.
    pub goal_dist: f64,
    /// The reward by term.
    pub reward: RewardTerms,
    /// Whether the physics diverged.
    pub diverged: bool,
    /// The random force on the cube in the step, N, if there are such forces in the episode.
    pub push: Option<[f64; 3]>,
}

impl Repose {
    /// Creates an environment of `task`; it must be reset before it is stepped.
    pub fn new(task: &Arc<Task>) -> Self {
        Self::randomized(task, None)
    }

    /// Creates an environment of `task` some of whose episodes are randomised.
    pub fn randomized(task: &Arc<Task>, randomization: Option<&Arc<Randomization>>) -> Self {
        let conditions = Conditions::new(randomization);
        Self {
            sim: Simulation::new(conditions.nominal(task)),
            servos: Servos::new(),
            conditions,
            task: task.clone(),
            lesson: Lesson::task(&task.config),
            rng: rng::stream(0, "unused", 0),
            goal: [1.0, 0.0, 0.0, 0.0],
            previous_action: [0.0; ACTION_SIZE],
            age: 0,
            held: 0,
            episode: EpisodeStats::default(),
            recent: Recent::default(),
            last: StepDetails::default(),
            recorder: Recorder::default(),
            diverged: None,
        }
    }

    /// Returns details of the last step.
    pub fn last_step(&self) -> &StepDetails {
        &self.last
    }

    /// Returns the goal orientation of the next step.
    pub fn goal(&self) -> Quat {
        self.goal
    }

    /// Returns the steps within the tolerance that count towards the current goal.
    pub fn held(&self) -> u32 {
        self.held
    }

    /// Returns the current rotation error, rad.
    pub fn rot_dist(&self) -> f64 {
        quat::angle_between(self.cube().orientation, self.goal)
    }

    /// Returns the physics state.
    pub fn simulation(&self) -> &Simulation {
        &self.sim
    }

    /// Returns the physics state for modification; call [`Simulation::refresh`] afterwards.
    pub fn simulation_mut(&mut self) -> &mut Simulation {
        &mut self.sim
    }

    /// Returns what this episode has drawn, if it is randomised.
    pub fn draw(&self) -> Option<&Draw> {
        self.conditions.draw()
    }

    /// Returns the settings of the task.
    pub fn config(&self) -> &EnvConfig {
        &self.task.config
    }

    /// Returns the sums since the last call.
    pub fn take_recent(&mut self) -> Recent {
        std::mem::take(&mut self.recent)
    }

    /// Returns the last episode that has diverged since the last call.
    pub fn take_diverged(&mut self) -> Option<Diverged> {
        self.diverged.take()
    }

    fn draw_rotation(&mut self) -> Quat {
        let mut draw = || rng::uniform(&mut self.rng, 0.0, 1.0);
        quat::uniform([draw(), draw(), draw()])
    }

    fn set_goal(&mut self) {
        self.goal = self.draw_rotation();
        let [x, y, z] = self.task.config.goal_position;
        let position = [x, y, z + self.task.config.target_height];
        self.sim.place(self.task.hand.target, Pose { position, orientation: self.goal });
    }

    fn cube(&self) -> Pose {
        let at = self.task.hand.cube.qpos;
        let q = self.sim.qpos();
        Pose { position: [q[at], q[at + 1], q[at + 2]], orientation: [q[at + 3], q[at + 4], q[at + 5], q[at + 6]] }
    }

    /// Clips the action, writes as controls the targets that take effect now, and returns those.
    fn actuate(&mut self, action: &[f32]) -> Targets {
        self.previous_action.iter_mut().zip(action).for_each(|(clipped, action)| *clipped = action.clamp(-1.0, 1.0));
        let due =
            self.servos.take(&self.previous_action, &self.task.hand.actuators, self.task.config.act_moving_average);
        self.send(due);
        due
    }

    fn send(&mut self, targets: Targets) {
        let ctrl = self.sim.ctrl_mut();
        for (actuator, target) in self.task.hand.actuators.iter().zip(targets) {
            ctrl[actuator.ctrl] = target;
        }
    }

    /// Updates the hold counter after a step, and returns whether the goal has now been held long enough.
    fn hold(&mut self, within: bool) -> bool {
        if within {
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
        self.set_goal();
        self.held = 0;
        // The target may affect the physics of a custom scene, so nothing may depend on its old pose.
        self.sim.refresh();
    }

    /// Decides whether the lesson replaces a goal that was not reached. The decision is random, so the state needs no clock.
    fn gives_up(&mut self) -> bool {
        let chance = self.lesson.redirect_chance;
        chance > 0.0 && rng::uniform(&mut self.rng, 0.0, 1.0) < chance
    }

    /// Writes the observation `[157]` of the current state, in the task's order.
    pub fn observe(&self, observation: &mut [f32]) {
        let (hand, config) = (&self.task.hand, &self.task.config);
        let (qpos, qvel) = (self.sim.qpos(), self.sim.qvel());
        let mut cells = Cells::new(observation);
        cells.put("joint_pos", hand.joints.map(|joint| qpos[joint.qpos]));
        cells.put("joint_vel", hand.joints.map(|joint| config.vel_obs_scale * qvel[joint.dof]));

        let Pose { position, orientation } = self.cube();
        let [vx, vy, vz, spin @ ..] = qvel[hand.cube.dof..].first_chunk::<6>().expect("a free joint");
        cells.put("cube_pos", position);
        cells.put("cube_quat", quat::canonical(orientation));
        cells.put("cube_linvel", [*vx, *vy, *vz]);
        // MuJoCo stores the angular velocity of a free joint in the body's frame.
        cells.put("cube_angvel", quat::rotate(orientation, *spin).map(|x| config.vel_obs_scale * x));
        cells.put("goal_pos", config.goal_position);
        cells.put("goal_quat", quat::canonical(self.goal));
        cells.put("relative_quat", quat::canonical(quat::mul(orientation, quat::conj(self.goal))));

        for tip in hand.fingertips {
            let Pose { position, orientation } = self.sim.pose(tip);
            let Velocity { linear, angular } = self.sim.velocity(tip);
            cells.put("fingertips", position);
            cells.put("fingertips", orientation);
            cells.put("fingertips", linear);
            cells.put("fingertips", angular);
        }
        cells.put("previous_action", self.previous_action.map(f64::from));
        cells.finish();
        self.conditions.disturb(&self.rng, self.episode.length, &self.task, observation);
    }
}

impl Env for Repose {
    type Episode = EpisodeStats;
    type Lesson = Lesson;
    const SPACES: Spaces = SPACES;

    fn set_lesson(&mut self, lesson: Lesson) {
        self.lesson = lesson;
    }

    fn reset(&mut self, rng: Rng, observation: &mut [f32]) {
        let task = self.task.clone();
        let (hand, config) = (&task.hand, &task.config);
        self.rng = rng;
        self.conditions.begin(&self.rng, self.lesson.randomized, &mut self.sim, &task);
        self.sim.reset();
        for joint in &hand.joints {
            let noise = rng::uniform(&mut self.rng, -config.reset_dof_pos_noise, config.reset_dof_pos_noise);
            let angle = &mut self.sim.qpos_mut()[joint.qpos];
            *angle = (*angle + noise).clamp(joint.range[0], joint.range[1]);
        }
        for joint in &hand.joints {
            let noise = rng::uniform(&mut self.rng, -config.reset_dof_vel_noise, config.reset_dof_vel_noise);
            self.sim.qvel_mut()[joint.dof] = noise;
        }
        for (axis, start) in config.goal_position.into_iter().enumerate() {
            let noise = rng::uniform(&mut self.rng, -config.reset_position_noise, config.reset_position_noise);
            self.sim.qpos_mut()[hand.cube.qpos + axis] = start + noise;
        }
        let orientation = self.draw_rotation();
        self.sim.qpos_mut()[hand.cube.qpos + 3..hand.cube.qpos + 7].copy_from_slice(&orientation);
        self.set_goal();
        let mut targets = [0.0; ACTION_SIZE];
        for ((target, actuator), driven) in targets.iter_mut().zip(&hand.actuators).zip(&hand.driven) {
            let angle: f64 = driven.iter().map(|&joint| self.sim.qpos()[hand.joints[joint].qpos]).sum();
            *target = angle.clamp(actuator.range[0], actuator.range[1]);
        }
        self.send(targets);
        self.servos.reset(targets, self.conditions.delay(&self.task));
        self.previous_action = [0.0; ACTION_SIZE];
        (self.age, self.held) = (0, 0);
        self.episode = EpisodeStats { randomized: self.conditions.draw().is_some(), ..Default::default() };
        self.last = StepDetails::default();
        self.recorder.clear();
        self.sim.refresh();
        self.observe(observation);
    }

    fn skip_ahead(&mut self, share: f64) {
        self.age = (share * f64::from(self.task.config.max_episode_steps())) as u32;
    }

    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition {
        let rot_dist_before = self.rot_dist();
        let sent = self.actuate(action);
        let push = self.conditions.push(&self.rng, self.episode.length, &mut self.sim, &self.task);
        self.recorder.record(&self.sim, action, push);
        let diverged = self.sim.step(self.task.config.substeps()) == Physics::Diverged;
        if diverged {
            // MuJoCo may have cleared the controls; restore what was sent for anyone who reads them.
            self.send(sent);
        }

        let config = &self.task.config;
        let Pose { position, orientation } = self.cube();
        let rot_dist = quat::angle_between(orientation, self.goal);
        let offset = [0, 1, 2].map(|axis| position[axis] - config.goal_position[axis]);
        let goal_dist = offset.iter().map(|x| x * x).sum::<f64>().sqrt();
        let reward = match diverged {
            true => RewardTerms::default(),
            false => RewardTerms::of_step(config, rot_dist, goal_dist, &self.previous_action),
        };
        self.last = StepDetails { goal: self.goal, rot_dist, goal_dist, reward, diverged, push };

        self.age += 1;
        self.episode.length += 1;
        self.episode.reward += reward;
        self.episode.diverged = diverged;
        self.episode.dropped = !diverged && goal_dist >= self.task.config.fall_dist;
        self.recent.steps += 1;
        self.recent.reward += reward;
        self.recent.diverged += u64::from(diverged);
        let (mut shaping, mut reached) = (Shaping::default(), false);
        if diverged {
            let (length, draw) = (self.episode.length, self.conditions.draw().cloned());
            self.diverged = self.recorder.tail().map(|tail| Diverged { length, draw, tail });
        } else {
            self.episode.rot_dist_sum += rot_dist;
            self.episode.in_tolerance += u32::from(rot_dist <= self.task.config.success_tolerance);
            let within = rot_dist <= self.lesson.tolerance;
            reached = self.hold(within);
            shaping = self.lesson.shaping(rot_dist_before, rot_dist, within, self.episode.dropped);
            self.recent.shaping += shaping;
        }

        let end = if diverged || self.episode.dropped {
            Some(End::Terminated)
        } else {
            let time_is_up = self.age >= self.task.config.max_episode_steps();
            let goal_ends = if reached { self.lesson.goals_end } else { self.gives_up() };
            time_is_up.then_some(End::Truncated).or(goal_ends.then_some(End::Redirected))
        };
        // Where reaching a goal ends it, the final observation must still show it, since its value is bootstrapped.
        if reached && !self.lesson.goals_end {
            self.replace_goal();
        }
        self.observe(observation);
        Transition { reward: self.lesson.total(reward.total(), shaping) as f32, end }
    }

    /// Draws another goal and resets the hold counter.
    fn redirect(&mut self, observation: &mut [f32]) {
        self.replace_goal();
        self.observe(observation);
    }

    fn episode(&self) -> EpisodeStats {
        self.episode
    }
}

impl Resumable for Repose {
    fn save(&self, state: &mut EnvState) {
        state.numbers.extend(self.sim.state().numbers());
        state.numbers.extend(self.goal);
        state.numbers.extend(self.previous_action.map(f64::from));
        state.numbers.extend(self.servos.last());
        state.counters.extend(rng::position(&self.rng));
        state.counters.extend([self.age, self.held].map(u64::from));
        state.counters.push(u64::from(self.episode.randomized));
        self.episode.save(state);
        // Always the same number of values.
        state.numbers.extend(self.servos.under_way(self.conditions.most_delay(&self.task)).flatten());
    }

    fn restore(&mut self, state: &mut SavedEnv, observation: &mut [f32]) -> Result<()> {
        self.rng = rng::at(state.counters()?);
        let [age, held] = state.counters()?;
        // `age` has no tighter limit: a fork may have shorter episodes.
        let possible = age <= u64::from(u32::MAX / 2) && held <= age;
        ensure!(possible, "impossible episode: at step {age} its goal has been held for {held} steps");
        (self.age, self.held) = (age as u32, held as u32);
        // Older versions did not save whether the episode is randomised. The share was constant; a fork may have another one.
        let is_saved = state.counters_left() > EpisodeStats::COUNTERS;
        let randomized = if is_saved {
            let [flag] = state.counters()?;
            ensure!(flag <= 1, "an episode is randomised or not, but the state says {flag}");
            flag as f64
        } else {
            self.lesson.randomized
        };
        self.conditions.begin(&self.rng, randomized, &mut self.sim, &self.task);
        let fixed = 4 + 2 * ACTION_SIZE + EpisodeStats::NUMBERS;
        // A fork may have other delays than its parent.
        let under_way = state.numbers_left().saturating_sub(self.sim.state_size() + fixed) / ACTION_SIZE;
        self.sim.restore(state.numbers_but(fixed + under_way * ACTION_SIZE)?)?;
        // A fork may also have no forces on the cube, but its parent's state has one.
        self.sim.push(self.task.hand.cube.body, [0.0; 3]);
        self.goal = state.numbers()?;
        let length = self.goal.iter().map(|x| x * x).sum::<f64>().sqrt();
        ensure!((length - 1.0).abs() < 1e-6, "the goal is not a unit quaternion: {:?}", self.goal);
        self.previous_action = state.numbers()?.map(|x| x as f32);
        let clipped = self.previous_action.iter().all(|action| (-1.0..=1.0).contains(action));
        ensure!(clipped, "the previous action is outside [-1, 1]: {:?}", self.previous_action);
        let targets = state.numbers()?;
        self.episode = EpisodeStats { randomized: self.conditions.draw().is_some(), ..EpisodeStats::saved(state)? };
        let under_way: Vec<Targets> = (0..under_way).map(|_| state.numbers()).collect::<Result<_>>()?;
        self.servos.restore(targets, &under_way, self.conditions.delay(&self.task));
        self.recent = Recent::default();
        self.last = StepDetails::default();
        self.recorder.clear();
        self.observe(observation);
        Ok(())
    }
}
