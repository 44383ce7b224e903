//! Varied physics, noise and delays: as settings of the task, and drawn anew for each episode of a training.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::Stdio;
use std::sync::atomic::AtomicBool;

use serde_json::Value;
use shadow_repose::config::{Config, Ramp, Settings, Source};
use shadow_repose::env::{Env, EnvState, Resumable};
use shadow_repose::evaluate::{Actor, Episodes, Trial};
use shadow_repose::load::Loaded;
use shadow_repose::repose::{EpisodePhysics, Lesson, Randomization, Repose, Score};
use shadow_repose::rng;

use crate::support::{
    OBSERVATION_SIZE, SCENE, command, config, metrics, names, program, started, stderr, succeeded,
    task, train, weights,
};
use crate::survival::{send, unstable_scene};

/// The settings of configs/randomization-all.toml.
const ALL: &str = include_str!("../../configs/randomization-all.toml");

/// Multiplies the numbers in all attributes `name` of a scene.
fn scaled(scene: &str, name: &str, factor: f64) -> String {
    let start = format!(" {name}=\"");
    let mut parts = scene.split(&start);
    let mut text = parts.next().unwrap().to_owned();
    for part in parts {
        let (numbers, rest) = part.split_once('"').unwrap();
        let numbers: Vec<String> = numbers
            .split(' ')
            .map(|x| (factor * x.parse::<f64>().unwrap()).to_string())
            .collect();
        text += &format!("{start}{}\"{rest}", numbers.join(" "));
    }
    assert!(text != scene, "{name}");
    text
}

/// Returns all joint positions after a second of a swinging hand.
fn after_a_second(settings: &[&str]) -> Vec<f64> {
    after_steps(100, settings)
}

fn after_steps(steps: u32, settings: &[&str]) -> Vec<f64> {
    let task = task(settings);
    let (mut env, mut observation) = started(&task);
    for step in 0..steps {
        let _ = env.step(&[0.3 * (step as f32 / 15.0).sin(); 20], &mut observation);
    }
    env.sim.qpos().to_vec()
}

#[test]
fn each_quantity_is_varied_as_if_the_scene_said_so() {
    let folder = tempfile::tempdir().unwrap();
    let apart = |a: &[f64], b: &[f64]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max)
    };
    let unchanged = after_a_second(&[]);
    let (before, of_object) = SCENE.split_once("<body name=\"cube\"").unwrap();
    let (object, after) = of_object.split_once("</body>").unwrap();
    let object_of = |object: String| format!("{before}<body name=\"cube\"{object}</body>{after}");
    let moved = format!("pos=\"{} 0 {}\"", 1.25 * 0.33, 1.25 * 0.295);
    let larger = object_of(
        scaled(&scaled(object, "size", 1.25), "pos", 1.25).replace(&moved, "pos=\".33 0 .295\""),
    );
    let hand = format!(
        "{}<body name=\"cube\"{of_object}",
        scaled(&scaled(before, "mass", 1.5), "diaginertia", 1.5)
    );
    let inertia = "inertial pos=\".004 -.002 .003\" mass=\".028\" diaginertia=\".00001166667 .00001166667 .00001166667\"";
    let joint = "<freejoint name=\"cube\"/>";
    let shifted = object_of(object.replace(joint, &format!("{joint}<{inertia}/>")));
    let option = "<option timestep=\"0.01\"";
    let falling = SCENE.replace(
        option,
        "<option gravity=\"0.5 -0.25 -8.81\" timestep=\"0.01\"",
    );
    for (setting, scene) in [
        ("env.gains_scale=1.5", scaled(SCENE, "kp", 1.5)),
        ("env.damping_scale=0.3", scaled(SCENE, "damping", 0.3)),
        (
            "env.frictionloss_scale=3",
            scaled(SCENE, "frictionloss", 3.0),
        ),
        ("env.hand_mass_scale=1.5", hand),
        ("env.cube_size_scale=1.25", larger),
        ("env.cube_com=[0.004,-0.002,0.003]", shifted),
        ("env.gravity=[0.5,-0.25,1]", falling),
        (
            "env.cone=elliptic",
            SCENE.replace("cone=\"pyramidal\"", "cone=\"elliptic\""),
        ),
    ] {
        let path = folder.path().join("scene.xml");
        fs::write(&path, scene).unwrap();
        let (set, said) = (
            after_a_second(&[setting]),
            after_a_second(&[&format!("env.model={}", path.display())]),
        );
        assert!(
            apart(&set, &said) < 1e-4,
            "{setting}: {}",
            apart(&set, &said)
        );
        assert!(apart(&set, &unchanged) > 1e-4, "{setting} changes nothing");
    }
}

#[test]
fn a_cube_of_several_parts_is_resized_as_a_whole() {
    let folder = tempfile::tempdir().unwrap();
    let (before, of_object) = SCENE.split_once("<body name=\"cube\"").unwrap();
    let (object, after) = of_object.split_once("</body>").unwrap();
    let parts = "<frame pos=\".012 0 0\"><geom type=\"sphere\" size=\".016\" pos=\".01 .002 0\"/></frame>\
                 <body pos=\"0 .01 .02\"><geom type=\"capsule\" fromto=\"0 0 0 0 0 .01\" size=\".008\" mass=\".004\"/></body>";
    // Lumps make the motion so sensitive that rounding is seen after a second.
    let after_a_while = |object: &str, setting: &str| {
        let path = folder.path().join("scene.xml");
        fs::write(
            &path,
            format!("{before}<body name=\"cube\"{object}</body>{after}"),
        )
        .unwrap();
        after_steps(30, &[&format!("env.model={}", path.display()), setting])
    };
    let object = format!("{object}{parts}");
    let larger = ["size", "pos", "fromto"]
        .iter()
        .fold(object.clone(), |text, name| scaled(&text, name, 1.2));
    // The body's own place stays, and a part that is given by its density keeps its mass.
    let larger = larger.replace("pos=\"0.396 0 0.354\"", "pos=\".33 0 .295\"");
    let density = 1000.0 / 1.2_f64.powi(3);
    let larger = larger.replace(
        "type=\"sphere\"",
        &format!("type=\"sphere\" density=\"{density}\""),
    );
    let unchanged = after_a_while(&object, "env.cube_size_scale=1");
    let set = after_a_while(&object, "env.cube_size_scale=1.2");
    let said = after_a_while(&larger, "env.cube_size_scale=1");
    let apart = |a: &[f64], b: &[f64]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max)
    };
    assert!(apart(&set, &said) < 1e-6, "{}", apart(&set, &said));
    assert!(apart(&set, &unchanged) > 1e-4);
}

#[test]
fn a_fork_without_forces_on_the_cube_drops_the_one_of_its_parent() {
    let (mut env, _) = randomized(&["randomization.push=3", "randomization.delay=[0,0]"]);
    played(&mut env, 0);
    let after_a_step = |env: &Repose| {
        let mut state = EnvState::default();
        env.save(&mut state);
        let (mut fork, mut observation) = (Repose::new(&task(&[])), vec![0.0; OBSERVATION_SIZE]);
        fork.restore(
            &mut state.rows(1).unwrap().next().unwrap(),
            &mut observation,
        )
        .unwrap();
        let _ = fork.step(&[0.0; 20], &mut observation);
        observation
    };
    let pushed = after_a_step(&env);
    env.sim.push(task(&[]).hand.object.body, [0.0; 3]);
    assert_eq!(pushed, after_a_step(&env));
}

#[test]
fn an_action_takes_effect_after_the_delay() {
    let controls = |delay: u32| {
        let task = task(&[&format!("env.action_delay={delay}")]);
        let (mut env, mut observation) = started(&task);
        let mut sent = vec![env.sim.ctrl().to_vec()];
        for step in 0..12 {
            let _ = env.step(&[0.1 * step as f32; 20], &mut observation);
            sent.push(env.sim.ctrl().to_vec());
        }
        sent
    };
    let (now, later) = (controls(0), controls(3));
    assert!(
        later[..4].iter().all(|ctrl| ctrl == &now[0]),
        "nothing moves at first"
    );
    assert_eq!(later[3..], now[..10]);
}

#[test]
fn noise_and_bias_are_seen_but_the_hand_is_where_it_is() {
    let seen = |settings: &[&str]| {
        let task = task(settings);
        let (mut env, mut observation) = started(&task);
        let mut seen = Vec::new();
        for _ in 0..200 {
            let _ = env.step(&[0.1; 20], &mut observation);
            let joints = &task.hand.joints;
            let off = |i: usize| f64::from(observation[i]) - env.sim.qpos()[joints[i].qpos];
            seen.push((off(0), observation[30], env.sim.qpos().to_vec()));
        }
        seen
    };
    let spread = |of: &[(f64, f32, Vec<f64>)]| {
        let mean = of.iter().map(|(off, ..)| off).sum::<f64>() / of.len() as f64;
        (
            mean,
            (of.iter().map(|(off, ..)| (off - mean).powi(2)).sum::<f64>() / of.len() as f64).sqrt(),
        )
    };
    let (exact, noisy) = (seen(&[]), seen(&["env.noise={joint_pos=0.05}"]));
    let biased = seen(&["env.bias.joint_pos=0.05"]);
    assert!(exact.iter().all(|(off, ..)| off.abs() < 1e-6));
    let ((noise_mean, noise), (bias, bias_spread)) = (spread(&noisy), spread(&biased));
    assert!(
        (0.04..0.06).contains(&noise) && noise_mean.abs() < 0.015,
        "{noise_mean} ± {noise}"
    );
    assert!(
        bias.abs() > 1e-4 && bias_spread < 1e-6,
        "{bias} ± {bias_spread}"
    );
    for other in [noisy, biased] {
        assert!(
            other
                .iter()
                .zip(&exact)
                .all(|(a, b)| a.1 == b.1 && a.2 == b.2),
            "other groups and the physics"
        );
    }
}

/// Returns an environment in which all is randomised, and the draws of episodes.
fn randomized(settings: &[&str]) -> (Repose, impl Fn(u64) -> Option<EpisodePhysics>) {
    let all = Source::new("all.toml", ALL);
    let sets: Vec<_> = settings.iter().map(|set| set.parse().unwrap()).collect();
    let config = Settings::new().file(all).sets(&sets).resolve().unwrap();
    let task = task(&[]);
    let randomization = Randomization::new(&task, &config.randomization).unwrap();
    let mut env = Repose::randomized(&task, randomization.as_ref());
    let lesson = Lesson::at(0, &config);
    env.set_lesson(lesson);
    let draw = move |episode| {
        let rng = rng::stream(0, "episode", episode);
        randomization
            .as_ref()
            .and_then(|randomization| randomization.draw(&rng, lesson.randomized, &task.hand))
    };
    (env, draw)
}

#[test]
fn draws_fill_their_ranges_in_the_share_of_the_episodes_that_was_asked() {
    let (_, draw) = randomized(&["randomization.share=0.75"]);
    let draws: Vec<EpisodePhysics> = (0..4000).filter_map(draw).collect();
    assert!((2900..3100).contains(&draws.len()), "{}", draws.len());
    let check = |name: &str, values: Vec<f64>, [low, high]: [f64; 2], middle: f64| {
        let (least, most) = values
            .iter()
            .fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(*x), b.max(*x)));
        let near = 0.02 * (high - low);
        assert!(
            least >= low && least < low + near && most <= high && most > high - near,
            "{name}: {least} to {most}"
        );
        let below = values.iter().filter(|x| **x < middle).count() as f64 / values.len() as f64;
        assert!((below - 0.5).abs() < 0.05, "{name}: {below} below {middle}");
    };
    let of = |value: &dyn Fn(&EpisodePhysics) -> f64| draws.iter().map(value).collect::<Vec<f64>>();
    check(
        "friction",
        of(&|draw| draw.physics["friction"][0]),
        [0.7, 1.3],
        1.0,
    );
    check(
        "cube_mass",
        of(&|draw| draw.physics["cube_mass"][0]),
        [0.5, 1.5],
        1.0,
    );
    check(
        "cube_com",
        of(&|draw| draw.physics["cube_com"][1]),
        [-0.003, 0.003],
        0.0,
    );
    // Uniform in the logarithm: as often below the geometric mean as above it.
    check(
        "gains",
        of(&|draw| draw.physics["gains"][7]),
        [0.75, 1.5],
        1.125_f64.sqrt(),
    );
    check(
        "damping",
        of(&|draw| draw.physics["damping"][20]),
        [0.3, 3.0],
        0.9_f64.sqrt(),
    );
    let sizes: std::collections::BTreeSet<u64> = draws
        .iter()
        .map(|draw| (1000.0 * draw.physics["cube_size"][0]) as u64)
        .collect();
    assert_eq!(
        sizes.into_iter().collect::<Vec<_>>(),
        [950, 975, 1000, 1025, 1050]
    );
    let delays =
        [0, 1, 2, 3].map(|delay| draws.iter().filter(|draw| draw.delay() == delay).count());
    assert!(
        delays.iter().all(|count| (600..900).contains(count)),
        "{delays:?}"
    );
    let alike = draws
        .iter()
        .filter(|draw| {
            draw.physics["damping"]
                .iter()
                .all(|factor| *factor == draw.physics["damping"][0])
        })
        .count();
    assert!(
        (0.45..0.55).contains(&(alike as f64 / draws.len() as f64)),
        "one factor for all joints: {alike}"
    );
    let gravity = (draws
        .iter()
        .map(|draw| draw.physics["gravity"][2].powi(2))
        .sum::<f64>()
        / draws.len() as f64)
        .sqrt();
    assert!((gravity - 0.4).abs() < 0.02, "{gravity}");
}

#[test]
fn one_setting_does_not_change_what_is_drawn_for_another() {
    let [(_, draw), (_, other)] = [
        &[][..],
        &["randomization.friction=[1,1]", "randomization.delay=[0,1]"],
    ]
    .map(randomized);
    for episode in 0..20 {
        let (draw, other) = (draw(episode).unwrap(), other(episode).unwrap());
        ["cube_mass", "damping", "gravity"]
            .iter()
            .for_each(|name| assert_eq!(draw.physics[name], other.physics[name]));
        assert_eq!(other.physics["friction"], [1.0]);
    }
    let (_, few) = randomized(&["randomization.each=0.25"]);
    let varied = |draw: EpisodePhysics| {
        ["friction", "damping"]
            .iter()
            .filter(|name| draw.physics[name][0] != 1.0)
            .count() as u32
            + u32::from(draw.has_noise)
    };
    let mean = (0..2000)
        .map(|episode| varied(few(episode).unwrap()))
        .sum::<u32>() as f64
        / 2000.0;
    assert!((mean - 0.75).abs() < 0.1, "{mean} of three are varied");
}

/// Plays some steps of an episode and returns the last observation.
fn played(env: &mut Repose, episode: u64) -> Vec<f32> {
    let mut observation = vec![0.0; OBSERVATION_SIZE];
    env.reset(rng::stream(0, "episode", episode), &mut observation);
    for step in 0..30 {
        let _ = env.step(&[0.2 * (step as f32 / 4.0).sin(); 20], &mut observation);
    }
    observation
}

#[test]
fn nothing_of_an_episode_stays_in_the_next() {
    let (mut used, _) = randomized(&["randomization.share=0.7"]);
    for episode in 0..12 {
        let (mut fresh, draw) = randomized(&["randomization.share=0.7"]);
        assert_eq!(
            played(&mut used, episode),
            played(&mut fresh, episode),
            "episode {episode}"
        );
        assert_eq!(used.draw(), draw(episode).as_ref());
    }
    // An episode that draws nothing is the task, bit for bit. Without shifts of the centre of mass, which MuJoCo computes otherwise.
    let (mut env, draw) = randomized(&[
        "randomization.share=0.5",
        "randomization.cube_com=0",
        "training.assist=0",
    ]);
    let mut plain = Repose::new(&task(&[]));
    let nominal = (0..20)
        .filter(|episode| draw(*episode).is_none())
        .collect::<Vec<u64>>();
    assert!(nominal.len() > 4);
    nominal
        .into_iter()
        .for_each(|episode| assert_eq!(played(&mut env, episode), played(&mut plain, episode)));
}

#[test]
fn a_saved_environment_goes_on_with_its_draw_its_noise_and_the_actions_under_way() {
    let (mut env, _) = randomized(&[]);
    for episode in 0..4 {
        played(&mut env, episode);
        let mut state = EnvState::default();
        env.save(&mut state);
        let (mut other, _) = randomized(&[]);
        let [mut expected, mut found] = [vec![0.0; OBSERVATION_SIZE], vec![0.0; OBSERVATION_SIZE]];
        let mut rows = state.rows(1).unwrap();
        other
            .restore(&mut rows.next().unwrap(), &mut found)
            .unwrap();
        env.observe(&mut expected);
        assert_eq!(found, expected);
        for step in 0..30 {
            let action = [0.2 * (step as f32 / 3.0).cos(); 20];
            assert_eq!(
                env.step(&action, &mut expected),
                other.step(&action, &mut found)
            );
            assert_eq!(found, expected, "episode {episode}, step {step}");
        }
    }
}

#[test]
fn randomised_episodes_begin_with_their_ramp_and_those_under_way_stay_what_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("all.toml"), ALL).unwrap();
    let trained = |run: &str, steps: &str| {
        let share = "randomization.share={from=0,to=1,steps=0,after=1280}";
        let args = [
            "--config",
            "all.toml",
            "--run-dir",
            run,
            "--set",
            "env.max_episode_seconds=0.4",
            "--set",
            share,
        ];
        succeeded(program(
            folder,
            &train(&[&args[..], &["--total-steps", steps]].concat()),
        ));
    };
    let latest = |run: &str| weights(folder.join(run).join("checkpoints/latest.safetensors"));
    trained("whole", "5120");
    let table = metrics(&folder.join("whole"));
    let column = |name: &str| table[0].iter().position(|of| of == name).unwrap();
    let (steps, length) = (column("env_steps"), column("randomized/length"));
    let ends = |row: &&Vec<String>| !row[length].is_empty() && row[length] != "NaN";
    let first = table[1..]
        .iter()
        .find(ends)
        .expect("randomised episodes end")[steps]
        .parse::<u64>()
        .unwrap();
    assert!(
        (1281..5120).contains(&first),
        "they begin after 1280 steps: the first one ended at {first}"
    );
    // The environments are in the middle of episodes that began before the ramp.
    trained("part", "1408");
    succeeded(program(
        folder,
        &["train", "--resume", "part", "--total-steps", "5120"],
    ));
    assert!(latest("whole") == latest("part"));
}

#[test]
fn a_randomised_training_has_the_same_bits_when_resumed_and_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("all.toml"), ALL).unwrap();
    let trained = |run: &str, more: &[&str]| {
        let args = [
            "--config",
            "all.toml",
            "--run-dir",
            run,
            "--set",
            "env.max_episode_seconds=0.4",
        ];
        succeeded(program(folder, &train(&[&args[..], more].concat())));
        weights(folder.join(run).join("checkpoints/latest.safetensors"))
    };
    let whole = trained("one", &["--total-steps", "2560", "--threads", "1"]);
    assert!(whole == trained("eight", &["--total-steps", "2560", "--threads", "8"]));
    trained("part", &["--total-steps", "1280"]);
    succeeded(program(
        folder,
        &["train", "--resume", "part", "--total-steps", "2560"],
    ));
    assert!(whole == weights(folder.join("part/checkpoints/latest.safetensors")));
    let columns = |run: &str, group: &str| {
        metrics(&folder.join(run))[0]
            .iter()
            .filter(|name| name.starts_with(group))
            .count()
    };
    let figures = columns("one", "episode/");
    assert!(figures > 0 && columns("one", "randomized/") == figures);
    // A fork of a training without any of this, with delays that its environments did not have.
    let plain = [
        "--total-steps",
        "1280",
        "--run-dir",
        "plain",
        "--set",
        "randomization.share=0",
    ];
    succeeded(program(folder, &train(&plain)));
    let fork = [
        "train",
        "--fork",
        "plain/checkpoints/latest.safetensors",
        "--config",
        "all.toml",
        "--run-dir",
        "fork",
    ];
    succeeded(program(
        folder,
        &[&fork[..], &["--total-steps", "2560"]].concat(),
    ));
    assert_eq!(
        (
            columns("plain", "randomized/"),
            columns("fork", "randomized/")
        ),
        (0, figures)
    );
}

#[test]
fn a_dump_of_a_randomised_hand_tells_what_it_has_drawn() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("all.toml"), ALL).unwrap();
    fs::write(folder.path().join("unstable.xml"), unstable_scene()).unwrap();
    let mut args = train(&[
        "--config",
        "all.toml",
        "--total-steps",
        "640",
        "--run-dir",
        "run",
        "--dump-diverged",
    ]);
    args.extend([
        "--set",
        "env.max_episode_seconds=5",
        "--set",
        "env.model=unstable.xml",
        "--set",
        "env.hand_mass_scale=1.25",
    ]);
    succeeded(program(folder.path(), &args));
    let place = folder.path().join("run/diverged");
    let dumps = names(&place);
    assert!(dumps.len() > 4);
    for dump in dumps {
        let dump: Value = serde_json::from_slice(&fs::read(place.join(dump)).unwrap()).unwrap();
        let (drawn, steps) = (
            &dump["randomization"],
            dump["ctrl"].as_array().unwrap().len(),
        );
        assert!(
            (0.5..=1.5).contains(&drawn["cube_mass"].as_f64().unwrap())
                && dump["hand_mass_scale"] == 1.25
        );
        assert_eq!(
            (
                drawn["gains"].as_array().unwrap().len(),
                drawn["damping"].as_array().unwrap().len()
            ),
            (20, 24)
        );
        assert_eq!(
            (steps, dump["pushes"].as_array().unwrap().len()),
            (steps, steps)
        );
        let torques = dump["torques"].as_array().unwrap().len();
        assert!(
            [0, steps].contains(&torques),
            "an episode is assisted or not: {torques}"
        );
    }
}

#[test]
fn evaluations_stay_nominal_while_training_is_randomised() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("all.toml"), ALL).unwrap();
    let args = [
        "--config",
        "all.toml",
        "--total-steps",
        "128",
        "--run-dir",
        "run",
        "--set",
        "run.eval_every=1",
    ];
    succeeded(program(folder.path(), &train(&args)));
    let run = folder.path().join("run");
    let rows = metrics(&run);
    let column = rows[0]
        .iter()
        .position(|name| name == "eval/rot_dist")
        .unwrap();
    let logged: f64 = rows[1][column].parse().unwrap();
    let place = run.join("checkpoints/latest.safetensors");
    let count = config_of(&run).run.eval_episodes;
    let rot_dist = |settings: &[&str]| {
        let sets: Vec<_> = settings.iter().map(|set| set.parse().unwrap()).collect();
        let loaded = Loaded::find(Some(&place), &sets).unwrap();
        let episodes = Episodes {
            seed: 0,
            purpose: "evaluation",
            first: 0,
            count,
        };
        let (task, actor) = (
            loaded.task(&sets).unwrap(),
            Actor::Mean(loaded.policy.freeze()),
        );
        let trial = Trial {
            task: &task,
            actor: &actor,
            episodes,
            stop: &AtomicBool::new(false),
        };
        let played = trial.play(&mut |_| Ok(())).unwrap();
        Score::of(&played, task.config.ctrl_dt)["rot_dist"]
    };
    assert_eq!(rot_dist(&[]), logged);
    assert_ne!(rot_dist(&["env.friction_scale=0.9"]), logged);
}

fn config_of(run: &Path) -> Config {
    let text = fs::read_to_string(run.join("config.toml")).unwrap();
    let source = Source::new("config.toml", text);
    Settings::new().file(source).resolve().unwrap()
}

#[test]
fn what_cannot_be_varied_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = SCENE.replace(
        "<geom name=\"cube\" type=\"box\" size=\".025 .025 .025\"",
        "<geom name=\"cube\" type=\"mesh\" mesh=\"cube\"",
    );
    let vertices =
        "<mesh name=\"cube\" vertex=\"-.02 -.02 -.02 .02 -.02 -.02 0 .02 -.02 0 0 .02\"/>";
    let asset = SCENE
        .find("<asset>")
        .map(|_| mesh.replace("<asset>", &format!("<asset>{vertices}")));
    fs::write(
        folder.path().join("mesh.xml"),
        asset.expect("the scene has assets"),
    )
    .unwrap();
    for (sets, parts) in [
        (
            &["randomization.friction=[1.3,0.7]"][..],
            &["randomization.friction = [1.3, 0.7]: must be [low, high]"][..],
        ),
        (
            &["randomization.gains=[-1,1]"],
            &["randomization.gains = [-1.0, 1.0]: must be [low, high] with 0 < low"],
        ),
        (
            &["randomization.delay=[3,2]"],
            &["randomization.delay = [3, 2]: must be [low, high]"],
        ),
        (
            &["randomization.delay=[0,1000]"],
            &[
                "randomization.delay = [0, 1000]: must be",
                "shorter than an episode",
            ],
        ),
        (
            &["env.action_delay=1000"],
            &["env.action_delay = 1000: must be shorter than an episode, which lasts 20 steps"],
        ),
        (
            &["randomization.share=1.5"],
            &["randomization.share = 1.5: must lie in [0, 1]"],
        ),
        (
            &["randomization.push=-1"],
            &["randomization.push = -1: must not be negative"],
        ),
        (
            &["randomization.push_steps=0"],
            &["randomization.push_steps = 0: must be at least 1"],
        ),
        (
            &["randomization.noise={joints=1}"],
            &[
                "randomization.noise: `joints` is none of",
                "joint_pos, joint_vel",
            ],
        ),
        (
            &["env.bias.goal_quat=1"],
            &["env.bias: `goal_quat` is none of", "cube_quat"],
        ),
        (
            &["env.noise.joint_pos=-1"],
            &["env.noise.joint_pos = -1: must not be negative"],
        ),
        (
            &["env.noise.joint_pos=much"],
            &["env.noise.joint_pos = \"much\": must be a number"],
        ),
        (
            &["env.noise=0.1"],
            &["env.noise = 0.1: must be a table of numbers by name"],
        ),
        (
            &["env.cone=round"],
            &["env.cone = \"round\": unknown variant", "`elliptic`"],
        ),
        (
            &["env.gains_scale=0"],
            &["env.gains_scale = 0: must be above 0"],
        ),
        (
            &["env.model=mesh.xml", "env.cube_size_scale=2"],
            &["mesh.xml: body `cube` has a mesh"],
        ),
        (
            &[
                "env.model=mesh.xml",
                "randomization.share=1",
                "randomization.cube_size=[0.9,1.1]",
            ],
            &[
                "randomization.cube_size: ",
                "mesh.xml: body `cube` has a mesh",
            ],
        ),
    ] {
        let mut args = train(&["--total-steps", "128", "--run-dir", "run"]);
        sets.iter().for_each(|set| args.extend(["--set", set]));
        let output = program(folder.path(), &args);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{sets:?}: {said}");
        parts
            .iter()
            .for_each(|part| assert!(said.contains(part), "{part:?} is not in\n{said}"));
        assert!(!folder.path().join("run").exists(), "nothing is started");
    }
    let output = program(
        folder.path(),
        &[
            "play",
            "--ckpt",
            "builtin",
            "--json",
            "--set",
            "randomization.share=1",
        ],
    );
    assert!(
        stderr(&output).contains("`play` does not use randomization.share"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn the_robustness_table_has_a_row_for_each_change_and_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let short = ["--set", "env.max_episode_seconds=0.1"];
    let table = [
        "play",
        "--ckpt",
        "builtin",
        "--robustness",
        "--episodes",
        "3",
    ];
    let output = succeeded(program(
        folder.path(),
        &[&table[..], &short, &["--json", "--out", "table.svg"]].concat(),
    ));
    let value: Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = value["rows"].as_array().unwrap();
    assert_eq!(
        (rows.len(), &value["episodes"], &value["checkpoint"]),
        (34, &3.into(), &"built into the program".into())
    );
    assert_eq!(
        rows[10]["set"],
        serde_json::json!({ "env.gains_scale": 0.75 })
    );
    assert_eq!(rows[17]["set"]["env.noise"]["joint_vel"], 0.02);
    assert!(
        fs::read_to_string(folder.path().join("table.svg"))
            .unwrap()
            .contains("damping 0.3")
    );
    let output = succeeded(program(folder.path(), &[&table[..], &short].concat()));
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        text.lines()
            .any(|line| line.starts_with("friction 0.5, cube mass 2.0 ")),
        "{text}"
    );
    let other_step = ["--set", "env.ctrl_dt=0.004", "--set", "env.sim_dt=0.004"];
    let output = succeeded(program(
        folder.path(),
        &[&table[..], &short, &other_step].concat(),
    ));
    assert!(
        stderr(&output).contains("left out: row `sim_dt 0.005`"),
        "{}",
        stderr(&output)
    );
    assert!(
        !String::from_utf8(output.stdout)
            .unwrap()
            .contains("sim_dt 0.005")
    );
    let table = [
        "play",
        "--ckpt",
        "zero",
        "--robustness",
        "--episodes",
        "3",
        "--json",
    ];
    let output = succeeded(program(folder.path(), &[&table[..], &short].concat()));
    let value: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(
        value["checkpoint"] == "zero actions" && value["mean_kept"].is_null(),
        "no goals, so no share of them"
    );
}

#[test]
fn an_interrupted_robustness_table_has_the_rows_so_far() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "play",
        "--ckpt",
        "builtin",
        "--robustness",
        "--out",
        "table.svg",
    ];
    let mut command = command(folder.path(), &args);
    let mut child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Said once the program waits for signals. All rows take minutes.
    let said = BufReader::new(child.stderr.take().unwrap())
        .lines()
        .next()
        .unwrap()
        .unwrap();
    assert!(said.contains("playing"), "{said}");
    send("INT", &child);
    let mut text = String::new();
    child
        .stdout
        .take()
        .unwrap()
        .read_to_string(&mut text)
        .unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{text}");
    assert!(
        text.contains("256 episodes a row") && !text.contains("friction 1.3, cube mass 2.0"),
        "{text}"
    );
    assert!(!folder.path().join("table.svg").exists());
}

#[test]
fn the_default_varies_nothing_before_its_ramp_begins() {
    let at = |env_steps| Lesson::at(env_steps, &config(&[])).randomized;
    assert_eq!(
        [0, 40_000_000, 60_000_000, 300_000_000].map(at),
        [0.0, 0.0, 0.5, 0.5]
    );
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for (run, share) in [
        ("default", &[][..]),
        ("none", &["--set", "randomization.share=0"]),
    ] {
        let args = [
            &[
                "--total-steps",
                "1280",
                "--run-dir",
                run,
                "--set",
                "env.max_episode_seconds=0.4",
            ],
            share,
        ]
        .concat();
        succeeded(program(folder, &train(&args)));
    }
    let [default, none] = ["default", "none"]
        .map(|run| weights(folder.join(run).join("checkpoints/latest.safetensors")));
    assert!(default == none, "the first steps of both are the same bits");
    // It has no such episodes after a resume and in a fork, either.
    succeeded(program(
        folder,
        &["train", "--resume", "none", "--total-steps", "2560"],
    ));
    succeeded(program(
        folder,
        &[
            "train",
            "--fork",
            "none",
            "--total-steps",
            "3840",
            "--run-dir",
            "fork",
        ],
    ));
    for run in ["none", "fork"] {
        let share = config_of(&folder.join(run)).randomization.share;
        assert!(share == Ramp::constant(0.0), "{run}: {share:?}");
        assert!(
            !metrics(&folder.join(run))[0]
                .iter()
                .any(|name| name.starts_with("randomized/")),
            "{run}"
        );
    }
}
