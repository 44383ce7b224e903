//! Lessons, which only training uses, the symmetry of the cube, and the noise of the actions.

use std::fs;
use std::sync::atomic::AtomicBool;

use shadow_repose::agent::Agent;
use shadow_repose::config::{Override, Ramp};
use shadow_repose::env::{End, Env, EnvPool};
use shadow_repose::load::Loaded;
use shadow_repose::ppo::{Checkpoint, Normalizer, Perception};
use shadow_repose::quat::{self, Quat};
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::{Lesson, Repose};
use shadow_repose::rng;

use crate::support::{
    OBSERVATION_SIZE, config, program, started, started_agent, stderr, succeeded, task, train,
};

const OBJECT_ORIENTATION: usize = 51;
const GOAL_ORIENTATION: usize = 64;

/// Returns the lesson of the task itself with these settings applied over it.
fn lesson(env_steps: u64, settings: &[&str]) -> Lesson {
    // Every weight of a reward that training adds.
    let training = toml::Table::try_from(config(&[]).training).unwrap();
    let rewards = training
        .keys()
        .filter(|key| key.ends_with("_reward"))
        .map(|key| format!("{key}=0"));
    let task = ["task_reward=1", "tolerance=0.1", "hold=50", "assist=0"].map(String::from);
    let task: Vec<String> = rewards
        .chain(task)
        .map(|setting| format!("training.{setting}"))
        .collect();
    let mut all: Vec<&str> = task.iter().map(String::as_str).collect();
    all.extend(["training.goal_lifetime=0"]);
    all.extend(settings);
    Lesson::at(env_steps, &config(&all))
}

fn start(env: &mut Repose, episode: u64) -> Vec<f32> {
    let mut observation = vec![0.0; OBSERVATION_SIZE];
    env.reset(rng::stream(7, "test", episode), &mut observation);
    observation
}

#[test]
fn a_cube_turned_onto_itself_moves_the_same_way_and_looks_the_same_to_the_policy() {
    // The hand moves slowly while the cube falls onto it.
    let task = task(&["env.act_moving_average=0.05"]);
    let object = task.scene.free_body("cube").unwrap().qpos;
    let (half, root) = (0.5, std::f64::consts::FRAC_1_SQRT_2);
    for (episode, turn) in [
        [root, 0.0, root, 0.0],
        [half, -half, half, half],
        [0.0, 0.0, root, -root],
    ]
    .iter()
    .enumerate()
    {
        let (mut one, mut other) = (Repose::new(&task), Repose::new(&task));
        let (mut seen, mut other_seen) = (
            start(&mut one, episode as u64),
            start(&mut other, episode as u64),
        );
        let orientation = *other.sim.qpos()[object + 3..].first_chunk().unwrap();
        other.sim.qpos_mut()[object + 3..object + 7]
            .copy_from_slice(&quat::mul(orientation, *turn));
        other.sim.refresh();
        // Contacts amplify rounding errors: after some more steps of a moving hand, the two cubes no longer agree.
        for step in 0..15 {
            let action = [0.3 * (step as f32 / 5.0).sin(); 20];
            let _ = one.step(&action, &mut seen);
            let _ = other.step(&action, &mut other_seen);
        }
        let moved = seen[48..51]
            .iter()
            .zip(&other_seen[48..51])
            .all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(moved, "{:?} and {:?}", &seen[48..51], &other_seen[48..51]);
        let apart = |a: &[f32], b: &[f32]| {
            a.iter()
                .zip(b)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max)
        };
        assert!(
            apart(&seen[51..55], &other_seen[51..55]) > 0.1,
            "their orientations differ"
        );
        for row in [&mut seen, &mut other_seen] {
            Perception::new(&task.spaces(), &Normalizer::new(OBSERVATION_SIZE)).canonicalize(row);
        }
        // All but the goals: both environments drew the same one, for cubes of different orientation.
        for same in [0..64, 72..OBSERVATION_SIZE] {
            assert!(
                apart(&seen[same.clone()], &other_seen[same]) < 0.02,
                "{seen:?}\n{other_seen:?}"
            );
        }
    }
}

#[test]
fn a_lesson_decides_what_reaches_a_goal() {
    let task = task(&[]);
    let mut env = Repose::new(&task);
    let easy = [
        "training.tolerance={from=3.2,to=0.001,steps=1000}",
        "training.hold={from=1,to=50,steps=1000}",
    ];
    env.set_lesson(lesson(0, &easy));
    let mut observation = start(&mut env, 0);
    for goals in 1..=20 {
        assert_eq!(
            env.step(&[0.0; 20], &mut observation).end,
            Some(End::Redirected)
        );
        assert_eq!(env.episode().goals, goals, "every step reaches a goal");
        env.redirect(&mut observation);
    }
    let in_tolerance = env.episode().in_tolerance;
    assert!(
        in_tolerance < 20,
        "in_tolerance counts by the tolerance of the task: {in_tolerance}"
    );
    env.set_lesson(lesson(1000, &easy));
    for episode in 0..30 {
        observation = start(&mut env, episode);
        let _ = env.step(&[0.0; 20], &mut observation);
        assert_eq!(env.episode().goals, 0);
    }
}

#[test]
fn a_lesson_changes_what_is_learned_from_and_not_what_is_scored() {
    let task = task(&[]);
    let (mut plain, mut observation) = started(&task);
    let (mut shaped, _) = started(&task);
    // A tolerance so wide that, if the task used it, every step would get the bonus.
    let wide = ["training.tolerance=3.2"];
    let paid = [
        "training.task_reward=0.5",
        "training.progress_reward=100",
        "training.approach_reward=0",
    ];
    shaped.set_lesson(lesson(0, &[&wide[..], &paid].concat()));
    for _ in 0..20 {
        let before = shaped.rot_dist();
        let expected = plain.step(&[0.3; 20], &mut observation);
        let found = shaped.step(&[0.3; 20], &mut observation);
        let progress = 100.0 * (before - shaped.last.rot_dist);
        let paid = 0.5 * plain.last.reward.iter().sum::<f64>() + progress;
        assert!(
            (f64::from(found.reward) - paid).abs() < 1e-4,
            "{found:?} {paid}"
        );
        assert_eq!(found.end, expected.end);
        assert_eq!(shaped.last.reward, plain.last.reward);
    }
    assert_eq!(shaped.episode(), plain.episode());
    let sums = shaped.take_sums();
    assert!(sums.training[0] != 0.0 && sums.task == plain.take_sums().task);
}

/// Returns all joint positions after a second of a swinging hand.
fn after_a_second(settings: &[&str]) -> Vec<f64> {
    let task = task(settings);
    let (mut env, mut observation) = started(&task);
    for step in 0..100 {
        let _ = env.step(&[0.3 * (step as f32 / 15.0).sin(); 20], &mut observation);
    }
    env.sim.qpos().to_vec()
}

#[test]
fn friction_and_the_mass_of_the_cube_are_scaled_as_if_the_scene_said_so() {
    let folder = tempfile::tempdir().unwrap();
    let scene = include_str!("../../assets/shadow_hand/scene.xml");
    let said = |replacements: &[[&str; 2]]| {
        let path = folder.path().join("scene.xml");
        let text = replacements
            .iter()
            .fold(scene.to_owned(), |text, [from, to]| {
                assert!(text.contains(from));
                text.replace(from, to)
            });
        std::fs::write(&path, text).unwrap();
        after_a_second(&[&format!("env.model={}", path.display())])
    };
    let apart = |a: &[f64], b: &[f64]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max)
    };
    let unchanged = after_a_second(&[]);
    assert_eq!(
        unchanged,
        after_a_second(&["env.friction_scale=1", "env.cube_mass_scale=1"])
    );
    let heavy = after_a_second(&["env.cube_mass_scale=2"]);
    let heavy_in_the_scene = said(&[[r#"mass=".028""#, r#"mass=".056""#]]);
    assert!(
        apart(&heavy, &heavy_in_the_scene) < 1e-4,
        "{heavy:?}\n{heavy_in_the_scene:?}"
    );
    assert!(apart(&heavy, &unchanged) > 1e-3);
    let slippery = after_a_second(&["env.friction_scale=0.5"]);
    let all = [
        r#"<geom solref=".005 1""#,
        r#"<geom friction=".5 .0025 .00005" solref=".005 1""#,
    ];
    let slippery_in_the_scene =
        said(&[all, [r#"friction="1.2""#, r#"friction=".6 .0025 .00005""#]]);
    assert!(
        apart(&slippery, &slippery_in_the_scene) < 1e-4,
        "{slippery:?}\n{slippery_in_the_scene:?}"
    );
    assert!(apart(&slippery, &unchanged) > 1e-3);
}

/// Returns the observation with cube and goal turned by `rotation`, which maps the cube onto itself.
fn turned(observation: &[f32], rotation: Quat) -> Vec<f32> {
    let mut other = observation.to_vec();
    for place in [OBJECT_ORIENTATION, GOAL_ORIENTATION] {
        let q: [f32; 4] = *observation[place..].first_chunk().unwrap();
        let turned = quat::canonical(quat::mul(q.map(f64::from), rotation)).map(|x| x as f32);
        other[place..place + 4].copy_from_slice(&turned);
    }
    other
}

#[test]
fn a_rollout_holds_what_the_environments_show_and_the_policy_perceives_it() {
    let sets = [
        "env.num_envs=8",
        "ppo.hidden=[16]",
        "ppo.horizon=4",
        "ppo.minibatches=4",
    ];
    for (symmetry, perceives) in [("cube", true), ("none", false)] {
        let config = config(&[&sets[..], &[&format!("ppo.symmetry={symmetry}")]].concat());
        let task = task(&[]);
        let record = task.record().with(config.ppo.symmetry);
        let mut agent = started_agent(&task.for_policy(&record).unwrap(), &config);
        agent.collect(&AtomicBool::new(false)).unwrap();
        let (policy, mut shown) = (agent.ppo.policy.freeze(), vec![0.0; OBSERVATION_SIZE]);
        let block = &agent.rollout.blocks[0];
        let last =
            block.observations[block.step(4, OBSERVATION_SIZE)].chunks_exact(OBSERVATION_SIZE);
        for (env, row) in agent.pool.envs_mut().zip(last) {
            env.observe(&mut shown);
            assert!(shown == row, "as the environment writes it");
        }
        let mut turns_matter = 0;
        for (row, &value) in block
            .acted_on()
            .chunks_exact(OBSERVATION_SIZE)
            .zip(&block.values)
        {
            let mut found = [0.0];
            let turned = turned(row, [0.5, 0.5, -0.5, 0.5]);
            policy.compute(&turned, [&mut [], &mut found], &mut policy.workspace(1));
            turns_matter += usize::from((found[0] - value).abs() > 1e-4);
        }
        assert_eq!(turns_matter == 0, perceives, "{symmetry}: {turns_matter}");
    }
}

#[test]
fn goals_that_live_for_some_steps_are_replaced_under_way_and_the_policy_sees_what_it_had_and_what_it_gets()
 {
    let task = task(&[]);
    let lesson = lesson(0, &["training.goal_lifetime=20"]);
    let envs = (0..8).map(|_| Repose::new(&task)).map(|mut env| {
        env.set_lesson(lesson);
        env
    });
    let mut pool = EnvPool::new(3, envs.collect(), &Exchange::alone(1));
    let mut observations = vec![0.0; 8 * OBSERVATION_SIZE];
    pool.reset(observations.chunks_exact_mut(OBSERVATION_SIZE));
    let mut redirected = 0;
    for _ in 0..200 {
        let before: Vec<_> = pool
            .envs_mut()
            .map(|env| (env.goal, env.episode().length))
            .collect();
        pool.blocks[0]
            .step(&[0.0; 160], &mut [0.0; 8], &mut observations)
            .unwrap();
        let members = &pool.blocks[0].members;
        let last: Vec<_> = members
            .iter()
            .map(|member| (member.end, member.final_observation.clone()))
            .collect();
        for (i, (env, (goal, length))) in pool.envs_mut().zip(before).enumerate() {
            let row = i * OBSERVATION_SIZE..(i + 1) * OBSERVATION_SIZE;
            let seen = &observations[row];
            let (end, under_the_old) = &last[i];
            let shown = quat::canonical(env.goal).map(|x| x as f32);
            assert_eq!(seen[GOAL_ORIENTATION..GOAL_ORIENTATION + 4], shown);
            if *end != Some(End::Redirected) {
                continue;
            }
            redirected += 1;
            assert!(
                env.goal != goal && env.episode().length == length + 1,
                "the episode continues"
            );
            let old = quat::canonical(goal).map(|x| x as f32);
            assert_eq!(under_the_old[GOAL_ORIENTATION..GOAL_ORIENTATION + 4], old);
            for same in [0..GOAL_ORIENTATION, GOAL_ORIENTATION + 8..OBSERVATION_SIZE] {
                assert_eq!(seen[same.clone()], under_the_old[same], "nothing has moved");
            }
        }
    }
    assert!(
        (50..120).contains(&redirected),
        "80 are expected: {redirected}"
    );
}

#[test]
fn a_goal_that_was_reached_is_worth_as_much_to_training_as_if_it_stayed() {
    let task = task(&[
        "env.success_tolerance=3.14",
        "env.max_consecutive_successes=4",
    ]);
    for (trained, lesson) in [
        (
            true,
            lesson(0, &["training.tolerance=3.2", "training.hold=4"]),
        ),
        (false, Lesson::task(&task.config)),
    ] {
        let mut env = Repose::new(&task);
        env.set_lesson(lesson);
        let mut observation = start(&mut env, 0);
        for step in 1..=12 {
            let goal = env.goal;
            let end = env.step(&[0.0; 20], &mut observation).end;
            let reached = step % 4 == 0;
            assert_eq!(
                end,
                (reached && trained).then_some(End::Redirected),
                "step {step}"
            );
            if end.is_some() {
                assert!(
                    env.goal == goal,
                    "the value is bootstrapped under the goal that was reached"
                );
                env.redirect(&mut observation);
            }
            assert_eq!(env.goal != goal, reached, "step {step}");
            assert_eq!(env.episode().goals, step / 4);
            let shown = quat::canonical(env.goal).map(|x| x as f32);
            assert_eq!(observation[GOAL_ORIENTATION..GOAL_ORIENTATION + 4], shown);
        }
        // If the time limit falls on the step that reaches the goal, the last observation is also bootstrapped.
        env.skip_ahead(0.996);
        let goal = env.goal;
        let ends = [0, 1, 2, 3].map(|_| env.step(&[0.0; 20], &mut observation).end);
        assert_eq!(
            (ends[3], env.goal == goal),
            (Some(End::Truncated), trained),
            "{ends:?}"
        );
    }
}

#[test]
fn far_from_the_goal_actions_have_a_larger_noise_that_the_losses_know() {
    let away = [
        "ppo.std.from=0.5",
        "ppo.away_std=1.5",
        "ppo.away_range=[0.15,0.5]",
    ];
    let sets = [
        &["env.num_envs=64", "ppo.minibatches=4", "ppo.hidden=[16]"][..],
        &away,
    ]
    .concat();
    let task = task(&[]);
    let object = task.scene.free_body("cube").unwrap().qpos;
    let mut agent = started_agent(&task, &config(&sets));
    let rows = agent.rollout.first_observations_mut();
    for (env, row) in agent.pool.envs_mut().zip(rows).step_by(2) {
        let goal = env.goal;
        env.sim.qpos_mut()[object + 3..object + 7].copy_from_slice(&goal);
        env.sim.refresh();
        env.observe(row);
    }
    let never = AtomicBool::new(false);
    agent.collect(&never).unwrap();
    let Agent { ppo, rollout, .. } = &mut agent;
    // Sum and count of the squared distances from the mean, near the goal and far from it.
    let mut spread = [[0.0; 2]; 2];
    for block in &rollout.blocks {
        for (i, row) in block.acted_on().chunks_exact(OBSERVATION_SIZE).enumerate() {
            let orientation = |at: usize| [0, 1, 2, 3].map(|j| f64::from(row[at + j]));
            let error = quat::angle_between(
                orientation(OBJECT_ORIENTATION),
                orientation(GOAL_ORIENTATION),
            );
            let expected = 1.0 + 2.0 * ((error - 0.15) / 0.35).clamp(0.0, 1.0);
            let found = f64::from(block.noise_scales[i]);
            assert!(
                (found - expected).abs() < 0.02,
                "{found} instead of {expected} at {error} rad"
            );
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
        assert!(
            count > 200.0 && (std / expected - 1.0).abs() < 0.1,
            "{std} instead of {expected}, {count}"
        );
    }
    let stats = ppo.update(rollout, 1, &never).unwrap();
    assert!(
        stats.first.kl.abs() < 1e-5 && stats.first.ratio_error < 1e-3,
        "{stats:?}"
    );
}

#[test]
fn values_are_clipped_unless_the_clip_is_0() {
    let clip = |sets: &[&str]| config(sets).ppo.value_clip();
    assert_eq!(clip(&["ppo.value_clip=0"]), f64::INFINITY);
    assert_eq!(clip(&["ppo.clip=0.3", "ppo.value_clip=7"]), 7.0);
    assert_eq!(clip(&[]), 0.2);
}

#[test]
fn a_policy_that_moves_far_more_than_it_should_for_twenty_iterations_is_warned_of_once() {
    let place = tempfile::tempdir().unwrap();
    let warnings = |iterations: u32| {
        let (run, steps) = (format!("run-{iterations}"), (128 * iterations).to_string());
        let mut args = train(&["--total-steps", &steps, "--run-dir", &run]);
        // No learning rate in the range makes steps as small as that.
        let sets = [
            "ppo.desired_kl=1e-9",
            "ppo.learning_rate_range=[1e-3,1e-2]",
            "ppo.learning_rate=1e-3",
        ];
        sets.iter().for_each(|set| args.extend(["--set", set]));
        let said = stderr(&succeeded(program(place.path(), &args)));
        said.matches("warning: policy/kl has been more than 10 times ppo.desired_kl")
            .count()
    };
    assert_eq!([19, 50].map(warnings), [0, 1]);
}

#[test]
fn a_training_can_end_when_evaluations_no_longer_rise_and_tells_how_far_they_rose() {
    let folder = tempfile::tempdir().unwrap();
    let sets = [
        "--set",
        "run.patience=2",
        "--set",
        "run.eval_every=1",
        "--set",
        "run.eval_episodes=2",
    ];
    let run = |more: &[&str]| program(folder.path(), &train(&[&sets[..], more].concat()));
    let said = stderr(&succeeded(run(&[
        "--run-dir",
        "whole",
        "--total-steps",
        "64000",
    ])));
    let (_, end) = said
        .split_once("evaluations no longer rise: ")
        .expect(&said);
    let table: Vec<&str> = end.lines().skip(1).take(4).map(str::trim).collect();
    for (line, first) in table.iter().zip([
        "8 episodes",
        "goals per episode",
        "rotation error, rad",
        "drop rate, %",
    ]) {
        assert!(line.starts_with(first), "{said}");
    }
    let iterations = |text: &str| {
        text.split_once(" iterations")
            .unwrap()
            .0
            .rsplit(' ')
            .next()
            .unwrap()
            .to_owned()
    };
    let best = folder.path().join("whole/checkpoints/best.safetensors");
    let best = Checkpoint::parse(&fs::read(best).unwrap())
        .unwrap()
        .progress;
    let rise = best.rise.expect("the best checkpoint tells it");
    assert_eq!(
        (rise.since, Some(rise.best[0])),
        (0, best.best.map(|[goals, _]| goals))
    );
    assert_eq!(iterations(end).parse::<u64>().unwrap(), best.iteration + 2);
    let again = program(
        folder.path(),
        &["train", "--resume", "whole", "--total-steps", "128000"],
    );
    assert!(
        stderr(&succeeded(again)).contains("is finished: "),
        "nothing is trained"
    );
    let listed = succeeded(program(folder.path(), &["runs", "whole", "--json"]));
    assert!(
        String::from_utf8(listed.stdout)
            .unwrap()
            .contains("\"finished\""),
        "runs says so"
    );
    // Evaluations before and after a stop count together.
    succeeded(run(&["--run-dir", "halves", "--total-steps", "128"]));
    let rest = program(
        folder.path(),
        &["train", "--resume", "halves", "--total-steps", "64000"],
    );
    let rest = stderr(&succeeded(rest));
    assert_eq!(
        iterations(rest.split_once("no longer rise: ").expect(&rest).1),
        iterations(end)
    );
}

#[test]
fn half_of_the_episodes_are_helped_to_turn_the_cube_towards_its_goal_while_the_ramp_lasts() {
    for mass in ["1", "3"] {
        expect_help(&[
            "env.reset_position_noise=0",
            "env.reset_dof_pos_noise=0",
            &format!("env.cube_mass_scale={mass}"),
        ]);
    }
}

fn expect_help(sets: &[&str]) {
    let task = task(sets);
    let object = task.hand.object;
    // The angular velocity that a falling cube gains in the first step, as a fraction of the largest assistance.
    let gained = |env_steps: u64, episode: u64| {
        let mut env = Repose::new(&task);
        env.set_lesson(lesson(
            env_steps,
            &["training.assist={from=100,to=0,steps=1000}"],
        ));
        let mut observation = start(&mut env, episode);
        let orientation = env.object().orientation;
        let left = quat::rotation_vector(quat::mul(env.goal, quat::conj(orientation)));
        let _ = env.step(&[0.0; 20], &mut observation);
        let spin = *env.sim.qvel()[object.dof + 3..].first_chunk().unwrap();
        let spin = quat::rotate(env.object().orientation, spin);
        let most = left.map(|angle| 100.0 * angle * 0.01);
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let part = dot(spin, most) / dot(most, most);
        assert!(
            spin.iter()
                .zip(most)
                .all(|(spin, most)| (spin - part * most).abs() < 0.01),
            "{spin:?} {most:?}"
        );
        part
    };
    let first: Vec<f64> = (0..40).map(|episode| gained(0, episode)).collect();
    assert!(
        first.iter().all(|part| (-1e-9..1.0).contains(part)),
        "{first:?}"
    );
    assert!(
        (10..30).contains(&first.iter().filter(|part| part.abs() < 1e-9).count()),
        "{first:?}"
    );
    assert!(first.iter().any(|part| *part > 0.7), "{sets:?}: {first:?}");
    for (episode, part) in (0..).zip(&first) {
        assert!(
            (gained(500, episode) - 0.5 * part).abs() < 1e-6,
            "half of it in the middle of the ramp"
        );
        assert!(gained(1000, episode).abs() < 1e-9, "nothing after it");
    }
}

#[test]
fn a_settings_file_of_the_program_can_be_named_in_any_folder_and_an_own_one_of_its_name_comes_first()
 {
    let folder = tempfile::tempdir().unwrap();
    let name = "configs/repose-robust.toml";
    let each = |run: &str| {
        let said = succeeded(program(
            folder.path(),
            &train(&["--config", name, "--total-steps", "64", "--run-dir", run]),
        ));
        let config = fs::read_to_string(folder.path().join(run).join("config.toml")).unwrap();
        let value = config.parse::<toml::Table>().unwrap()["randomization"]["each"].as_float();
        (
            value,
            stderr(&said).contains(
                "there is no configs/repose-robust.toml here: using the one in the program",
            ),
        )
    };
    assert_eq!(each("first"), (Some(0.4), true));
    fs::create_dir(folder.path().join("configs")).unwrap();
    fs::write(folder.path().join(name), "[randomization]\neach = 0.9").unwrap();
    assert_eq!(each("second"), (Some(0.9), false));
    let none = program(folder.path(), &train(&["--config", "configs/none.toml"]));
    assert!(
        none.status.code() == Some(1) && stderr(&none).contains("configs/none.toml"),
        "{}",
        stderr(&none)
    );
}

#[test]
fn the_smoothing_follows_its_ramp_in_training_and_a_policy_plays_with_the_value_of_its_checkpoint()
{
    let task = task(&[]);
    // How far the first target goes towards the end of the range that is asked for.
    let moved = |env_steps: u64| {
        let mut env = Repose::new(&task);
        env.set_lesson(lesson(
            env_steps,
            &["env.act_moving_average={from=0.25,to=0.75,steps=100}"],
        ));
        let mut observation = start(&mut env, 0);
        let before = env.sim.ctrl().to_vec();
        let _ = env.step(&[1.0; 20], &mut observation);
        env.sim
            .ctrl()
            .iter()
            .zip(before)
            .map(|(after, before)| after - before)
            .sum::<f64>()
    };
    assert!(
        (moved(100) / moved(0) - 3.0).abs() < 1e-6 && (moved(50) / moved(0) - 2.0).abs() < 1e-6
    );

    let folder = tempfile::tempdir().unwrap();
    let ramp = [
        "--set",
        "env.act_moving_average={from=0.2,to=0.8,steps=200}",
        "--total-steps",
        "256",
    ];
    succeeded(program(
        folder.path(),
        &train(&[&ramp[..], &["--run-dir", "run"]].concat()),
    ));
    let latest = folder.path().join("run/checkpoints/latest.safetensors");
    let played = |sets: &[Override]| {
        Loaded::find(Some(&latest), sets)
            .unwrap()
            .task(sets)
            .unwrap()
    };
    assert_eq!(played(&[]).config.act_moving_average, Ramp::constant(0.8));
    assert_eq!(
        played(&["env.act_moving_average=0.4".parse().unwrap()])
            .config
            .act_moving_average,
        Ramp::constant(0.4)
    );
    let stored = Checkpoint::parse(&fs::read(&latest).unwrap())
        .unwrap()
        .config;
    assert!(
        stored.contains("act_moving_average = { from = 0.2, to = 0.8, steps = 200 }"),
        "the ramp goes on: {stored}"
    );
}
