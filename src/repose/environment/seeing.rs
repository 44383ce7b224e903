//! What is seen of the state of an environment: by its rewards, and by a policy.

use super::Repose;
use crate::quat;
use crate::repose::observation::Writer;
use crate::sim::{Pose, Simulation, Velocity};

impl Repose {
    /// The pose of the object.
    pub fn object(&self) -> Pose {
        self.sim.free_pose(&self.task.hand.object)
    }

    /// Records what the rewards of a step depend on, after its physics.
    pub fn measure(&mut self, rot_dist_before: f64) {
        let object = self.object();
        let task = &self.task;
        let last = &mut self.last;
        let offset =
            [0, 1, 2].map(|axis| object.position[axis] - task.config.goal_position.value[axis]);
        last.goal = self.goal;
        last.rot_dist_before = rot_dist_before;
        last.rot_dist = quat::angle_between(object.orientation, self.goal);
        last.goal_dist = quat::length(&offset);
        last.within = last.rot_dist <= self.lesson.tolerance;
        last.dropped = last.goal_dist >= task.config.fall_dist;
    }

    /// Writes the observation of the current state as the policy sees it: predicted, if the task asks for it, and mirrored, if its hand is
    /// on the other side.
    pub fn show(&mut self, observation: &mut [f32]) {
        self.observe(observation);
        self.predict(observation);
        if let Some(mirror) = &self.task.mirror {
            mirror.apply(observation);
        }
    }

    /// Replaces what was measured by what will be there after the last targets. If the prediction diverges, it stays as it is.
    fn predict(&mut self, observation: &mut [f32]) {
        let task = &self.task;
        let Some(predictor) = &task.predictor else {
            return;
        };
        let goal = Pose {
            position: task.goal_place(),
            orientation: self.goal,
        };
        match predictor.run(
            &task.hand,
            task.config.vel_obs_scale,
            observation,
            goal,
            &self.servos.last(task.config.prediction as usize),
        ) {
            Some(sim) => {
                self.write(&sim, observation);
                predictor.give_back(sim);
            }
            None => self.sums.unpredicted += 1,
        }
    }

    /// Writes the observation of the current state as it is measured, in the order of the hand's layout.
    pub fn observe(&self, observation: &mut [f32]) {
        self.write(&self.sim, observation);
        self.conditions
            .disturb(&self.rng, self.episode.length, &self.task, observation);
    }

    /// Writes the observation of a simulation under the current goal.
    fn write(&self, sim: &Simulation, observation: &mut [f32]) {
        let hand = &self.task.hand;
        let config = &self.task.config;
        let qpos = sim.qpos();
        let qvel = sim.qvel();
        let mut cells = Writer::new(&hand.layout, observation);
        cells.put(
            "joint_pos",
            hand.joints.iter().map(|joint| qpos[joint.qpos]),
        );
        cells.put(
            "joint_vel",
            hand.joints
                .iter()
                .map(|joint| config.vel_obs_scale * qvel[joint.dof]),
        );

        let Pose {
            position,
            orientation,
        } = sim.free_pose(&hand.object);
        let Velocity { linear, angular } = sim.free_velocity(&hand.object);
        cells.put("cube_pos", position);
        cells.put("cube_quat", quat::canonical(orientation));
        cells.put("cube_linvel", linear);
        cells.put("cube_angvel", angular.map(|x| config.vel_obs_scale * x));
        cells.put("goal_pos", config.goal_position.value);
        cells.put("goal_quat", quat::canonical(self.goal));
        cells.put(
            "relative_quat",
            quat::canonical(quat::mul(orientation, quat::conj(self.goal))),
        );

        for &tip in &hand.fingertips {
            let Pose {
                position,
                orientation,
            } = sim.pose(tip);
            let Velocity { linear, angular } = sim.velocity(tip);
            cells.put("fingertips", position);
            cells.put("fingertips", orientation);
            cells.put("fingertips", linear);
            cells.put("fingertips", angular);
        }
        cells.put(
            "previous_action",
            self.last.action.iter().copied().map(f64::from),
        );
        if hand.layout.told {
            cells.put("known", self.conditions.known(&self.task));
        }
        cells.finish();
    }
}
