//! What is seen of the state of an environment: by its rewards, and by a policy.

use super::Repose;
use crate::quat;
use crate::repose::observation::Writer;
use crate::sim::{Pose, Velocity};

impl Repose {
    /// The pose of the object.
    pub fn object(&self) -> Pose {
        let at = self.task.hand.object.qpos;
        let q = self.sim.qpos();
        Pose {
            position: [q[at], q[at + 1], q[at + 2]],
            orientation: [q[at + 3], q[at + 4], q[at + 5], q[at + 6]],
        }
    }

    /// Records what the rewards of a step depend on, after its physics.
    pub fn measure(&mut self, rot_dist_before: f64) {
        let object = self.object();
        let object_velocity = self.object_velocity();
        let task = &self.task;
        let last = &mut self.last;
        let qpos = self.sim.qpos();
        let qvel = self.sim.qvel();
        let offset =
            [0, 1, 2].map(|axis| object.position[axis] - task.config.goal_position.value[axis]);
        last.goal = self.goal;
        last.rot_dist_before = rot_dist_before;
        last.rot_dist = quat::angle_between(object.orientation, self.goal);
        last.goal_dist = quat::length(&offset);
        last.within = last.rot_dist <= self.lesson.tolerance;
        last.dropped = last.goal_dist >= task.config.fall_dist;
        last.object = object;
        last.object_velocity = object_velocity;
        let cells = last.joint_pos.iter_mut().zip(&mut last.joint_vel);
        for ((angle, speed), joint) in cells.zip(&task.hand.joints) {
            *angle = qpos[joint.qpos];
            *speed = qvel[joint.dof];
        }
    }

    /// The velocity of the object, in the world frame.
    fn object_velocity(&self) -> Velocity {
        let [vx, vy, vz, spin @ ..] = self.sim.qvel()[self.task.hand.object.dof..]
            .first_chunk::<6>()
            .expect("a free joint");
        // MuJoCo stores the angular velocity of a free joint in the body's frame.
        let angular = quat::rotate(self.object().orientation, *spin);
        Velocity {
            linear: [*vx, *vy, *vz],
            angular,
        }
    }

    /// Writes the observation of the current state as the policy sees it: mirrored, if its hand is on the other side.
    pub fn show(&self, observation: &mut [f32]) {
        self.observe(observation);
        if let Some(mirror) = &self.task.mirror {
            mirror.apply(observation);
        }
    }

    /// Writes the observation of the current state, in the order of the hand's layout.
    pub fn observe(&self, observation: &mut [f32]) {
        let hand = &self.task.hand;
        let config = &self.task.config;
        let qpos = self.sim.qpos();
        let qvel = self.sim.qvel();
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
        } = self.object();
        let Velocity { linear, angular } = self.object_velocity();
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
            } = self.sim.pose(tip);
            let Velocity { linear, angular } = self.sim.velocity(tip);
            cells.put("fingertips", position);
            cells.put("fingertips", orientation);
            cells.put("fingertips", linear);
            cells.put("fingertips", angular);
        }
        cells.put(
            "previous_action",
            self.last.action.iter().copied().map(f64::from),
        );
        cells.finish();
        self.conditions
            .disturb(&self.rng, self.episode.length, &self.task, observation);
    }
}
