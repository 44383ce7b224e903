//! Policies for other programs.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{SCENE, program, stderr, succeeded, train};

/// Returns the Python that .ci/run has prepared with mujoco, onnx and onnxruntime.
pub(crate) fn python() -> Option<OsString> {
    let python = std::env::var_os("SHADOW_REPOSE_PYTHON");
    if python.is_none() {
        eprintln!(
            "not tested: SHADOW_REPOSE_PYTHON does not name a Python with mujoco, onnx and onnxruntime"
        );
    }
    python
}

/// Runs deploy.py in a folder with these arguments, if there is a Python for it.
pub(crate) fn check_in_python(folder: &Path, args: &[&str]) {
    let deploy = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/deploy/deploy.py");
    if let Some(python) = python() {
        runs(&python, folder, &[&[deploy], args].concat());
    }
}

fn runs(python: &OsString, folder: &Path, args: &[&str]) {
    let output = Command::new(python)
        .args(args)
        .current_dir(folder)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned() + &stderr(&output);
    assert!(output.status.success(), "{args:?}: {said}");
}

#[test]
fn an_exported_policy_sees_and_does_in_python_what_it_does_here() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let other = [
        "--total-steps",
        "256",
        "--run-dir",
        "run",
        "--set",
        "ppo.symmetry=none",
        "--set",
        "ppo.activation=tanh",
    ];
    succeeded(program(folder, &train(&other)));
    let deploy = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("examples/deploy/deploy.py");
    for policy in ["builtin", "run"] {
        succeeded(program(folder, &["export", "--ckpt", policy]));
        succeeded(program(
            folder,
            &[
                "play",
                "--ckpt",
                policy,
                "--json",
                "--episodes",
                "2",
                "--out",
                "trace.jsonl",
            ],
        ));
        let check =
            "import onnx, sys; onnx.checker.check_model(onnx.load(sys.argv[1]), full_check=True)";
        runs(&python, folder, &["-c", check, "policy.onnx"]);
        runs(
            &python,
            folder,
            &[
                deploy.to_str().unwrap(),
                "policy.onnx",
                "--check",
                "trace.jsonl",
            ],
        );
    }
    runs(
        &python,
        folder,
        &[
            deploy.to_str().unwrap(),
            "policy.onnx",
            "--episodes",
            "2",
            "--json",
        ],
    );
}

/// Steps the hand of deploy.py from each state of a trace, and prints how far it then is from the next state. This is the median,
/// since the solver starts from the last step's forces, which a trace does not have.
const REPLAY: &str = "
import json, sys
sys.path.insert(0, sys.argv[1])
import deploy, mujoco, numpy
hand = deploy.Hand(deploy.Policy('policy.onnx'), deploy.SCENE)
records, off = [json.loads(line) for line in open('trace.jsonl')][1:], []
for before, after in zip(records, records[1:]):
    if not after.get('reset'):
        hand.place(before['qpos'], before['qvel'])
        hand.data.ctrl[hand.controls] = [after['ctrl'][i] for i in hand.controls]
        for _ in range(hand.substeps):
            mujoco.mj_step2(hand.model, hand.data)
            mujoco.mj_step1(hand.model, hand.data)
        off.append(abs(hand.data.qpos - after['qpos']).max())
sys.exit(None if numpy.median(off) < 1e-12 else f'{numpy.median(off)} off')
";

#[test]
fn a_varied_hand_moves_in_python_as_it_does_here() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/deploy");
    let varied = [
        "env.friction_scale=0.8",
        "env.cube_mass_scale=1.5",
        "env.hand_mass_scale=1.3",
        "env.cube_size_scale=1.05",
        "env.gains_scale=1.2",
        "env.damping_scale=0.7",
        "env.frictionloss_scale=2",
        "env.cube_com=[0.003,-0.002,0.001]",
        "env.gravity=[0.3,0,0.5]",
        "env.action_delay=1",
    ];
    let sets: Vec<&str> = varied.iter().flat_map(|set| ["--set", set]).collect();
    succeeded(program(
        folder.path(),
        &[&["export", "--ckpt", "builtin"], &sets[..]].concat(),
    ));
    let play = [
        "play",
        "--ckpt",
        "builtin",
        "--json",
        "--episodes",
        "1",
        "--out",
        "trace.jsonl",
    ];
    succeeded(program(folder.path(), &[&play[..], &sets].concat()));
    runs(&python, folder.path(), &["-c", REPLAY, examples]);
    let check = ["policy.onnx", "--check", "trace.jsonl"];
    runs(
        &python,
        folder.path(),
        &[&[&format!("{examples}/deploy.py")[..]], &check[..]].concat(),
    );
    // Without one of the settings it is another hand, so the comparison would notice.
    succeeded(program(
        folder.path(),
        &[&["export", "--ckpt", "builtin"], &sets[..sets.len() - 4]].concat(),
    ));
    let output = Command::new(&python)
        .args(["-c", REPLAY, examples])
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(
        !output.status.success() && stderr(&output).contains(" off"),
        "{}",
        stderr(&output)
    );
    // What it cannot simulate or compare is refused in words.
    let noisy = ["--set", "env.noise.joint_pos=0.01"];
    succeeded(program(folder.path(), &[&play[..], &noisy].concat()));
    let output = Command::new(&python)
        .args([&[&format!("{examples}/deploy.py")[..]], &check[..]].concat())
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(
        !output.status.success() && stderr(&output).contains("noise or bias"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn what_python_predicts_of_a_late_hand_in_its_own_or_another_world_is_what_the_policy_saw_here() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let deploy = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/deploy/deploy.py");
    succeeded(program(folder.path(), &["export", "--ckpt", "builtin"]));
    let play = [
        "play",
        "--ckpt",
        "builtin",
        "--json",
        "--episodes",
        "1",
        "--out",
        "trace.jsonl",
    ];
    let late = ["--set", "env.action_delay=2", "--set", "env.prediction=2"];
    for world in [
        &[][..],
        &[
            "--set",
            "env.friction_scale=0.7",
            "--set",
            "env.sim_dt=0.005",
        ],
    ] {
        succeeded(program(folder.path(), &[&play[..], &late, world].concat()));
        runs(
            &python,
            folder.path(),
            &[deploy, "policy.onnx", "--check", "trace.jsonl"],
        );
    }
    // A model with another physics predicts something else.
    succeeded(program(
        folder.path(),
        &[
            "export",
            "--ckpt",
            "builtin",
            "--set",
            "env.friction_scale=0.7",
        ],
    ));
    let check = [deploy, "policy.onnx", "--check", "trace.jsonl"];
    let output = Command::new(&python)
        .args(check)
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(
        !output.status.success() && stderr(&output).contains("predicted with env.friction_scale"),
        "{}",
        stderr(&output)
    );
    let episode = ["--episodes", "1"];
    succeeded(program(
        folder.path(),
        &[&["export", "--ckpt", "builtin"], &late[..]].concat(),
    ));
    runs(
        &python,
        folder.path(),
        &[&[deploy, "policy.onnx"], &episode[..]].concat(),
    );
}

#[test]
fn an_own_object_is_resized_in_python_as_it_is_here() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/deploy");
    let cube = "<geom name=\"cube\" type=\"box\" size=\".025 .025 .025\" mass=\".028\"";
    assert!(SCENE.contains(cube));
    let replay = REPLAY.replace("deploy.SCENE", "'own.xml'");
    for object in [
        "<geom type=\"capsule\" size=\".02\" fromto=\"-.01 0 0 .02 .01 0\" mass=\".028\"",
        "<geom type=\"box\" size=\".02 .025 .03\" shellinertia=\"true\" density=\"5\"",
        "<inertial pos=\".003 0 .001\" mass=\".03\" diaginertia=\"2e-5 1e-5 2e-5\"/><geom type=\"box\" size=\".02 .025 .03\"",
        "<inertial pos=\"0 0 0\" mass=\".03\" fullinertia=\"2e-5 1e-5 2e-5 1e-6 0 0\"/><geom type=\"sphere\" size=\".03\"",
    ] {
        std::fs::write(folder.path().join("own.xml"), SCENE.replace(cube, object)).unwrap();
        let sets = [
            "--set",
            "env.model=own.xml",
            "--set",
            "env.cube_size_scale=1.2",
        ];
        succeeded(program(
            folder.path(),
            &[&["export", "--ckpt", "builtin"], &sets[..]].concat(),
        ));
        let play = [
            "play",
            "--ckpt",
            "builtin",
            "--json",
            "--episodes",
            "1",
            "--out",
            "trace.jsonl",
        ];
        succeeded(program(folder.path(), &[&play[..], &sets].concat()));
        runs(&python, folder.path(), &["-c", &replay, examples]);
    }
}

/// Writes copies of a policy and a trace with a NaN in them, in the way that the first argument names.
const SPOIL: &str = "
import json, sys
import numpy, onnx
model = onnx.load('policy.onnx')
for initializer in model.graph.initializer:
    if initializer.name == 'actor.3.bias':
        initializer.CopyFrom(onnx.numpy_helper.from_array(numpy.full(20, numpy.nan, 'f4'), initializer.name))
onnx.save(model, 'nan.onnx')
header, *records = open('trace.jsonl').read().splitlines()
for key in ('obs', 'action'):
    record = json.loads(records[1])
    record[key][3] = float('nan')
    open(key, 'w').write('\\n'.join([header, records[0], json.dumps(record), *records[2:]]))
open('cut', 'w').write('\\n'.join([header, *records])[:-50])
open('empty', 'w').close()
open('bare', 'w').write(header)
open('one', 'w').write(header + '\\n' + records[0])
open('other', 'w').write('\\n'.join([header.replace('\"vel_obs_scale\":0.2', '\"vel_obs_scale\":0.5'), *records]))
";

#[test]
fn the_check_in_python_fails_on_what_is_not_a_number_and_on_the_trace_of_another_task() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let play = [
        "play",
        "--ckpt",
        "builtin",
        "--json",
        "--episodes",
        "1",
        "--set",
        "env.max_episode_seconds=0.5",
    ];
    succeeded(program(
        folder,
        &[&play[..], &["--out", "trace.jsonl"]].concat(),
    ));
    succeeded(program(
        folder,
        &[
            "export",
            "--ckpt",
            "builtin",
            "--set",
            "env.max_episode_seconds=0.5",
        ],
    ));
    runs(&python, folder, &["-c", SPOIL]);
    let deploy = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/deploy/deploy.py");
    runs(
        &python,
        folder,
        &[deploy, "policy.onnx", "--check", "trace.jsonl"],
    );
    let refused = [
        (
            ["nan.onnx", "--check", "trace.jsonl"],
            "actions are not finite",
        ),
        (["nan.onnx", "--episodes", "1"], "actions are not finite"),
        (
            ["policy.onnx", "--check", "obs"],
            "obs has a value that is not finite",
        ),
        (
            ["policy.onnx", "--check", "action"],
            "action has a value that is not finite",
        ),
        (
            ["policy.onnx", "--check", "other"],
            "env.vel_obs_scale = 0.5",
        ),
        (["policy.onnx", "--check", "cut"], "not a complete trace"),
        (["policy.onnx", "--check", "empty"], "not a complete trace"),
        (["policy.onnx", "--check", "bare"], "nothing to compare"),
        (["policy.onnx", "--check", "one"], "nothing to compare"),
        (["policy.onnx", "--episodes", "0"], "at least 1"),
        (["trace.jsonl", "--episodes", "1"], "not an ONNX file"),
    ];
    for (args, reason) in refused {
        let output = Command::new(&python)
            .arg(deploy)
            .args(args)
            .current_dir(folder)
            .output()
            .unwrap();
        let said = stderr(&output);
        assert!(
            !output.status.success() && said.contains(reason) && !said.contains("Traceback"),
            "{args:?}: {said}"
        );
    }
}

/// Writes copies of a policy with odd metadata, and traces with odd records: each by its name.
const GARBLE: &str = "
import json, onnx
def garbled(name, key, value):
    model = onnx.load('policy.onnx')
    facts = {fact.key: fact.value for fact in model.metadata_props} | {key: value}
    onnx.helper.set_model_props(model, {key: value for key, value in facts.items() if value is not None})
    onnx.save(model, name)
config = next(fact.value for fact in onnx.load('policy.onnx').metadata_props if fact.key == 'config')
garbled('nan.onnx', 'ema_alpha', 'nan')
garbled('inf.onnx', 'action_scale', 'inf,' * 19 + 'inf')
garbled('far.onnx', 'config', config.replace('fall_dist = ', 'fall_dist = nan # '))
garbled('bare.onnx', 'config', None)
garbled('toml.onnx', 'config', '[env')
garbled('empty.onnx', 'config', '')
garbled('words.onnx', 'action_offset', 'much')
garbled('key.onnx', 'start_keyframe', '99')
garbled('short.onnx', 'config', '[env]\\nctrl_dt = 0.01\\nsim_dt = 0.01')
header, *records = open('trace.jsonl').read().splitlines()
open('headless', 'w').write('\\n'.join(records))
for name, key, value in [('lacking', 'qpos', ...), ('words', 'qpos', 'much'), ('null', 'obs', None), ('short', 'action', [1])]:
    record = json.loads(records[1]) | {key: value}
    record = {key: value for key, value in record.items() if value is not ...}
    open(name, 'w').write('\\n'.join([header, records[0], json.dumps(record), *records[2:]]))
open('list', 'w').write('\\n'.join([header, '[]', *records]))
";

#[test]
fn the_example_in_python_refuses_garbled_policies_and_traces_in_a_sentence() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let short = ["--ckpt", "builtin", "--set", "env.max_episode_seconds=0.1"];
    let play = ["play", "--json", "--episodes", "1", "--out", "trace.jsonl"];
    succeeded(program(folder, &[&play[..], &short].concat()));
    succeeded(program(folder, &[&["export"], &short[..]].concat()));
    runs(&python, folder, &["-c", GARBLE]);
    let deploy = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/deploy/deploy.py");
    let said = |args: &[&str]| {
        let output = Command::new(&python)
            .arg(deploy)
            .args(args)
            .current_dir(folder)
            .output()
            .unwrap();
        (
            output.status.success(),
            String::from_utf8(output.stdout.clone()).unwrap(),
            stderr(&output),
        )
    };
    for policy in [
        "nan", "inf", "far", "bare", "toml", "empty", "words", "key", "short",
    ] {
        let file = format!("{policy}.onnx");
        for args in [&["--check", "trace.jsonl"][..], &["--episodes", "1"]] {
            let (success, _, error) = said(&[&[&file[..]], args].concat());
            let told =
                error.starts_with(&format!("error: {file}")) && error.trim().lines().count() == 1;
            assert!(!success && told, "{policy} {args:?}: {error}");
        }
    }
    for trace in ["headless", "lacking", "words", "null", "short", "list"] {
        let (success, _, error) = said(&["policy.onnx", "--check", trace]);
        let told =
            error.starts_with(&format!("error: {trace} ")) && error.trim().lines().count() == 1;
        assert!(!success && told, "{trace}: {error}");
    }
    for args in [["--seed", "-1"], ["--scene", "nowhere.xml"]] {
        let (success, _, error) = said(&[&["policy.onnx"], &args[..]].concat());
        assert!(
            !success && error.contains("error: ") && !error.contains("Traceback"),
            "{args:?}: {error}"
        );
    }
    // One episode has no interval.
    let (success, json, error) = said(&["policy.onnx", "--episodes", "1", "--json"]);
    let score: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert!(
        success && score["goals_ci95"] == serde_json::json!([null, null]),
        "{json}{error}"
    );
    assert!(!said(&["policy.onnx", "--episodes", "1"]).1.contains("nan"));
}

#[test]
fn a_policy_is_exported_as_the_same_bytes_each_time_with_what_a_program_must_know() {
    let folder = tempfile::tempdir().unwrap();
    let export = |out: &str, more: &[&str]| {
        succeeded(program(
            folder.path(),
            &[&["export", "--ckpt", "builtin", "--out", out], more].concat(),
        ));
        fs::read(folder.path().join(out)).unwrap()
    };
    let first = export("first.onnx", &[]);
    assert_eq!(first, export("second.onnx", &[]));
    let holds = |bytes: &[u8], text: &str| {
        bytes
            .windows(text.len())
            .any(|window| window == text.as_bytes())
    };
    for text in [
        "rh_A_THJ5,rh_A_THJ4,",
        "joint_pos,joint_vel,cube_pos",
        "24,24,3,4,3,3,3,4,4,65,20",
        "max_episode_seconds = 10.0",
    ] {
        assert!(holds(&first, text), "{text}");
    }
    let other = export("third.onnx", &["--set", "env.max_episode_seconds=3"]);
    assert!(
        holds(&other, "max_episode_seconds = 3.0") && !holds(&other, "max_episode_seconds = 10.0")
    );
}

#[test]
fn what_cannot_be_exported_is_named_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("noise"), "no policy").unwrap();
    for (args, named) in [
        (&["--ckpt", "noise"][..], "cannot use noise"),
        (&["--ckpt", "nowhere"], "nowhere"),
        (
            &["--ckpt", "builtin", "--set", "ppo.gamma=0.5"],
            "`export` does not use ppo.gamma",
        ),
        (
            &["--ckpt", "builtin", "--set", "env.model=none.xml"],
            "none.xml",
        ),
        (&["--ckpt", "builtin", "--out", "none/policy.onnx"], "mkdir"),
    ] {
        let output = program(folder.path(), &[&["export"], args].concat());
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        let said = stderr(&output);
        assert!(
            said.contains(named)
                && said
                    .lines()
                    .filter(|line| line.starts_with("error"))
                    .count()
                    == 1,
            "{said}"
        );
    }
    assert_eq!(crate::support::names(folder.path()), ["noise"]);
}
