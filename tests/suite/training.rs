//! What only training changes: lessons, and what a policy takes to be the same.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use shadow_repose::collect::{Scratch, collect};
use shadow_repose::config::{Config, Override, Symmetry};
use shadow_repose::env::{
    CUBE_ORIENTATION, End, Env, EnvPool, GOAL_ORIENTATION, Lesson, OBSERVATION_SIZE, Repose, StepBuffers,
};
use shadow_repose::perception::perception;
use shadow_repose::ppo::Ppo;
use shadow_repose::quat;
use shadow_repose::rng;

use crate::support::{config, started, task};

/// A lesson that differs from the task in these settings only.
fn lesson(env_steps: u64, settings: &[&str]) -> Lesson {
    let settings: Vec<Override> = settings.iter().map(|setting| setting.parse().unwrap()).collect();
    let config = Config::from_text(Path::new("config.toml"), "", &settings).unwrap();
    Lesson::at(env_steps, &config.training, &config.env)
}

fn start(env: &mut Repose, episode: u64) -> Vec<f32> {
    let mut observation = vec![0.0; OBSERVATION_SIZE];
    env.reset(rng::stream(7, "test", episode), &mut observation);
    observation
}

#[test]
fn a_cube_turned_onto_itself_moves_the_same_way_and_looks_the_same_to_the_policy() {
    // A hand that moves slowly, to which the cube falls.
    let task = task(&["env.act_moving_average=0.05"]);
    let cube = task.scene().free_body("cube").unwrap().qpos;
    let (half, root) = (0.5, std::f64::consts::FRAC_1_SQRT_2);
    for (episode, turn) in
        [[root, 0.0, root, 0.0], [half, -half, half, half], [0.0, 0.0, root, -root]].iter().enumerate()
    {
        let (mut one, mut other) = (Repose::new(&task), Repose::new(&task));
        let (mut seen, mut other_seen) = (start(&mut one, episode as u64), start(&mut other, episode as u64));
        let orientation = *other.simulation().qpos()[cube + 3..].first_chunk().unwrap();
        other.simulation_mut().qpos_mut()[cube + 3..cube + 7].copy_from_slice(&quat::mul(orientation, *turn));
        other.simulation_mut().refresh();
        // Contacts amplify rounding: after some more steps of a moving hand, no two cubes lie alike.
        for step in 0..15 {
            let action = [0.3 * (step as f32 / 5.0).sin(); 20];
            let _ = one.step(&action, &mut seen);
            let _ = other.step(&action, &mut other_seen);
        }
        let moved = seen[48..51].iter().zip(&other_seen[48..51]).all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(moved, "{:?} and {:?}", &seen[48..51], &other_seen[48..51]);
        let apart = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart(&seen[51..55], &other_seen[51..55]) > 0.1, "they lie differently");
        for row in [&mut seen, &mut other_seen] {
            perception(Symmetry::Cube)(row);
        }
        // All but the goals, which were drawn for cubes that lie differently.
        for same in [0..64, 72..157] {
            assert!(apart(&seen[same.clone()], &other_seen[same]) < 0.02, "{seen:?}\n{other_seen:?}");
        }
    }
}

#[test]
fn a_lesson_decides_what_reaches_a_goal_and_which_goals_are_drawn() {
    let task = task(&[]);
    let mut env = Repose::new(&task);
    let easy = ["training.tolerance_start=3.2", "training.tolerance_steps=1000"];
    let easy = [&easy[..], &["training.hold_start=1", "training.hold_steps=1000"]].concat();
    let near = ["training.goal_angle_start=0.3", "training.goal_angle_steps=1000"];
    env.set_lesson(lesson(0, &[&easy[..], &near].concat()));
    let mut observation = start(&mut env, 0);
    for goals in 1..=20 {
        let before = env.goal();
        let _ = env.step(&[0.0; 20], &mut observation);
        assert_eq!(env.episode().goals, goals, "every step reaches one");
        assert!(env.goal() != before && env.rot_dist() <= 0.3, "{}", env.rot_dist());
    }
    let in_tolerance = env.episode().in_tolerance;
    assert!(in_tolerance < 20, "what is within the tolerance of the task is counted by that: {in_tolerance}");
    // Later the lesson is the task itself.
    env.set_lesson(lesson(1000, &[&easy[..], &near].concat()));
    let mut farthest = 0.0f64;
    for episode in 0..30 {
        observation = start(&mut env, episode);
        farthest = farthest.max(env.rot_dist());
        let _ = env.step(&[0.0; 20], &mut observation);
        assert_eq!(env.episode().goals, 0);
    }
    assert!(farthest > 2.5, "{farthest}");
}

#[test]
fn episodes_of_training_can_be_shorter_than_those_that_are_scored() {
    let mut env = Repose::new(&task(&[]));
    let mut length = |seconds: &str, share: f64| {
        env.set_lesson(lesson(0, &[&format!("training.episode_seconds={seconds}")]));
        let mut observation = start(&mut env, 0);
        env.skip_ahead(share);
        (1..).find(|_| env.step(&[0.0; 20], &mut observation).end == Some(End::Truncated)).unwrap()
    };
    assert_eq!([length("0.1", 0.0), length("0.1", 0.5), length("0", 0.0)], [10, 5, 1000]);
    assert_eq!(length("20", 0.0), 1000, "never longer");
}

#[test]
fn a_lesson_changes_what_is_learned_from_and_not_what_is_scored() {
    let task = task(&[]);
    let (mut plain, mut observation) = started(&task);
    let (mut shaped, _) = started(&task);
    // A tolerance so wide that a task paid by it would pay a bonus all the time.
    let wide = ["training.tolerance_start=3.2", "training.tolerance_steps=1000", "training.hold_start=50"];
    let paid = ["training.task_reward=0.5", "training.progress_reward=100", "training.hold_steps=0"];
    shaped.set_lesson(lesson(0, &[&wide[..], &paid].concat()));
    for _ in 0..20 {
        let before = shaped.rot_dist();
        let expected = plain.step(&[0.3; 20], &mut observation);
        let found = shaped.step(&[0.3; 20], &mut observation);
        let progress = 100.0 * (before - shaped.last_step().rot_dist);
        let paid = 0.5 * plain.last_step().reward.total() + progress;
        assert!((f64::from(found.reward) - paid).abs() < 1e-4, "{found:?} {paid}");
        assert_eq!(found.end, expected.end);
        assert_eq!(shaped.last_step().reward, plain.last_step().reward);
    }
    assert_eq!(shaped.episode(), plain.episode());
    let recent = shaped.take_recent();
    assert!(recent.shaping.progress != 0.0 && recent.reward == plain.take_recent().reward);
}

/// Where everything is after a second of a swinging hand.
fn after_a_second(settings: &[&str]) -> Vec<f64> {
    let task = task(settings);
    let (mut env, mut observation) = started(&task);
    for step in 0..100 {
        let _ = env.step(&[0.3 * (step as f32 / 15.0).sin(); 20], &mut observation);
    }
    env.simulation().qpos().to_vec()
}

#[test]
fn friction_and_the_mass_of_the_cube_are_scaled_as_if_the_scene_said_so() {
    let folder = tempfile::tempdir().unwrap();
    let scene = include_str!("../../assets/shadow_hand/scene.xml");
    let said = |replacements: &[[&str; 2]]| {
        let path = folder.path().join("scene.xml");
        let text = replacements.iter().fold(scene.to_owned(), |text, [from, to]| {
            assert!(text.contains(from));
            text.replace(from, to)
        });
        std::fs::write(&path, text).unwrap();
        after_a_second(&[&format!("env.model={}", path.display())])
    };
    let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let unchanged = after_a_second(&[]);
    assert_eq!(unchanged, after_a_second(&["env.friction_scale=1", "env.cube_mass_scale=1"]));
    let heavy = after_a_second(&["env.cube_mass_scale=2"]);
    let heavy_in_the_scene = said(&[[r#"mass=".028""#, r#"mass=".056""#]]);
    assert!(apart(&heavy, &heavy_in_the_scene) < 1e-4, "{heavy:?}\n{heavy_in_the_scene:?}");
    assert!(apart(&heavy, &unchanged) > 1e-3);
    let slippery = after_a_second(&["env.friction_scale=0.5"]);
    let all = [r#"<geom solref=".005 1""#, r#"<geom friction=".5 .0025 .00005" solref=".005 1""#];
    let slippery_in_the_scene = said(&[all, [r#"friction="1.2""#, r#"friction=".6 .0025 .00005""#]]);
    assert!(apart(&slippery, &slippery_in_the_scene) < 1e-4, "{slippery:?}\n{slippery_in_the_scene:?}");
    assert!(apart(&slippery, &unchanged) > 1e-3);
}

#[test]
fn a_pool_gives_the_policy_what_it_looks_at_and_an_environment_what_is_there() {
    let task = task(&["env.max_episode_seconds=0.05"]);
    let rows = |perceive: fn(&mut [f32])| {
        let mut pool = EnvPool::new(3, (0..4).map(|_| Repose::new(&task)).collect());
        pool.perceive_with(perceive);
        let mut all = Vec::new();
        let (mut observations, mut last) = (vec![0.0; 4 * OBSERVATION_SIZE], vec![0.0; 4 * OBSERVATION_SIZE]);
        pool.reset(vec![&mut observations]);
        all.extend_from_slice(&observations);
        let mut truncated = 0;
        for _ in 0..6 {
            let (rewards, ends) = (&mut [0.0; 4], &mut [None; 4]);
            let buffers = StepBuffers { rewards, ends, observations: &mut observations, final_observations: &mut last };
            pool.blocks_mut()[0].step(&[0.3; 80], buffers).unwrap();
            truncated += ends.iter().flatten().count();
            all.extend(observations.iter().chain(&last));
        }
        assert!(truncated >= 4, "{truncated}");
        let saved = pool.save();
        pool.restore(&saved, vec![&mut observations]).unwrap();
        all.extend_from_slice(&observations);
        all
    };
    let raw = rows(|_| {});
    let mut expected = raw.clone();
    expected.chunks_exact_mut(OBSERVATION_SIZE).for_each(perception(Symmetry::Cube));
    assert!(expected != raw, "cubes lie in many ways");
    assert!(rows(perception(Symmetry::Cube)) == expected);
}

#[test]
fn goals_that_live_for_some_steps_are_replaced_under_way_and_the_policy_sees_what_it_had_and_what_it_gets() {
    let task = task(&[]);
    let lesson = lesson(0, &["training.goal_lifetime=20"]);
    let envs = (0..8).map(|_| Repose::new(&task)).map(|mut env| {
        env.set_lesson(lesson);
        env
    });
    let mut pool = EnvPool::new(3, envs.collect());
    let (mut observations, mut last) = (vec![0.0; 8 * OBSERVATION_SIZE], vec![0.0; 8 * OBSERVATION_SIZE]);
    pool.reset(vec![&mut observations]);
    let mut redirected = 0;
    for _ in 0..200 {
        let before: Vec<_> = pool.envs_mut().map(|env| (env.goal(), env.episode().length)).collect();
        let (rewards, ends) = (&mut [0.0; 8], &mut [None; 8]);
        let buffers = StepBuffers { rewards, ends, observations: &mut observations, final_observations: &mut last };
        pool.blocks_mut()[0].step(&[0.0; 160], buffers).unwrap();
        for (i, (env, (goal, length))) in pool.envs_mut().zip(before).enumerate() {
            let row = i * OBSERVATION_SIZE..(i + 1) * OBSERVATION_SIZE;
            let (seen, under_the_old) = (&observations[row.clone()], &last[row]);
            let shown = quat::canonical(env.goal()).map(|x| x as f32);
            assert_eq!(seen[GOAL_ORIENTATION..GOAL_ORIENTATION + 4], shown);
            if ends[i] != Some(End::Redirected) {
                continue;
            }
            redirected += 1;
            assert!(env.goal() != goal && env.episode().length == length + 1, "the episode goes on");
            let old = quat::canonical(goal).map(|x| x as f32);
            assert_eq!(under_the_old[GOAL_ORIENTATION..GOAL_ORIENTATION + 4], old);
            for same in [0..GOAL_ORIENTATION, GOAL_ORIENTATION + 8..OBSERVATION_SIZE] {
                assert_eq!(seen[same.clone()], under_the_old[same], "nothing has moved");
            }
        }
    }
    assert!((50..120).contains(&redirected), "80 are expected: {redirected}");
}

#[test]
fn a_goal_that_was_reached_can_be_worth_as_much_as_if_it_stayed() {
    let task = task(&[]);
    let always = ["training.tolerance_start=3.2", "training.tolerance_steps=1000", "training.hold_start=4"];
    for bootstrap in [true, false] {
        let key = format!("training.bootstrap_reached={bootstrap}");
        let mut env = Repose::new(&task);
        env.set_lesson(lesson(0, &[&always[..], &["training.hold_steps=1000", &key]].concat()));
        let mut observation = start(&mut env, 0);
        for step in 1..=12 {
            let goal = env.goal();
            let end = env.step(&[0.0; 20], &mut observation).end;
            let reached = step % 4 == 0;
            assert_eq!(end, (reached && bootstrap).then_some(End::Redirected), "step {step}");
            if end.is_some() {
                assert!(env.goal() == goal, "what is bootstrapped is the goal that was reached");
                env.redirect(&mut observation);
            }
            assert_eq!(env.goal() != goal, reached, "step {step}");
            assert_eq!(env.episode().goals, step / 4);
            let shown = quat::canonical(env.goal()).map(|x| x as f32);
            assert_eq!(observation[GOAL_ORIENTATION..GOAL_ORIENTATION + 4], shown);
        }
        // Where time is up on the step that reaches it, the last observation is bootstrapped all the same.
        env.skip_ahead(0.996);
        let goal = env.goal();
        let ends = [0, 1, 2, 3].map(|_| env.step(&[0.0; 20], &mut observation).end);
        assert_eq!((ends[3], env.goal() == goal), (Some(End::Truncated), bootstrap), "{ends:?}");
    }
}

#[test]
fn far_from_the_goal_actions_have_a_larger_noise_that_the_losses_know() {
    let away = ["ppo.init_std=0.5", "ppo.away_std=1.5", "ppo.away_range=[0.15,0.5]"];
    let sets = [&["env.num_envs=64", "ppo.minibatches=4", "ppo.hidden=[16]"][..], &away].concat();
    let (config, task) = (config(&sets), task(&[]));
    let envs = (0..64).map(|i| {
        let angle = if i % 2 == 0 { 0.1 } else { 3.1 };
        let mut env = Repose::new(&task);
        env.set_lesson(lesson(0, &[&format!("training.goal_angle_start={angle}"), "training.goal_angle_steps=1000"]));
        env
    });
    let mut pool = EnvPool::new(3, envs.collect());
    let mut ppo = Ppo::new(&config.ppo, OBSERVATION_SIZE, 20, 3).unwrap();
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    let never = AtomicBool::new(false);
    assert!(collect(&mut pool, &ppo, &mut rollout, 1, &mut scratch, &never).unwrap());
    // Squares of the distances from the mean, and numbers of them, of those near the goal and of those far from it.
    let mut spread = [[0.0; 2]; 2];
    for block in &rollout.blocks {
        for (i, row) in block.acted_on().chunks_exact(OBSERVATION_SIZE).enumerate() {
            let orientation = |at: usize| [0, 1, 2, 3].map(|j| f64::from(row[at + j]));
            let error = quat::angle_between(orientation(CUBE_ORIENTATION), orientation(GOAL_ORIENTATION));
            let expected = 1.0 + 2.0 * ((error - 0.15) / 0.35).clamp(0.0, 1.0);
            let found = f64::from(block.noise_scales[i]);
            assert!((found - expected).abs() < 0.02, "{found} instead of {expected} at {error} rad");
            if expected == 1.0 || expected == 3.0 {
                let [sum, count] = &mut spread[usize::from(expected == 3.0)];
                for j in 20 * i..20 * (i + 1) {
                    *sum += f64::from(block.actions[j] - block.means[j]).powi(2);
                    *count += 1.0;
                }
            }
        }
    }
    for ([sum, count], expected) in spread.into_iter().zip([0.5, 1.5]) {
        let std = f64::sqrt(sum / count);
        assert!(count > 200.0 && (std / expected - 1.0).abs() < 0.1, "{std} instead of {expected}, {count}");
    }
    let stats = ppo.update(&mut rollout, 1, &never).unwrap().unwrap();
    assert!(stats.first_kl.abs() < 1e-5 && stats.first_ratio_error < 1e-3, "{stats:?}");
}

#[test]
fn values_are_clipped_like_ratios_unless_something_else_is_said() {
    let clip = |sets: &[&str]| config(sets).ppo.value_clip();
    assert_eq!(clip(&["ppo.clip=0.3", "ppo.value_clip=0"]), 0.3);
    assert_eq!(clip(&["ppo.clip=0.3", "ppo.value_clip=7"]), 7.0);
}
