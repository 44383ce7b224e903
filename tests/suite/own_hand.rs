//! Hands of other kinds, found by the structure of their scene, and the mirror image of the built-in one.

use std::fs;
use std::path::Path;

use serde_json::Value;
use shadow_repose::env::Env;
use shadow_repose::repose::{Repose, Task};
use shadow_repose::rng;

use crate::support::{SCENE, config, program, stderr, succeeded, task, train};

/// A hand of three fingers: nine joints, six actuators, tendons, sites, and a box.
const THREE_FINGERS: &str = include_str!("three_fingers.xml");

/// The built-in scene in the mirror, the plane y = 0, with the names of a left hand.
fn left_scene() -> String {
    let signs = [
        ("pos=\"", [1.0, -1.0, 1.0, 1.0]),
        ("quat=\"", [1.0, -1.0, 1.0, -1.0]),
        ("axis=\"", [-1.0, 1.0, -1.0, 1.0]),
    ];
    let mut scene = SCENE.replace("rh_", "lh_");
    for (attribute, signs) in signs {
        let parts = scene
            .split(attribute)
            .map(str::to_owned)
            .collect::<Vec<_>>();
        let mirrored = parts.iter().enumerate().map(|(i, part)| {
            let (numbers, rest) = part.split_once('"').unwrap();
            if i == 0 {
                return part.clone();
            }
            let numbers = numbers
                .split_whitespace()
                .zip(signs)
                .map(|(x, sign)| (sign * x.parse::<f64>().unwrap()).to_string());
            format!("{}\"{rest}", numbers.collect::<Vec<_>>().join(" "))
        });
        scene = mirrored.collect::<Vec<_>>().join(attribute);
    }
    scene
}

/// Writes a scene into a new folder, and returns it with the setting that names it.
fn placed(scene: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("scene.xml"), scene).unwrap();
    let set = format!("env.model={}", folder.path().join("scene.xml").display());
    (folder, set)
}

fn refusal(scene: &str, sets: &[&str]) -> String {
    let (_folder, model) = placed(scene);
    let config = crate::support::config(&[&[&model[..]], sets].concat());
    format!("{:#}", Task::new(&config).err().expect("it is refused"))
}

fn header(trace: &Path) -> Value {
    serde_json::from_str(fs::read_to_string(trace).unwrap().lines().next().unwrap()).unwrap()
}

#[test]
fn a_hand_of_another_kind_is_trained_resumed_played_and_exported() {
    let (folder, model) = placed(THREE_FINGERS);
    let folder = folder.path();
    let tips = "hand.fingertips=[\"α end\",\"β end\",\"γ end\"]";
    let own = ["--set", &model, "--set", tips, "--run-dir", "run"];
    let said = stderr(&succeeded(program(
        folder,
        &train(&[&["--total-steps", "256"], &own[..]].concat()),
    )));
    assert!(
        said.contains("random actions turn it, rad in 100 steps")
            && said.contains("keyframe `cupped`"),
        "{said}"
    );
    let config = fs::read_to_string(folder.join("run/config.toml")).unwrap();
    for line in [
        "num_hand_dofs = 9",
        "num_actuators = 6",
        "goal_position = [0.0, 0.0, 0.245]",
        "\"α end\"",
    ] {
        assert!(config.contains(line), "{line}: {config}");
    }
    succeeded(program(
        folder,
        &[
            "train",
            "--resume",
            "run",
            "--set",
            &model,
            "--total-steps",
            "384",
        ],
    ));
    let play = [
        "play",
        "--ckpt",
        "run",
        "--set",
        &model,
        "--json",
        "--episodes",
        "2",
        "--out",
        "t.jsonl",
    ];
    succeeded(program(folder, &play));
    let header = header(&folder.join("t.jsonl"));
    assert_eq!(header["joint_names"].as_array().unwrap().len(), 9);
    assert_eq!(header["actuator_names"][1], "α bends");
    assert_eq!(header["fingertip_names"][2], "γ end");
    let groups = header["observation"].as_array().unwrap();
    assert_eq!(
        groups
            .iter()
            .map(|group| group["length"].as_u64().unwrap())
            .sum::<u64>(),
        18 + 24 + 39 + 6
    );
    succeeded(program(
        folder,
        &["export", "--ckpt", "run", "--set", &model],
    ));
    let scene = folder.join("scene.xml");
    crate::export::check_in_python(
        folder,
        &[
            "policy.onnx",
            "--scene",
            scene.to_str().unwrap(),
            "--check",
            "t.jsonl",
        ],
    );
}

#[test]
fn a_policy_of_another_hand_is_refused_by_the_names_that_differ() {
    let (folder, model) = placed(THREE_FINGERS);
    let folder = folder.path();
    let said = stderr(&program(
        folder,
        &["play", "--ckpt", "builtin", "--headless", "--set", &model],
    ));
    assert!(
        said.contains("for another hand")
            && said.contains("has 9 joints, not 24, 6 actuators, not 20"),
        "{said}"
    );
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run", "--set", &model]),
    ));
    let said = stderr(&program(
        folder,
        &[
            "play",
            "--ckpt",
            "run",
            "--headless",
            "--set",
            "env.model=builtin",
        ],
    ));
    assert!(
        said.contains("for another hand") && said.contains("has 24 joints, not 9"),
        "{said}"
    );
    let said = stderr(&program(
        folder,
        &[
            "train",
            "--init",
            "builtin",
            "--run-dir",
            "other",
            "--set",
            &model,
        ],
    ));
    assert!(said.contains("for another hand"), "{said}");
}

#[test]
fn the_joint_that_another_scene_calls_otherwise_is_named() {
    let (folder, model) = placed(THREE_FINGERS);
    let folder = folder.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run", "--set", &model]),
    ));
    let (_other, model) = placed(&THREE_FINGERS.replace("γ tip", "γ end joint"));
    let said = stderr(&program(
        folder,
        &["play", "--ckpt", "run", "--headless", "--set", &model],
    ));
    assert!(
        said.contains("for another hand")
            && said.contains("has the joint `γ end joint` for `γ tip`\n"),
        "{said}"
    );
}

#[test]
fn names_that_no_scene_can_hold_are_refused() {
    let output = program(
        &std::env::temp_dir(),
        &[
            "play",
            "--ckpt",
            "zero",
            "--headless",
            "--set",
            "hand.joints=[\"a\\u0000b\"]",
        ],
    );
    assert!(
        stderr(&output).contains("hand.joints")
            && stderr(&output).contains("without control characters"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn the_base_as_a_users_file_names_nothing() {
    let (folder, model) = placed(THREE_FINGERS);
    let base = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/repose.toml");
    let small = [
        "env.num_envs=16",
        "ppo.horizon=8",
        "run.eval_episodes=2",
        "run.total_steps=128",
        "env.max_episode_seconds=0.2",
    ];
    let small: Vec<&str> = small.iter().flat_map(|set| ["--set", *set]).collect();
    let with_base = ["train", "--config", base];
    succeeded(program(
        folder.path(),
        &[&with_base[..], &["--set", &model, "--run-dir", "a"], &small].concat(),
    ));
    succeeded(program(
        folder.path(),
        &[
            &with_base[..],
            &["--init", "builtin", "--run-dir", "b"],
            &small,
        ]
        .concat(),
    ));
}

#[test]
fn a_hand_with_a_comma_in_a_name_is_trained_but_not_exported() {
    let (folder, model) = placed(&THREE_FINGERS.replace('α', "a,b"));
    let folder = folder.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run", "--set", &model]),
    ));
    let said = stderr(&program(
        folder,
        &["export", "--ckpt", "run", "--set", &model],
    ));
    assert!(
        said.contains("`a,b turn`") && said.contains("comma"),
        "{said}"
    );
}

#[test]
fn an_action_that_means_another_angle_than_in_training_is_warned_of() {
    let joints = "<joint joint=\"rh_FFJ2\" coef=\"1\"/><joint joint=\"rh_FFJ1\" coef=\"1\"/>";
    let in_other_order =
        "<joint joint=\"rh_FFJ1\" coef=\"1\"/><joint joint=\"rh_FFJ2\" coef=\"1\"/>";
    for (from, to, differ) in [
        (
            "ctrlrange=\"0 3.1415\"",
            "ctrlrange=\"0 3\"",
            "rh_A_FFJ0 rh_A_MFJ0 rh_A_RFJ0 rh_A_LFJ0",
        ),
        ("joint=\"rh_FFJ3\"/>", "joint=\"rh_FFJ4\"/>", "rh_A_FFJ3"),
        (
            "joint=\"rh_MFJ1\" coef=\"1\"",
            "joint=\"rh_MFJ1\" coef=\"2\"",
            "rh_A_MFJ0",
        ),
        (joints, in_other_order, ""),
    ] {
        assert!(SCENE.contains(from), "{from}");
        let (_folder, model) = placed(&SCENE.replace(from, to));
        let there = Task::new(&config(&[&model])).unwrap();
        let warnings = there
            .for_policy(&task(&[]).record())
            .unwrap()
            .warnings
            .join("");
        assert_eq!(warnings.is_empty(), differ.is_empty(), "{to}: {warnings}");
        assert!(
            differ.is_empty() || warnings.contains(&format!("the tendons of {differ} differ")),
            "{to}: {warnings}"
        );
    }
    let (folder, model) = placed(&SCENE.replace("ctrlrange=\"0 3.1415\"", "ctrlrange=\"0 3\""));
    let play = [
        "play",
        "--ckpt",
        "builtin",
        "--json",
        "--episodes",
        "1",
        "--set",
        "env.max_episode_seconds=0.1",
    ];
    let said = stderr(&succeeded(program(
        folder.path(),
        &[&play[..], &["--set", &model]].concat(),
    )));
    assert!(said.contains("means another angle"), "{said}");
}

/// The built-in scene, in which the last joints of the fingers follow the joints before them.
fn with_followers() -> String {
    let mut scene = SCENE.to_owned();
    let mut ties = String::new();
    for finger in ["FF", "MF", "RF", "LF"] {
        let servo = format!("class=\"tendon\" tendon=\"rh_{finger}J0\"");
        assert!(scene.contains(&servo));
        scene = scene.replace(&servo, &format!("class=\"hand\" joint=\"rh_{finger}J2\""));
        ties += &format!("<joint joint1=\"rh_{finger}J1\" joint2=\"rh_{finger}J2\"/>");
    }
    scene.replace(
        "<actuator>",
        &format!("<equality>{ties}</equality><actuator>"),
    )
}

#[test]
fn a_shadow_hand_whose_last_joints_follow_others_is_taken_by_any_prefix() {
    for prefix in ["rh_", "ih_", ""] {
        let (_folder, model) = placed(&with_followers().replace("rh_", prefix));
        let task = Task::new(&config(&[&model])).unwrap();
        assert_eq!(task.hand.side(), Some(prefix));
        assert_eq!(task.hand.driven[7], [(format!("{prefix}FFJ2"), 1.0)]);
    }
}

#[test]
fn joints_that_follow_others_start_where_constraints_want_them_and_joints_in_loops_have_no_noise() {
    let ties = "<joint joint1=\"γ bend\" joint2=\"β tip\" polycoef=\".1 .5 .2 0 0\"/>\
                <joint joint1=\"β tip\" joint2=\"β bend\"/>\
                <joint joint1=\"β turn\" polycoef=\".2 1 0 0 0\"/>\
                <joint joint1=\"γ tip\" joint2=\"γ turn\" active=\"false\"/>\
                <connect body1=\"α distal\" body2=\"palm\" anchor=\".03 0 0\"/>";
    let (_folder, model) =
        placed(&THREE_FINGERS.replace("<tendon>", &format!("<equality>{ties}</equality><tendon>")));
    let task = task(&[&model]);
    let mut env = Repose::new(&task);
    let mut observation = vec![0.0; task.spaces().observation_size];
    let mut starts = Vec::new();
    for episode in 0..3 {
        env.reset(rng::stream(7, "test", episode), &mut observation);
        starts.push(env.sim.qpos()[..9].to_vec());
    }
    for start in &starts {
        let [.., turn, bend, tip, _, follower, _] = start[..] else {
            panic!("nine joints")
        };
        assert_eq!(start[..3], [0.0, 0.6, 0.4], "the keyframe");
        assert!((turn - 0.2).abs() < 1e-12 && (tip - bend).abs() < 1e-12);
        assert!((follower - (0.1 + 0.5 * tip + 0.2 * tip * tip)).abs() < 1e-12);
    }
    for noisy in [4, 6, 8] {
        assert_ne!(starts[0][noisy], starts[1][noisy]);
    }
    let notes = task.notes().join("\n");
    assert!(
        notes.contains("3 joints are in loops, which equality constraints close"),
        "{notes}"
    );
    // A mocap body that guides the whole hand closes no loop.
    let (_folder, model) = placed(&SCENE.replace(
        "</worldbody>",
        "<body name=\"guide\" mocap=\"true\"/></worldbody><equality><weld body1=\"guide\" body2=\"rh_forearm\"/></equality>",
    ));
    let hand = &crate::support::task(&[&model]).hand;
    assert!(hand.joints.iter().all(|joint| !joint.is_in_loop));
}

#[test]
fn joints_that_follow_each_other_hold_all_constraints_or_start_without_noise() {
    let tie = |one: &str, other: &str, factor: f64| {
        format!("<joint joint1=\"{one}\" joint2=\"{other}\" polycoef=\"0 {factor} 0 0 0\"/>")
    };
    let start = |ties: &[String]| {
        let more = format!("<equality>{}</equality><tendon>", ties.concat());
        let (_folder, model) = placed(&THREE_FINGERS.replace("<tendon>", &more));
        let task = task(&[&model]);
        let mut env = Repose::new(&task);
        let mut observation = vec![0.0; task.spaces().observation_size];
        env.reset(rng::stream(7, "test", 3), &mut observation);
        (env.sim.qpos()[..9].to_vec(), task.hand.start[..9].to_vec())
    };
    let [a, b, c] = ["β bend", "β tip", "γ bend"];
    for ties in [
        &[tie(a, b, 1.0), tie(a, b, 1.0)][..],
        &[tie(a, b, 1.0), tie(b, a, 1.0)],
        &[tie(a, b, 1.0), tie(a, c, 1.0), tie(b, c, 1.0)],
    ] {
        let (found, pose) = start(ties);
        assert!(
            (found[4] - found[5]).abs() < 1e-12 && found != pose,
            "{found:?}"
        );
    }
    // No angles but zero satisfy both.
    let (found, pose) = start(&[tie(a, b, 2.0), tie(b, a, 2.0)]);
    assert_eq!(found, pose);
}

#[test]
fn a_fingertip_is_a_part_of_the_hand() {
    let marked = THREE_FINGERS.replace("<freejoint/>", "<freejoint/><site name=\"on the block\"/>");
    let marked = marked.replace(
        "</worldbody>",
        "<site name=\"in the world\"/><body name=\"mark\" mocap=\"true\"/></worldbody>",
    );
    for tip in ["world", "block", "on the block", "in the world", "mark"] {
        let tips = format!("hand.fingertips=[\"α end\", \"{tip}\"]");
        let said = refusal(&marked, &[&tips]);
        assert!(
            said.contains("hand.fingertips must name parts of the hand"),
            "{tip}: {said}"
        );
    }
}

#[test]
fn a_name_that_is_too_long_for_messages_is_refused() {
    let named =
        |length: usize| THREE_FINGERS.replace("\"block\"", &format!("\"{}\"", "n".repeat(length)));
    assert!(refusal(&named(256), &[]).contains("has more than 255 bytes"));
    let (_folder, model) = placed(&named(255));
    task(&[&model]);
}

#[test]
fn a_mocap_body_that_guides_something_is_not_the_goal() {
    let guide = "<body name=\"guide\" mocap=\"true\"/></worldbody>";
    let tied = |constraint: &str| format!("<equality>{constraint}</equality></mujoco>");
    let site = "<body><site name=\"grip\"/></body></body></worldbody>";
    for (bodies, constraint) in [
        (guide.to_owned(), "<weld body1=\"guide\" body2=\"palm\"/>"),
        (
            guide.replace("/></worldbody>", &format!(">{site}")),
            "<connect site1=\"grip\" site2=\"α end\"/>",
        ),
    ] {
        let scene = THREE_FINGERS
            .replace("</worldbody>", &bodies)
            .replace("</mujoco>", &tied(constraint));
        let (_folder, model) = placed(&scene);
        assert_eq!(
            task(&[&model]).hand.parts.goal,
            "goal of shadow-repose",
            "{constraint}"
        );
    }
}

#[test]
fn parts_without_a_name_are_called_by_what_they_drive_or_what_moves_them() {
    let mut scene = THREE_FINGERS.to_owned();
    for name in ["α distal", "α turns"] {
        let attribute = format!("name=\"{name}\" ");
        assert!(scene.contains(&attribute), "{name}");
        scene = scene.replace(&attribute, "");
    }
    let (_folder, model) = placed(&scene);
    let named = Task::new(&crate::support::config(&[&model])).unwrap();
    let parts = &named.hand.parts;
    assert!(
        parts.actuators.contains(&"servo of α turn".to_owned()),
        "{:?}",
        parts.actuators
    );
    assert!(
        parts.fingertips[0].starts_with("link of α"),
        "{:?}",
        parts.fingertips
    );
    assert!(named.notes().concat().contains("parts without a name in"));
    let (_other, model) = placed(THREE_FINGERS);
    let own = Task::new(&crate::support::config(&[&model])).unwrap();
    assert_eq!(own.scene.fingerprint(), named.scene.fingerprint());
    assert!(!own.notes().concat().contains("no name"));
}

#[test]
fn what_is_missing_or_ambiguous_in_a_scene_comes_in_one_message_with_the_setting_that_mends_it() {
    let block = THREE_FINGERS
        .split("<body name=\"block\"")
        .nth(1)
        .unwrap()
        .split("</body>")
        .next()
        .unwrap();
    let block = format!("<body name=\"block\"{block}</body>");
    let without = THREE_FINGERS
        .replace(&block, "")
        .replace("0 .6 .4 0 0 .245 1 0 0 0", "0 .6 .4");
    let two = THREE_FINGERS.replace(
        &block,
        &format!("{block}{}", block.replace("block", "other")),
    );
    let two = two.replace("0 0 .245 1 0 0 0", "0 0 .245 1 0 0 0 0 0 .3 1 0 0 0");
    let goals = "<body name=\"g1\" mocap=\"true\"/><body name=\"g2\" mocap=\"true\"/></worldbody>";
    let both = two.replace("</worldbody>", goals);
    for (scene, sets, parts) in [
        (
            &without,
            &[][..],
            &["<body name=\"cube\" pos=\"X Y Z\"><freejoint/>"][..],
        ),
        (
            &two,
            &[],
            &["several bodies with a free joint, `block`, `other`: name one by hand.object"],
        ),
        (
            &both,
            &[],
            &[
                "name one by hand.object",
                "several mocap bodies, `g1`, `g2`: name one by hand.goal",
            ],
        ),
        (
            &THREE_FINGERS.replace("<position name=\"α turns\" ", "<motor name=\"α turns\" "),
            &[],
            &["`α turns` must be a position servo"],
        ),
        (
            &THREE_FINGERS.to_owned(),
            &["hand.joints=[\"α turn\",\"δ\"]", "hand.goal=none"],
            &["has no body `none`; has no joint `δ`"],
        ),
        (
            &THREE_FINGERS.to_owned(),
            &["hand.start=flat"],
            &["has no keyframe `flat`"],
        ),
        (
            &THREE_FINGERS.to_owned(),
            &["hand.joints=[\"α turn\",\"α turn\"]"],
            &["`α turn` is named twice"],
        ),
        (
            &THREE_FINGERS.replace("joint=\"α turn\" ctrl", "joint=\"α turn\" gear=\"2\" ctrl"),
            &["hand.fingertips=[\"x\"]"],
            &["gear of 1", "no body or site `x`"],
        ),
        (
            &THREE_FINGERS.replace("axis=\"0 0 1\" range=\"-.4 .4\"", "axis=\"0 0 1\""),
            &[],
            &["joint `α turn` must have a range; joint `β turn` must have a range"],
        ),
        (
            &THREE_FINGERS.replace(".245 1 0 0 0", "200 1 0 0 0"),
            &[],
            &["`block` starts more than 100 m away"],
        ),
        (
            &THREE_FINGERS.replace(
                "</worldbody>",
                "<body name=\"goal of shadow-repose\"/></worldbody>",
            ),
            &[],
            &["has a body `goal of shadow-repose` that is no mocap body"],
        ),
        (
            &THREE_FINGERS.to_owned(),
            &["env.num_hand_dofs=24"],
            &["env.num_hand_dofs = 24: the hand of ", "has 9 joints"],
        ),
        (
            &"<mujoco/>".to_owned(),
            &[],
            &[
                "has no hand",
                "hand.joints and hand.actuators",
                "<freejoint/>",
            ],
        ),
    ] {
        let message = refusal(scene, sets);
        assert!(
            parts.iter().all(|part| message.contains(part)),
            "{parts:?} in {message}"
        );
    }
    let (_folder, model) = placed(&both);
    let config = crate::support::config(&[&model, "hand.object=other", "hand.goal=g2"]);
    let task = Task::new(&config).unwrap();
    assert_eq!(
        (&*task.hand.parts.object, &*task.hand.parts.goal),
        ("other", "g2")
    );
}

#[test]
fn a_scene_that_shows_no_goal_gets_one_that_touches_nothing() {
    let (_folder, model) = placed(THREE_FINGERS);
    let task = Task::new(&config(&[&model])).unwrap();
    let mut env = Repose::new(&task);
    let mut observation = vec![0.0; task.spaces().observation_size];
    env.reset(rng::stream(0, "test", 0), &mut observation);
    let goal = task.scene.frame(&task.hand.parts.goal).unwrap();
    let pose = env.sim.pose(goal);
    assert!((pose.position[2] - 0.445).abs() < 1e-9, "{pose:?}");
    assert_eq!(
        pose.orientation.map(|x| x as f32),
        env.goal.map(|x| x as f32)
    );
}

#[test]
fn the_mirror_image_of_the_hand_sees_and_does_in_the_mirror_what_the_hand_does() {
    let (folder, model) = placed(&left_scene());
    let folder = folder.path();
    let play = [
        "play",
        "--ckpt",
        "builtin",
        "--episodes",
        "4",
        "--set",
        &model,
    ];
    let goals = |args: &[&str]| -> f64 {
        let score: Value =
            serde_json::from_slice(&succeeded(program(folder, args)).stdout).unwrap();
        score["goals_per_episode"].as_f64().unwrap()
    };
    assert!(
        goals(&[&play[..], &["--json"]].concat()) > 6.0,
        "the right hand reaches more than nine"
    );
    let output = succeeded(program(
        folder,
        &[&play[..], &["--out", "t.jsonl"]].concat(),
    ));
    assert_eq!(
        stderr(&output).matches("plays mirrored").count(),
        1,
        "{}",
        stderr(&output)
    );
    let exported = succeeded(program(
        folder,
        &["export", "--ckpt", "builtin", "--set", &model],
    ));
    assert!(
        stderr(&exported).contains("plays mirrored"),
        "{}",
        stderr(&exported)
    );
    let scene = folder.join("scene.xml");
    crate::export::check_in_python(
        folder,
        &[
            "policy.onnx",
            "--scene",
            scene.to_str().unwrap(),
            "--check",
            "t.jsonl",
        ],
    );
    let run = [
        "--init",
        "builtin",
        "--total-steps",
        "128",
        "--run-dir",
        "run",
        "--set",
        &model,
    ];
    let small = [
        "env.num_envs=16",
        "ppo.horizon=8",
        "run.eval_episodes=2",
        "randomization.share=0",
    ];
    let small: Vec<&str> = small.iter().flat_map(|set| ["--set", *set]).collect();
    let said = stderr(&succeeded(program(
        folder,
        &[&["train"], &run[..], &small].concat(),
    )));
    assert!(said.contains("plays mirrored"), "{said}");
    let trained = [
        "play",
        "--ckpt",
        "run",
        "--json",
        "--episodes",
        "4",
        "--set",
    ];
    assert!(
        goals(&[&trained[..], &[&model]].concat()) > 4.0,
        "it plays the left hand in the mirror"
    );
    assert!(
        goals(&[&trained[..], &["env.model=builtin"]].concat()) > 4.0,
        "its own hand is still the right one"
    );
    // Names of a left hand in a scene that is none.
    fs::write(folder.join("named.xml"), SCENE.replace("rh_", "lh_")).unwrap();
    let wrong = program(
        folder,
        &[
            "play",
            "--ckpt",
            "builtin",
            "--headless",
            "--set",
            "env.model=named.xml",
        ],
    );
    assert!(
        stderr(&wrong).contains("not the mirror image"),
        "{}",
        stderr(&wrong)
    );
}

#[test]
fn where_names_do_not_tell_the_side_of_a_hand_its_fingertips_do() {
    let (folder, right) = placed(&SCENE.replace("rh_", ""));
    let folder = folder.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run", "--set", &right]),
    ));
    fs::write(folder.join("left.xml"), left_scene().replace("lh_", "")).unwrap();
    // Neither where the policy's hand has its fingertips, nor in the mirror.
    let moved = SCENE
        .replace("rh_", "")
        .replacen("pos=\"0 0 .034\"", "pos=\"0 0 .044\"", 1);
    fs::write(folder.join("moved.xml"), moved).unwrap();
    for (model, mirrored) in [
        (&*right, false),
        ("env.model=left.xml", true),
        ("env.model=moved.xml", false),
    ] {
        let play = [
            "play",
            "--ckpt",
            "run",
            "--headless",
            "--episodes",
            "1",
            "--set",
            model,
        ];
        let said = stderr(&succeeded(program(folder, &play)));
        assert_eq!(said.contains("plays mirrored"), mirrored, "{model}: {said}");
    }
}
