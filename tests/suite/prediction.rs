//! Late actions: the policy sees where a model of the hand will be when its action takes effect.

use shadow_repose::config::Override;
use shadow_repose::env::{Env, EnvState, Resumable};
use shadow_repose::load::Loaded;
use shadow_repose::repose::{Repose, Task};
use shadow_repose::sim::Parts;

use crate::support::{
    OBSERVATION_SIZE, config, metrics, program, started, stderr, succeeded, task, train, weights,
};

/// An action of a step, different for each actuator and moving.
fn action(step: usize) -> [f32; 20] {
    std::array::from_fn(|i| 0.6 * ((step as f32 + 3.0 * i as f32) / 9.0).sin())
}

/// What is seen at the start and after each of so many steps, and what is measured then.
fn seen(env: &mut Repose, first: Vec<f32>, steps: usize) -> Vec<[Vec<f32>; 2]> {
    let mut observation = first;
    let mut all = Vec::new();
    for step in 0..=steps {
        let mut measured = vec![0.0; observation.len()];
        env.observe(&mut measured);
        all.push([observation.clone(), measured]);
        let _ = env.step(&action(step), &mut observation);
    }
    all
}

/// The mean difference between what is seen and what is measured after `delay` more steps, up to the last action, which is known.
/// Contacts make single values differ more.
fn error(all: &[[Vec<f32>; 2]], which: usize, delay: usize) -> f32 {
    let pairs = all.iter().zip(&all[delay..]);
    let all: Vec<f32> = pairs
        .flat_map(|(now, later)| differences(&now[which][..137], &later[1][..137]))
        .collect();
    all.iter().sum::<f32>() / all.len() as f32
}

fn sets(sets: &[&str]) -> Vec<Override> {
    sets.iter().map(|set| set.parse().unwrap()).collect()
}

fn differences(a: &[f32], b: &[f32]) -> Vec<f32> {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).collect()
}

#[test]
fn what_is_predicted_is_what_is_measured_when_the_action_takes_effect() {
    for delay in [1, 2, 3, 5] {
        let task = task(&[
            &format!("env.action_delay={delay}"),
            &format!("env.prediction={delay}"),
        ]);
        let (mut env, first) = started(&task);
        let all = seen(&mut env, first, 40);
        let [predicted, measured] = [0, 1].map(|which| error(&all, which, delay));
        assert!(
            predicted < 0.1 * measured,
            "delay {delay}: {predicted} of {measured}"
        );
        assert!(
            all.iter()
                .all(|[seen, measured]| seen[137..] == measured[137..]),
            "the last action stays"
        );
    }
}

#[test]
fn a_prediction_depends_on_what_is_measured_and_sent_alone() {
    let noisy = [
        "env.prediction=2",
        "env.action_delay=3",
        "env.noise.cube_pos=0.001",
        "env.bias.joint_pos=0.01",
    ];
    let task = task(&noisy);
    let (mut env, first) = started(&task);
    let (mut other, again) = started(&task);
    // A simulation that was used for something else gives the same bits.
    let (mut between, mut elsewhere) = started(&task);
    assert_eq!(first, again);
    let all = seen(&mut env, first, 30);
    let mut observation = again;
    for (step, [expected, _]) in all.iter().enumerate() {
        assert_eq!(observation, *expected, "step {step}");
        let _ = between.step(&action(3 * step), &mut elsewhere);
        let _ = other.step(&action(step), &mut observation);
    }
}

#[test]
fn a_saved_environment_goes_on_predicting_with_the_same_bits() {
    let task = task(&["env.prediction=3", "env.action_delay=1"]);
    let (mut env, first) = started(&task);
    let seen_before = seen(&mut env, first, 7).pop().unwrap();
    assert_ne!(seen_before[0], seen_before[1]);
    let mut state = EnvState::default();
    env.save(&mut state);
    let mut other = Repose::new(&task);
    let mut found = vec![0.0; OBSERVATION_SIZE];
    other
        .restore(&mut state.rows(1).unwrap().next().unwrap(), &mut found)
        .unwrap();
    let mut expected = vec![0.0; OBSERVATION_SIZE];
    for step in 0..20 {
        assert_eq!(
            env.step(&action(step), &mut expected),
            other.step(&action(step), &mut found)
        );
        assert_eq!(found, expected, "step {step}");
    }
}

#[test]
fn what_the_user_changes_in_play_changes_the_world_and_not_the_model() {
    let loaded = Loaded::find(Some("builtin".as_ref()), &[]).unwrap();
    let after = |task: std::sync::Arc<Task>| {
        let (mut env, first) = started(&task);
        seen(&mut env, first, 0).pop().unwrap()
    };
    let usual = after(loaded.task(&sets(&["env.prediction=5"])).unwrap());
    let heavy = ["env.prediction=5", "env.gravity=[0,0,5]"];
    let played = after(loaded.task(&sets(&heavy)).unwrap());
    let trained = after(task(&heavy));
    // The same place at the start; only who knows of the gravity predicts another fall.
    assert_eq!((&usual[1], &usual[0]), (&played[1], &played[0]));
    assert_eq!(trained[1], usual[1]);
    assert_ne!(trained[0], usual[0]);
    let table = ["env={prediction=5,gravity=[0,0,5]}"];
    let played = loaded.task(&sets(&table)).unwrap();
    assert_eq!(played.config.gravity, [0.0, 0.0, 5.0]);
    assert_eq!(played.predicted_with().unwrap().gravity, [0.0; 3]);
}

#[test]
fn the_model_steps_as_in_training_unless_that_does_not_divide_the_control_step() {
    let loaded = Loaded::find(Some("builtin".as_ref()), &[]).unwrap();
    for (ctrl_dt, expected) in [(0.01, 0.01), (0.02, 0.01), (0.015, 0.005)] {
        let ctrl_dt = format!("env.ctrl_dt={ctrl_dt}");
        let played = ["env.prediction=1", "env.sim_dt=0.005", &ctrl_dt];
        let task = loaded.task(&sets(&played)).unwrap();
        assert_eq!(task.config.sim_dt, 0.005, "{ctrl_dt}");
        assert_eq!(task.predicted_with().unwrap().sim_dt, expected, "{ctrl_dt}");
    }
}

#[test]
fn the_model_of_a_policy_that_is_told_what_is_known_of_the_world_has_it_too() {
    let robust = Loaded::find(Some("robust".as_ref()), &[]).unwrap();
    let world = [
        "env.prediction=2",
        "env.action_delay=2",
        "env.cube_size_scale=0.8",
        "env.damping_scale=3",
    ];
    let known = ["env.known={cube_size=0.8,damping=3}"];
    let [wrong, told] = [&[][..], &known].map(|known| {
        let task = robust.task(&sets(&[&world[..], known].concat())).unwrap();
        let (mut env, first) = started(&task);
        error(&seen(&mut env, first, 40), 0, 2)
    });
    assert!(told < 0.2 * wrong, "{told}, not told {wrong}");

    let folder = tempfile::tempdir().unwrap();
    let damped = [
        "--set",
        "env.damping_scale=2",
        "--set",
        "env.known.damping=2",
    ];
    let run = ["--run-dir", "run", "--total-steps", "256"];
    succeeded(program(
        folder.path(),
        &[&train(&run)[..], &damped].concat(),
    ));
    let own = Loaded::find(Some(&folder.path().join("run")), &[]).unwrap();
    let late = ["env.prediction=1", "env.damping_scale=7"];
    for (stated, expected) in [(&[][..], 2.0), (&["env.known.damping=3"], 3.0)] {
        let task = own.task(&sets(&[&late[..], stated].concat())).unwrap();
        assert_eq!(task.config.damping_scale, 7.0);
        assert_eq!(task.predicted_with().unwrap().damping_scale, expected);
    }
}

#[test]
fn a_prediction_that_diverges_leaves_what_was_measured_and_is_counted() {
    let task = task(&["env.prediction=1", "env.noise.joint_vel=1e9"]);
    let (mut env, first) = started(&task);
    for [seen, measured] in seen(&mut env, first, 3) {
        assert_eq!(seen, measured);
    }
    assert_eq!(env.take_sums().unpredicted, 5);
}

#[test]
fn a_training_whose_predictions_diverge_speaks_of_no_diverged_physics() {
    let folder = tempfile::tempdir().unwrap();
    let late = [
        "--set",
        "env.prediction=1",
        "--set",
        "env.noise.joint_vel=1e9",
        "--total-steps",
        "512",
    ];
    let said = stderr(&succeeded(program(folder.path(), &train(&late))));
    assert!(said.contains("the prediction diverged"), "{said}");
    assert!(!said.contains("of this session diverged"), "{said}");
}

#[test]
fn predictions_that_cannot_be_are_refused_in_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |set: &str, expected: &str| {
        let output = program(
            folder.path(),
            &["play", "--ckpt", "builtin", "--headless", "--set", set],
        );
        assert!(
            !output.status.success() && stderr(&output).contains(expected),
            "{set}: {}",
            stderr(&output)
        );
    };
    refused("env.prediction=-1", "env.prediction");
    refused(
        "env.prediction=1001",
        "env.prediction = 1001: must be shorter than an episode, which lasts 1000 steps",
    );
    let zero = [
        "play",
        "--ckpt",
        "zero",
        "--headless",
        "--set",
        "env.prediction=1",
        "--set",
        "env.vel_obs_scale=0",
    ];
    let output = program(folder.path(), &zero);
    assert!(
        stderr(&output).contains("env.vel_obs_scale = 0: must not be 0 with env.prediction"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn a_hand_on_something_that_the_policy_does_not_see_cannot_be_predicted() {
    let scene = crate::support::SCENE.replace(
        "</worldbody>",
        "<body name=\"lost\" pos=\"1 1 1\"><freejoint name=\"loose\"/><geom size=\".01\"/></body></worldbody>",
    );
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene.xml"), scene).unwrap();
    let model = format!("env.model={}", folder.path().join("scene.xml").display());
    let mut config = config(&[&model, "env.prediction=1"]);
    config.hand = Parts {
        object: "cube".into(),
        ..config.hand
    };
    let error = format!("{:#}", Task::new(&config).err().unwrap());
    assert!(error.contains("does not observe joint `loose`"), "{error}");
}

#[test]
fn a_training_run_with_predictions_gives_the_same_bits_on_any_threads_and_after_a_resume() {
    let folder = tempfile::tempdir().unwrap();
    let late = [
        "--set",
        "env.prediction=2",
        "--set",
        "randomization.share=1",
        "--set",
        "randomization.delay=[0,3]",
    ];
    let trained = |run: &str, more: &[&str]| {
        let args = [&train(&["--run-dir", run])[..], &late, more].concat();
        succeeded(program(folder.path(), &args));
    };
    trained("one", &["--threads", "1", "--total-steps", "512"]);
    trained("two", &["--threads", "2", "--total-steps", "256"]);
    let more = [
        "train",
        "--resume",
        "two",
        "--total-steps",
        "512",
        "--threads",
        "2",
    ];
    succeeded(program(folder.path(), &more));
    let [one, two] = ["one", "two"].map(|run| folder.path().join(run));
    assert_eq!(metrics(&one), metrics(&two));
    let latest = "checkpoints/latest.safetensors";
    assert!(weights(one.join(latest)) == weights(two.join(latest)));
}
