//! One environment: its observations, its rewards and its ends.

use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::atomic::AtomicBool;

use shadow_repose::env::{End, Env};
use shadow_repose::ppo::Checkpoint;
use shadow_repose::quat::{self, Quat};
use shadow_repose::repose::{Repose, Step, Task, task_reward};
use shadow_repose::rng;
use shadow_repose::sim::{Pose, Velocity};

use crate::support::{OBSERVATION_SIZE, config, env_config, started, started_agent, task};

const STILL: [f32; 20] = [0.0; 20];

fn object_at(task: &Task) -> usize {
    task.scene.free_body("cube").unwrap().qpos
}

/// Puts the cube at the goal position, turned to `orientation`, at rest.
fn put_object(env: &mut Repose, task: &Task, orientation: Quat) {
    let object = task.scene.free_body("cube").unwrap();
    let simulation = &mut env.sim;
    simulation.qpos_mut()[object.qpos..object.qpos + 3].copy_from_slice(&[0.33, 0.0, 0.295]);
    simulation.qpos_mut()[object.qpos + 3..object.qpos + 7].copy_from_slice(&orientation);
    simulation.qvel_mut()[object.dof..object.dof + 6].fill(0.0);
    simulation.refresh();
}

#[track_caller]
fn assert_close(found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    let close = found
        .iter()
        .zip(expected)
        .all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6 * (1.0 + b.abs()));
    assert!(close, "{found:?}\n{expected:?}");
}

#[test]
fn observations_land_at_their_indices() {
    let task = task(&[]);
    let (mut env, mut observation) = started(&task);
    let hand = &task.hand;
    let object = hand.object;
    // A quarter turn about z, with w < 0: the observation shows the opposite sign.
    let orientation = [-FRAC_1_SQRT_2, 0.0, 0.0, -FRAC_1_SQRT_2];
    put_object(&mut env, &task, orientation);
    for i in 0..24 {
        let (low, high) = (hand.joints[i].range[0], hand.joints[i].range[1]);
        env.sim.qpos_mut()[hand.joints[i].qpos] = low + (high - low) * (i as f64 + 1.0) / 30.0;
        env.sim.qvel_mut()[hand.joints[i].dof] = 0.1 * i as f64;
    }
    env.sim.qvel_mut()[object.dof..object.dof + 6].copy_from_slice(&[0.1, 0.2, 0.3, 1.0, 2.0, 3.0]);
    env.sim.refresh();
    env.observe(&mut observation);

    let order = [
        "THJ5", "THJ4", "THJ3", "THJ2", "THJ1", "FFJ4", "FFJ3", "FFJ2", "FFJ1", "MFJ4", "MFJ3",
        "MFJ2", "MFJ1", "RFJ4", "RFJ3", "RFJ2", "RFJ1", "LFJ5", "LFJ4", "LFJ3", "LFJ2", "LFJ1",
        "WRJ2", "WRJ1",
    ];
    for (i, name) in order.iter().enumerate() {
        let joint = task.scene.hinge(&format!("rh_{name}")).unwrap();
        assert_close(&observation[i..=i], &[env.sim.qpos()[joint.qpos]]);
        assert_close(
            &observation[24 + i..=24 + i],
            &[0.2 * env.sim.qvel()[joint.dof]],
        );
    }
    assert_close(&observation[48..51], &[0.33, 0.0, 0.295]);
    assert_close(
        &observation[51..55],
        &[FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2],
    );
    assert_close(&observation[55..58], &[0.1, 0.2, 0.3]);
    // Body frame (1, 2, 3), a quarter turn about z: (-2, 1, 3) in the world, times 0.2.
    assert_close(&observation[58..61], &[-0.4, 0.2, 0.6]);
    assert_close(&observation[61..64], &[0.33, 0.0, 0.295]);
    assert_close(&observation[64..68], &quat::canonical(env.goal));
    let relative = quat::canonical(quat::mul(orientation, quat::conj(env.goal)));
    assert_close(&observation[68..72], &relative);
    for (i, name) in [
        "rh_ffdistal",
        "rh_mfdistal",
        "rh_rfdistal",
        "rh_lfdistal",
        "rh_thdistal",
    ]
    .iter()
    .enumerate()
    {
        let body = task.scene.frame(name).unwrap();
        let Pose {
            position,
            orientation: turned,
        } = env.sim.pose(body);
        let Velocity { linear, angular } = env.sim.velocity(body);
        let expected: Vec<f64> = position
            .into_iter()
            .chain(turned)
            .chain(linear)
            .chain(angular)
            .collect();
        assert_close(&observation[72 + 13 * i..85 + 13 * i], &expected);
        assert!(linear.iter().any(|v| v.abs() > 1e-3), "{name} moves");
    }
    assert_close(&observation[OBSERVATION_SIZE - 20..], &[0.0; 20]);
}

#[test]
fn fingertip_velocities_are_those_of_the_frames_origin() {
    let task = task(&[]);
    let (mut env, _) = started(&task);
    let tip = task.scene.frame("rh_mfdistal").unwrap();
    let joint = task.scene.hinge("rh_MFJ3").unwrap();
    let simulation = &mut env.sim;
    simulation.qvel_mut().fill(0.0);
    simulation.qvel_mut()[joint.dof] = 2.0;
    simulation.refresh();
    let Velocity { linear, angular } = simulation.velocity(tip);
    let before = simulation.pose(tip).position;
    let step = 1e-6;
    simulation.qpos_mut()[joint.qpos] += 2.0 * step;
    simulation.refresh();
    let after = simulation.pose(tip).position;
    for axis in 0..3 {
        assert!((linear[axis] - (after[axis] - before[axis]) / step).abs() < 1e-4);
    }
    assert!((angular.iter().map(|x| x * x).sum::<f64>().sqrt() - 2.0).abs() < 1e-9);
}

#[test]
fn actions_are_clipped_and_scaled_to_the_control_ranges() {
    let task = task(&["env.act_moving_average=1"]);
    let hand = &task.hand;
    let (mut env, mut observation) = started(&task);
    let mut action = [0.0f32; 20];
    (action[0], action[7], action[19]) = (3.0, -1.5, 0.5);
    let _ = env.step(&action, &mut observation);
    let ctrl = |i: usize| env.sim.ctrl()[hand.actuators[i].ctrl];
    assert_eq!(ctrl(0), 1.0472);
    assert_eq!(ctrl(7), 0.0);
    let [low, high] = hand.actuators[19].range;
    assert!((ctrl(19) - (low + 0.75 * (high - low))).abs() < 1e-12);
    assert_close(&observation[OBSERVATION_SIZE - 20..], &{
        let mut expected = [0.0; 20];
        (expected[0], expected[7], expected[19]) = (1.0, -1.0, 0.5);
        expected
    });
    // The penalty is computed from the clipped action.
    assert!((env.last.reward[2] - -0.0002 * (1.0 + 1.0 + 0.25)).abs() < 1e-12);
}

#[test]
fn smoothing_averages_targets_and_begins_at_the_reset_joints() {
    let task = task(&["env.act_moving_average=0.25"]);
    let hand = &task.hand;
    let (mut env, mut observation) = started(&task);
    let angle = |env: &Repose, name: &str| env.sim.qpos()[task.scene.hinge(name).unwrap().qpos];
    let (single, coupled) = (
        angle(&env, "rh_FFJ3"),
        angle(&env, "rh_FFJ2") + angle(&env, "rh_FFJ1"),
    );
    assert!(coupled > 0.0, "the noise has moved the coupled joints");
    let _ = env.step(&[1.0; 20], &mut observation);
    let ctrl = |env: &Repose, i: usize| env.sim.ctrl()[hand.actuators[i].ctrl];
    assert!((ctrl(&env, 6) - (0.25 * 1.5708 + 0.75 * single)).abs() < 1e-12);
    let first = 0.25 * 3.1415 + 0.75 * coupled;
    assert!((ctrl(&env, 7) - first).abs() < 1e-12);
    let _ = env.step(&[-1.0; 20], &mut observation);
    assert!((ctrl(&env, 7) - 0.75 * first).abs() < 1e-12);
}

#[test]
fn a_goal_is_reached_after_enough_steps_within_tolerance_and_the_episode_goes_on() {
    let task = task(&["env.max_consecutive_successes=3"]);
    let (mut env, mut observation) = started(&task);
    let goal = env.goal;
    for held in [1, 2, 0] {
        put_object(&mut env, &task, goal);
        let transition = env.step(&STILL, &mut observation);
        let details = env.last.clone();
        assert_eq!(
            (details.goal, details.reward[3], transition.end),
            (goal, 2.0, None)
        );
        assert!(details.rot_dist < 0.1);
        // The reward is computed against the goal in force.
        let rotation = 1.0 / (details.rot_dist + 0.1);
        assert!((details.reward[0] - rotation).abs() < 1e-12);
        assert!((f64::from(transition.reward) - details.reward.iter().sum::<f64>()).abs() < 1e-5);
        assert_eq!(env.held, held);
    }
    assert_eq!((env.episode().goals, env.episode().in_tolerance), (1, 3));
    assert_ne!(env.goal, goal);
    // The observation already shows the next goal.
    assert_close(&observation[64..68], &quat::canonical(env.goal));
}

#[test]
fn steps_outside_the_tolerance_leave_a_cumulative_counter_alone_and_clear_a_consecutive_one() {
    for (mode, held) in [("cumulative", 2), ("consecutive", 1)] {
        let task = task(&[&format!("env.success_hold={mode}")]);
        let (mut env, mut observation) = started(&task);
        let goal = env.goal;
        let away = quat::mul(goal, [FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0, 0.0]);
        for orientation in [goal, away, goal] {
            put_object(&mut env, &task, orientation);
            let _ = env.step(&STILL, &mut observation);
        }
        assert_eq!(env.held, held, "{mode}");
        assert_eq!(env.episode().in_tolerance, 2);
    }
}

#[test]
fn a_dropped_cube_terminates_and_pays_the_penalty() {
    let task = task(&["env.fall_penalty=-5"]);
    let (mut env, mut observation) = started(&task);
    let height = object_at(&task) + 2;
    env.sim.qpos_mut()[height] = 0.295 - 0.241;
    env.sim.refresh();
    let transition = env.step(&STILL, &mut observation);
    assert_eq!(transition.end, Some(End::Terminated));
    assert!(env.episode().dropped && !env.episode().diverged);
    assert_eq!(env.last.reward[4], -5.0);
    assert!((env.last.reward[1] + 10.0 * env.last.goal_dist).abs() < 1e-12);
}

#[test]
fn time_running_out_truncates_and_is_no_drop() {
    let task = task(&["env.max_episode_seconds=0.05"]);
    let (mut env, mut observation) = started(&task);
    for _ in 0..4 {
        assert_eq!(env.step(&STILL, &mut observation).end, None);
    }
    assert_eq!(env.step(&STILL, &mut observation).end, Some(End::Truncated));
    assert!(!env.episode().dropped);
    assert_eq!(env.episode().length, 5);
}

#[test]
fn a_diverged_state_terminates_pays_nothing_and_leaves_no_trace_in_the_next_episode() {
    let task = task(&[]);
    let (mut env, mut observation) = started(&task);
    for (poison, name) in [(f64::NAN, "NaN"), (1e12, "a huge number")] {
        let (mut fresh, mut expected) = started(&task);
        env.sim.qpos_mut()[3] = poison;
        let transition = env.step(&[0.5; 20], &mut observation);
        assert_eq!(transition.end, Some(End::Terminated), "{name}");
        assert_eq!(transition.reward, 0.0);
        assert!(env.episode().diverged && env.last.diverged && !env.episode().dropped);
        assert!(observation.iter().all(|x| x.is_finite()));
        assert_eq!(env.take_sums().diverged, 1);
        assert!(
            env.sim.ctrl().iter().any(|&c| c != 0.0),
            "the controls that were sent are still there"
        );
        env.reset(rng::stream(7, "test", 0), &mut observation);
        for _ in 0..10 {
            let _ = env.step(&[0.2; 20], &mut observation);
            let _ = fresh.step(&[0.2; 20], &mut expected);
        }
        assert_eq!(observation, expected, "after {name}");
        assert!(!env.episode().diverged);
    }
}

#[test]
fn an_action_that_is_not_a_number_ends_the_episode_as_diverged() {
    let task = task(&[]);
    let (mut env, mut observation) = started(&task);
    let mut action = STILL;
    action[3] = f32::NAN;
    assert_eq!(
        env.step(&action, &mut observation).end,
        Some(End::Terminated)
    );
    assert!(env.episode().diverged);
}

#[test]
fn resets_stay_within_the_noise_and_the_joints_limits() {
    let task = task(&["env.reset_dof_vel_noise=0.3"]);
    let hand = &task.hand;
    let mut env = Repose::new(&task);
    let mut observation = vec![0.0; OBSERVATION_SIZE];
    let (mut angles, mut starts) = (Vec::new(), Vec::new());
    for episode in 0..200 {
        env.reset(rng::stream(1, "test", episode), &mut observation);
        let (qpos, qvel) = (env.sim.qpos(), env.sim.qvel());
        for joint in &hand.joints {
            let angle = qpos[joint.qpos];
            assert!(angle.abs() <= 0.2 && (joint.range[0]..=joint.range[1]).contains(&angle));
            assert!(qvel[joint.dof].abs() <= 0.3);
        }
        let object = &qpos[hand.object.qpos..hand.object.qpos + 7];
        for (x, middle) in object.iter().zip([0.33, 0.0, 0.295]) {
            assert!((x - middle).abs() <= 0.01);
        }
        assert!(
            qvel[hand.object.dof..hand.object.dof + 6]
                .iter()
                .all(|&v| v == 0.0)
        );
        let orientation: Quat = object[3..].try_into().unwrap();
        angles.push(quat::angle_between(orientation, env.goal));
        starts.push(qpos[hand.joints[0].qpos]);
    }
    let mean = angles.iter().sum::<f64>() / angles.len() as f64;
    assert!(
        (mean - 2.21).abs() < 0.15,
        "cube and goal are independent and uniform: mean angle {mean}"
    );
    assert!(starts.iter().any(|&x| x > 0.15) && starts.iter().any(|&x| x < -0.15));
}

#[test]
fn nan_in_a_hundredth_of_the_environments_each_iteration_is_counted_and_learning_goes_on() {
    let config = config(&["env.num_envs=200", "ppo.hidden=[16]"]);
    let mut agent = started_agent(&Task::new(&config).unwrap(), &config);
    let never = AtomicBool::new(false);
    for iteration in 1..=6 {
        let poison = [f64::NAN, f64::INFINITY, -1e200][iteration % 3];
        for env in [iteration, 100 + iteration] {
            let simulation = &mut agent.pool.envs_mut().nth(env).unwrap().sim;
            simulation.qpos_mut()[7] = poison;
            simulation.qvel_mut()[20] = poison;
        }
        let stats = agent.iterate(&never).unwrap().update;
        assert!(stats.losses.value_error.is_finite() && stats.losses.kl.is_finite());
        let diverged: u64 = agent
            .pool
            .envs_mut()
            .map(|env| env.take_sums().diverged)
            .sum();
        assert_eq!(diverged, 2, "iteration {iteration}");
        assert_eq!(
            agent
                .pool
                .take_finished()
                .iter()
                .filter(|episode| episode.diverged)
                .count(),
            2,
            "only those episodes end"
        );
    }
    let mut end = Checkpoint::default();
    agent.save(&mut end);
    end.to_bytes().expect("all weights are finite");
}

#[test]
fn every_scale_of_the_reward_is_a_setting() {
    let step = |action| Step {
        rot_dist: 0.3,
        goal_dist: 0.1,
        action: vec![action; 20],
        ..Step::default()
    };
    let paid = |set: &str| task_reward(&env_config(&[set]), &step(0.5));
    let default = [1.0 / 0.4, -1.0, -0.0002 * 5.0, 0.0, 0.0];
    for (set, term, expected) in [
        ("run.seed=0", 0, default[0]),
        ("env.rot_reward_scale=3", 0, 3.0 / 0.4),
        ("env.rot_eps=0.2", 0, 1.0 / 0.5),
        ("env.dist_reward_scale=-7", 1, -0.7),
        ("env.action_penalty_scale=-0.1", 2, -0.5),
        ("env.success_tolerance=0.35", 3, 2.0),
    ] {
        for (i, (found, default)) in paid(set).into_iter().zip(default).enumerate() {
            let expected = if i == term { expected } else { default };
            assert!(
                (found - expected).abs() < 1e-12,
                "{set}: term {i} is {found}, not {expected}"
            );
        }
    }
    let both = env_config(&[
        "env.success_tolerance=0.35",
        "env.reach_goal_bonus=9",
        "env.fall_dist=0.05",
        "env.fall_penalty=-5",
    ]);
    assert_eq!(task_reward(&both, &step(0.0))[3..], [9.0, -5.0]);
}

#[test]
fn where_cube_and_target_are_and_how_an_episode_begins_are_settings() {
    let sets = [
        "env.goal_position=[0.3,0.02,0.31]",
        "env.target_height=0.4",
        "env.reset_position_noise=0",
    ];
    let task = task(
        &[
            &sets[..],
            &["env.reset_dof_pos_noise=0", "env.vel_obs_scale=0.5"],
        ]
        .concat(),
    );
    let (mut env, mut observation) = started(&task);
    assert_close(&observation[48..51], &[0.3, 0.02, 0.31]);
    assert_close(&observation[61..64], &[0.3, 0.02, 0.31]);
    let target = env.sim.pose(task.scene.frame("target").unwrap()).position;
    assert_close(&target.map(|x| x as f32), &[0.3, 0.02, 0.71]);
    assert_close(&observation[..24], &[0.0; 24]);
    let joint = task.hand.joints[3];
    env.sim.qvel_mut()[joint.dof] = 3.0;
    env.observe(&mut observation);
    assert_close(&observation[27..28], &[1.5]);
}
