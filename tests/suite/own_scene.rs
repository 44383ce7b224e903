//! What a user's scene says, and what the settings replace in it.

use std::fs;
use std::path::Path;

use crate::support::{SCENE, program, stderr, succeeded, train};

const MOVED: &str = "env.model=moved.xml";
const DEFAULT_PLACE: &str = "env.goal_position=[0.33,0,0.295]";

/// Writes `moved.xml`: the built-in scene, moved by 1 m, with another timestep and a keyframe.
fn moved_scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let moved = SCENE
        .replace("\"rh_forearm\" pos=\"0 0", "\"rh_forearm\" pos=\"1 0")
        .replace("name=\"cube\" pos=\".33", "name=\"cube\" pos=\"1.33")
        .replace("mocap=\"true\" pos=\".33", "mocap=\"true\" pos=\"1.33")
        .replace("timestep=\"0.01\"", "timestep=\"0.002\"")
        .replace(
            "</mujoco>",
            "<keyframe><key name=\"home\"/></keyframe></mujoco>",
        );
    fs::write(folder.path().join("moved.xml"), moved).unwrap();
    folder
}

/// Plays with these arguments, and returns `env.goal_position` in the header of the trace, and stderr.
fn played(folder: &Path, args: &[&str]) -> (String, String) {
    let brief = [
        "play",
        "--headless",
        "--episodes",
        "1",
        "--out",
        "trace.jsonl",
        "--set",
        "env.max_episode_seconds=0.1",
    ];
    let output = succeeded(program(folder, &[&brief, args].concat()));
    let trace = fs::read_to_string(folder.join("trace.jsonl")).unwrap();
    let header: serde_json::Value = serde_json::from_str(trace.lines().next().unwrap()).unwrap();
    (header["goal_position"].to_string(), stderr(&output))
}

fn trained(folder: &Path, run: &str, more: &[&str]) -> String {
    let args = train(&[&["--total-steps", "128", "--run-dir", run], more].concat());
    stderr(&succeeded(program(folder, &args)))
}

fn place_in(folder: &Path, run: &str) -> String {
    let config = fs::read_to_string(folder.join(run).join("config.toml")).unwrap();
    config
        .lines()
        .find_map(|line| line.strip_prefix("goal_position = "))
        .unwrap()
        .to_owned()
}

#[test]
fn the_cube_starts_where_a_users_scene_has_it_unless_the_user_names_a_place() {
    let folder = moved_scene();
    let folder = folder.path();
    let (place, _) = played(folder, &["--ckpt", "builtin", "--set", MOVED]);
    assert_eq!(
        place, "[1.33,0.0,0.295]",
        "the policy's file only repeats the default"
    );
    let (place, said) = played(folder, &["--ckpt", "zero", "--set", MOVED]);
    assert_eq!(place, "[1.33,0.0,0.295]");
    assert!(
        said.contains(
            "`cube` starts where moved.xml has it: env.goal_position = [1.33, 0.0, 0.295]"
        ),
        "{said}"
    );
    let (place, said) = played(
        folder,
        &["--ckpt", "zero", "--set", MOVED, "--set", DEFAULT_PLACE],
    );
    assert_eq!(place, "[0.33,0.0,0.295]");
    assert!(
        said.contains("replaces the place of `cube` in moved.xml, [1.33, 0.0, 0.295]"),
        "{said}"
    );
    assert_eq!(
        played(folder, &["--ckpt", "zero"]).0,
        "[0.33,0.0,0.295]",
        "the built-in scene has the default"
    );
}

#[test]
fn a_training_records_where_its_cube_started_and_goes_on_there() {
    let folder = moved_scene();
    let folder = folder.path();
    trained(folder, "scenes", &["--set", MOVED]);
    let said = stderr(&succeeded(program(
        folder,
        &train(&["--set", MOVED, "--run-dir", "said", "--total-steps", "128"]),
    )));
    let scene = folder.canonicalize().unwrap().join("moved.xml");
    let next = format!("play --ckpt said --set env.model={}", scene.display());
    assert!(
        said.lines().any(|line| line.ends_with(&next)),
        "{next} is not in\n{said}"
    );
    assert_eq!(place_in(folder, "scenes"), "[1.33, 0.0, 0.295]");
    fs::write(
        folder.join("own.toml"),
        "[env]\ngoal_position = [0.33, 0, 0.295]\n",
    )
    .unwrap();
    trained(folder, "named", &["--config", "own.toml", "--set", MOVED]);
    assert_eq!(place_in(folder, "named"), "[0.33, 0.0, 0.295]");
    for (run, place) in [
        ("scenes", "[1.33,0.0,0.295]"),
        ("named", "[0.33,0.0,0.295]"),
    ] {
        assert_eq!(
            played(folder, &["--ckpt", run, "--set", MOVED]).0,
            place,
            "{run}"
        );
        let more = [
            "train",
            "--resume",
            run,
            "--set",
            MOVED,
            "--total-steps",
            "256",
        ];
        succeeded(program(folder, &more));
        let fork = [
            "train",
            "--fork",
            run,
            "--set",
            MOVED,
            "--total-steps",
            "384",
            "--run-dir",
            "fork",
        ];
        succeeded(program(folder, &fork));
        assert_eq!(place_in(folder, "fork").replace(' ', ""), place, "{run}");
        fs::remove_dir_all(folder.join("fork")).unwrap();
    }
}

#[test]
fn a_policy_starts_its_cube_where_another_scene_has_it() {
    let folder = moved_scene();
    let folder = folder.path();
    trained(folder, "run", &["--set", MOVED]);
    let other = fs::read_to_string(folder.join("moved.xml"))
        .unwrap()
        .replace("pos=\"1.33 0 ", "pos=\"1.33 -.01 ");
    fs::write(folder.join("other.xml"), other).unwrap();
    for (scene, place) in [
        ("moved.xml", "[1.33,0.0,0.295]"),
        ("other.xml", "[1.33,-0.01,0.295]"),
        ("builtin", "[0.33,0.0,0.295]"),
    ] {
        let model = format!("env.model={scene}");
        assert_eq!(played(folder, &["--ckpt", "run", "--set", &model]).0, place);
    }
}

#[test]
fn what_is_replaced_of_a_users_scene_is_said_at_the_start() {
    let folder = moved_scene();
    let folder = folder.path();
    let timestep = "env.sim_dt = 0.01 s replaces the timestep of ";
    for said in [
        played(folder, &["--ckpt", "zero", "--set", MOVED]).1,
        trained(folder, "r", &["--set", MOVED]),
    ] {
        assert!(
            said.contains(timestep)
                && said.contains("0.002 s")
                && said.contains("start in the keyframe `home`"),
            "{said}"
        );
    }
    let own = [
        "--ckpt",
        "zero",
        "--set",
        MOVED,
        "--set",
        "env.sim_dt=0.002",
    ];
    assert!(!played(folder, &own).1.contains(timestep), "it is the same");
    assert!(
        !trained(folder, "b", &[]).contains(timestep),
        "the built-in scene is ours"
    );
    assert!(!trained(folder, "q", &["--set", MOVED, "--quiet"]).contains(timestep));
}

#[test]
fn an_object_with_less_symmetry_than_the_policy_assumes_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = |size: &str| {
        SCENE.replace(
            "type=\"box\" size=\".025 .025 .025\" mass",
            &format!("{size} mass"),
        )
    };
    fs::write(
        folder.join("box.xml"),
        scene("type=\"box\" size=\".035 .025 .02\""),
    )
    .unwrap();
    fs::write(
        folder.join("cube.xml"),
        scene("type=\"box\" size=\".03 .03 .03\""),
    )
    .unwrap();
    let alike = "has only 4 that are alike";
    let play = |policy: [&str; 2], scene: &str| {
        played(folder, &[&policy[..], &["--set", scene]].concat()).1
    };
    assert!(play(["--ckpt", "builtin"], "env.model=box.xml").contains(alike));
    assert!(!play(["--ckpt", "builtin"], "env.model=cube.xml").contains("alike"));
    assert!(
        !play(["--ckpt", "zero"], "env.model=box.xml").contains("alike"),
        "no policy, no symmetry"
    );
    let train_with = |run: &str, symmetry: &str| {
        let symmetry = format!("ppo.symmetry={symmetry}");
        trained(
            folder,
            run,
            &["--set", "env.model=box.xml", "--set", &symmetry],
        )
    };
    assert!(train_with("cube", "cube").contains(alike));
    assert!(!train_with("none", "none").contains("alike"));
    let said = train_with("object", "object");
    assert!(
        said.contains("4 of the 24 rotations of a cube map `cube` onto itself")
            && !said.contains("alike"),
        "{said}"
    );
    assert!(
        !play(["--ckpt", "object"], "env.model=box.xml").contains("alike"),
        "it keeps the four"
    );
    assert!(play(["--ckpt", "object"], "env.model=box.xml").contains("4 of the 24"));
}
