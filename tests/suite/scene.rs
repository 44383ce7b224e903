//! The built-in scene and custom scenes.

use std::path::PathBuf;

use shadow_repose::env::Env;
use shadow_repose::repose::{Hand, Repose, Task};
use shadow_repose::sim::{Compilation, Cone, Parts, Scene, Simulation};

use crate::support::{OBSERVATION_SIZE, SCENE, config, started, task};

/// Writes `text` as a scene, tries to create a task from it, and returns the error message.
fn refusal(text: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = write(&folder, text);
    let setting = format!("env.model={}", path.display());
    match Task::new(&config(&[&setting])) {
        Ok(_) => panic!("must be refused"),
        Err(error) => format!("{error:#}"),
    }
}

fn write(folder: &tempfile::TempDir, text: &str) -> PathBuf {
    let path = folder.path().join("own_scene.xml");
    std::fs::write(&path, text).unwrap();
    path
}

#[track_caller]
fn edited(from: &str, to: &str) -> String {
    assert!(SCENE.contains(from), "{from} is not in the scene");
    SCENE.replace(from, to)
}

/// Fails unless a scene with each of these texts replaced is refused with its file and this part of a message.
#[track_caller]
fn refused_when_edited(edits: &[(&str, &str, &str)]) {
    for (from, to, part) in edits {
        let message = refusal(&edited(from, to));
        assert!(
            message.contains(part) && message.contains("own_scene.xml"),
            "{part} is not in: {message}"
        );
    }
}

#[track_caller]
fn assert_range(found: [f64; 2], expected: [f64; 2]) {
    assert!(
        (0..2).all(|i| (found[i] - expected[i]).abs() < 1e-12),
        "{found:?} instead of {expected:?}"
    );
}

#[test]
fn the_scene_has_the_joints_actuators_and_limits_of_the_hand() {
    let scene = Scene::load(None, &Compilation::plain(0.01, Cone::Scene)).unwrap();
    let hand = Hand::bind(
        &scene,
        Hand::find(&scene, &Parts::default()).unwrap(),
        false,
    )
    .unwrap();
    assert_eq!(scene.controls(), 20);
    for (name, range) in [
        ("rh_WRJ2", [-0.523599, 0.174533]),
        ("rh_WRJ1", [-0.698132, 0.488692]),
        ("rh_FFJ4", [-0.349066, 0.349066]),
        ("rh_LFJ5", [0.0, 0.785398]),
        ("rh_RFJ3", [-0.261799, 1.5708]),
        ("rh_MFJ2", [0.0, 1.5708]),
        ("rh_THJ5", [-1.0472, 1.0472]),
        ("rh_THJ1", [-0.261799, 1.5708]),
    ] {
        assert_range(scene.hinge(name).unwrap().range, range);
    }
    // THJ5 … THJ1, FFJ4, FFJ3, FFJ0: the range of a coupled actuator is the sum of two ranges.
    assert_range(hand.actuators[0].range, [-1.0472, 1.0472]);
    assert_range(hand.actuators[7].range, [0.0, 3.1415]);
    assert_range(hand.actuators[18].range, [-0.523599, 0.174533]);
}

#[test]
fn a_still_hand_holds_the_cube_in_most_orientations() {
    let task = task(&[]);
    let mut env = Repose::new(&task);
    let mut observation = vec![0.0; OBSERVATION_SIZE];
    let mut held = 0;
    for episode in 0..20 {
        env.reset(
            shadow_repose::rng::stream(0, "test", episode),
            &mut observation,
        );
        if (0..200).all(|_| env.step(&[0.0; 20], &mut observation).end.is_none()) {
            held += 1;
        }
    }
    assert!(held >= 17, "held {held} of 20");
}

#[test]
fn two_halves_of_a_step_are_the_same_bits_as_a_whole_one() {
    let task = task(&[]);
    let (mut env, mut observation) = started(&task);
    for _ in 0..40 {
        // Until the cube lies in the hand, so that the steps have contacts.
        let _ = env.step(&[0.3; 20], &mut observation);
    }
    let mut bare = Simulation::new(&task.scene);
    bare.restore(&env.sim.state()).unwrap();
    let simulation = &mut env.sim;
    for step in 0..50 {
        let ctrl: Vec<f64> = simulation
            .ctrl()
            .iter()
            .map(|c| c + 0.001 * f64::from(step))
            .collect();
        simulation.ctrl_mut().copy_from_slice(&ctrl);
        assert!(!simulation.step(1));
        bare.ctrl_mut().copy_from_slice(&ctrl);
        bare.step_whole(1);
        assert_eq!(simulation.qpos(), bare.qpos(), "step {step}");
    }
}

#[test]
fn bodies_are_of_the_same_instant_as_joints() {
    let task = task(&[]);
    let (mut env, mut observation) = started(&task);
    for _ in 0..25 {
        let _ = env.step(&[0.5; 20], &mut observation);
    }
    // Another simulation with the same joint positions and velocities, whose bodies are computed from these alone.
    let tip = task.scene.frame("rh_ffdistal").unwrap();
    let mut other = Simulation::new(&task.scene);
    other.qpos_mut().copy_from_slice(env.sim.qpos());
    other.qvel_mut().copy_from_slice(env.sim.qvel());
    other.refresh();
    assert_eq!(other.pose(tip), env.sim.pose(tip));
    assert_eq!(other.velocity(tip), env.sim.velocity(tip));
    let position: Vec<f32> = other.pose(tip).position.iter().map(|&x| x as f32).collect();
    assert_eq!(observation[72..75], position);
    let linear: Vec<f32> = other
        .velocity(tip)
        .linear
        .iter()
        .map(|&x| x as f32)
        .collect();
    assert_eq!(observation[79..82], linear);
}

#[test]
fn an_own_scene_may_list_its_parts_in_any_order() {
    // The actuators in reverse order: controls are found by name, so the hand behaves the same.
    let start = SCENE.find("    <position name=\"rh_A_WRJ2\"").unwrap();
    let end = SCENE.find("  </actuator>").unwrap();
    let reversed: Vec<&str> = SCENE[start..end].lines().rev().collect();
    let text = format!(
        "{}{}\n{}",
        &SCENE[..start],
        reversed.join("\n"),
        &SCENE[end..]
    );
    let folder = tempfile::tempdir().unwrap();
    let setting = format!("env.model={}", write(&folder, &text).display());
    let run = |settings: &[&str]| {
        let task = task(settings);
        let (mut env, mut observation) = started(&task);
        let action: Vec<f32> = (0..20).map(|i| (i as f32 - 10.0) / 12.0).collect();
        let rewards: Vec<f32> = (0..20)
            .map(|_| env.step(&action, &mut observation).reward)
            .collect();
        (rewards, observation, env.sim.ctrl().to_vec())
    };
    let (builtin, own) = (run(&[]), run(&[&setting]));
    // Summing forces in another order rounds differently.
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3);
    assert!(close(&builtin.0, &own.0) && close(&builtin.1, &own.1));
    assert_eq!(builtin.2, own.2.into_iter().rev().collect::<Vec<_>>());
}

#[test]
fn parts_of_an_own_scene_may_have_other_names() {
    for (from, to) in [
        ("rh_LFJ5", "rh_other"),
        ("name=\"rh_A_MFJ0\"", "name=\"other\""),
        ("rh_thdistal", "rh_thumbtip"),
        ("<body name=\"cube\"", "<body name=\"die\""),
        ("<body name=\"target\"", "<body name=\"aim\""),
        ("rh_", "lh_"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let task = task(&[&format!(
            "env.model={}",
            write(&folder, &edited(from, to)).display()
        )]);
        let spaces = task.spaces();
        assert_eq!(
            (spaces.observation_size, spaces.action_size),
            (OBSERVATION_SIZE, 20),
            "{to}"
        );
    }
}

#[test]
fn all_names_that_are_missing_come_in_one_message() {
    let folder = tempfile::tempdir().unwrap();
    let model = format!("env.model={}", write(&folder, SCENE).display());
    let names = [
        "hand.joints=[\"a\",\"rh_WRJ1\",\"b\"]",
        "hand.fingertips=[\"c\"]",
        "hand.object=d",
        "hand.goal=e",
    ];
    let config = config(&[&[&model[..]], &names[..]].concat());
    let message = format!("{:#}", Task::new(&config).err().unwrap());
    for name in [
        "own_scene.xml: has no body `d`",
        "body `e`",
        "body or site `c`",
        "joint `a`",
        "joint `b`",
    ] {
        assert!(message.contains(name), "{name}: {message}");
    }
    assert!(!message.contains("rh_WRJ1"), "{message}");
}

#[test]
fn what_mujoco_says_of_a_scene_is_not_cut_off() {
    let file = format!("{}thumb.stl", "a_long_folder/".repeat(20));
    let mesh = format!("<asset>\n    <mesh name=\"m\" file=\"{file}\"/>");
    assert!(refusal(&edited("<asset>", &mesh)).contains(&file));
    let text = edited(
        "name=\"rh_A_THJ4\"",
        "name=\"rh_A_THJ4\" dampratio_of_the_thumb_joint_that_is_no_attribute=\"1\"",
    );
    assert!(refusal(&text).contains("line "), "{}", refusal(&text));
}

#[test]
fn wrong_joints_and_actuators_in_an_own_scene_are_refused() {
    refused_when_edited(&[
        (
            "<joint name=\"rh_THJ3\"",
            "<joint name=\"rh_THJ3\" type=\"slide\"",
            "`rh_THJ3` must be a hinge",
        ),
        (
            "<freejoint name=\"cube\"/>",
            "<joint name=\"c\" type=\"ball\"/>",
            "no body with a free joint",
        ),
        (
            "ctrlrange=\"0 3.1415\"",
            "",
            "must have one control with a ctrlrange",
        ),
        (
            "joint=\"rh_FFJ3\"/>",
            "joint=\"rh_FFJ3\" gear=\"2\"/>",
            "`rh_A_FFJ3` must have a gear of 1",
        ),
        (
            "joint=\"rh_FFJ3\"/>",
            "joint=\"rh_FFJ3\" gear=\"-1\"/>",
            "`rh_A_FFJ3` must have a gear of 1",
        ),
        (
            "joint=\"rh_FFJ3\"/>",
            "joint=\"rh_FFJ3\" timeconst=\".1\"/>",
            "`rh_A_FFJ3` must act at once",
        ),
        (
            "joint=\"rh_FFJ3\"/>",
            "joint=\"rh_FFJ3\" delay=\".02\" nsample=\"4\"/>",
            "`rh_A_FFJ3` must act at once",
        ),
        (
            "<position name=\"rh_A_THJ4\" class=\"hand\" joint=\"rh_THJ4\" forcerange=\"-2 2\"/>",
            "<motor name=\"rh_A_THJ4\" joint=\"rh_THJ4\" ctrlrange=\"-1 1\"/>",
            "`rh_A_THJ4` must be a position servo",
        ),
        (
            "  </actuator>",
            "<motor name=\"more\" joint=\"rh_WRJ1\"/></actuator>",
            "has 21 controls",
        ),
        ("integrator=\"implicitfast\"", "integrator=\"RK4\"", "RK4"),
        ("</mujoco>", "", "MuJoCo refuses this scene"),
    ]);
    let missing = format!(
        "{:#}",
        Task::new(&config(&["env.model=nowhere.xml"]))
            .err()
            .unwrap()
    );
    assert!(
        missing.contains("nowhere.xml") && missing.contains("no such file"),
        "{missing}"
    );
}

#[test]
fn the_program_decides_the_timestep() {
    let task = task(&["env.sim_dt=0.002"]);
    let (mut env, mut observation) = started(&task);
    let before = env.sim.qpos()[task.scene.free_body("cube").unwrap().qpos + 2];
    let _ = env.step(&[0.0; 20], &mut observation);
    let fallen = before - env.sim.qpos()[task.scene.free_body("cube").unwrap().qpos + 2];
    // In five steps of 2 ms the cube falls by g · dt² · (1 + 2 + 3 + 4 + 5).
    assert!(
        (fallen - 9.81 * 0.002 * 0.002 * 15.0).abs() < 1e-6,
        "fell by {fallen}"
    );
}

/// Except for the pairs that the scene excludes by name.
#[test]
fn everything_solid_can_touch_everything_else() {
    use mujoco_rs::prelude::MjModel;
    let model = MjModel::from_xml_string(SCENE).unwrap();
    let (kind, affinity) = (model.geom_contype(), model.geom_conaffinity());
    let solid: Vec<usize> = (0..kind.len())
        .filter(|&g| kind[g] != 0 || affinity[g] != 0)
        .collect();
    assert_eq!(solid.len(), 38 + 1, "geoms of the hand and the cube");
    for &a in &solid {
        assert!(
            solid.iter().all(|&b| kind[a] & affinity[b] != 0),
            "geom {a}"
        );
    }
}

#[test]
fn a_number_that_is_none_in_an_own_scene_is_named() {
    refused_when_edited(&[
        (
            "<body name=\"cube\" pos=\".33",
            "<body name=\"cube\" pos=\"nan",
            "body_pos of body `cube`",
        ),
        (
            "mass=\".028\" friction=\"1.2\"",
            "mass=\".028\" friction=\"nan\"",
            "geom_friction of geom `cube`",
        ),
        (
            "name=\"rh_FFJ3\" class",
            "name=\"rh_FFJ3\" damping=\"nan\" class",
            "dof_damping of joint `rh_FFJ3`",
        ),
        (
            "name=\"rh_FFJ3\" class",
            "name=\"rh_FFJ3\" springref=\"nan\" stiffness=\"1\" class",
            "qpos_spring",
        ),
        (
            "</worldbody>",
            "</worldbody><equality><weld body1=\"cube\" relpose=\"nan 0 0 1 0 0 0\"/></equality>",
            "eq_data",
        ),
        (
            "</worldbody>",
            "</worldbody><equality><weld body1=\"cube\" solref=\"nan 1\"/></equality>",
            "eq_solref",
        ),
        (
            "<option ",
            "<option o_margin=\"nan\" ",
            "o_margin of OPTION",
        ),
    ]);
}
