//! Every setting changes a training run, or is refused, or a note says that it has no effect.

use std::fs;
use std::path::Path;

use rayon::prelude::*;
use shadow_repose::config::BASE;

use crate::support::{metrics, names, program, stderr, task, train};

/// The changes that are tried, each with what must hold so that it matters.
const CHANGES: &[(&str, &[&str])] = &[
    ("env.num_envs=32", &[]),
    ("env.model=nothing.xml", &[]),
    ("env.num_hand_dofs=23", &[]),
    ("env.num_actuators=19", &[]),
    ("env.sim_dt=0.005", &[]),
    ("env.ctrl_dt=0.02", &[]),
    ("env.friction_scale=0.5", &[]),
    ("env.cube_mass_scale=2", &[]),
    ("env.hand_mass_scale=1.5", &[]),
    ("env.cube_size_scale=1.1", &[]),
    ("env.gains_scale=0.7", &[]),
    ("env.damping_scale=2", &[]),
    ("env.frictionloss_scale=2", &[]),
    ("env.cube_com=[0.01,0,0]", &[]),
    ("env.gravity=[0,1,0]", &[]),
    ("env.cone=elliptic", &[]),
    ("env.action_delay=2", &[]),
    ("env.prediction=2", &[]),
    ("env.noise.joint_pos=0.1", &[]),
    ("env.bias.joint_pos=0.1", &[]),
    ("env.max_episode_seconds=0.1", &[]),
    ("env.goal_position=[0.33,0,0.31]", &[]),
    ("env.act_moving_average=0.9", &[]),
    ("env.rot_reward_scale=2", &["training.task_reward=1"]),
    ("env.rot_eps=0.3", &[]),
    ("env.dist_reward_scale=-20", &["training.task_reward=1"]),
    (
        "env.action_penalty_scale=-0.01",
        &["training.task_reward=1"],
    ),
    (
        "env.reach_goal_bonus=5",
        &["env.success_tolerance=3", "training.task_reward=1"],
    ),
    ("env.success_tolerance=3", &[]),
    (
        "env.max_consecutive_successes=2",
        &["env.success_tolerance=3"],
    ),
    (
        "env.success_hold=consecutive",
        &[
            "training.tolerance=1.5",
            "training.hold=20",
            "env.num_envs=64",
            "env.max_episode_seconds=1",
            "ppo.horizon=64",
        ],
    ),
    ("env.fall_dist=0.03", &[]),
    (
        "env.fall_penalty=-10",
        &["env.fall_dist=0.03", "training.task_reward=1"],
    ),
    ("env.reset_position_noise=0.03", &[]),
    ("env.reset_dof_pos_noise=0.1", &[]),
    ("env.reset_dof_vel_noise=1", &[]),
    ("env.vel_obs_scale=0.5", &[]),
    ("hand.object=nothing", &[]),
    ("hand.goal=nothing", &[]),
    ("hand.start=nothing", &[]),
    ("training.task_reward=1", &[]),
    ("training.progress_reward=1", &[]),
    ("training.approach_reward=1", &[]),
    ("training.hold_reward=1", &["training.tolerance=3"]),
    ("training.drop_reward=-100", &["env.fall_dist=0.03"]),
    ("training.assist=0", &[]),
    ("training.tolerance=3", &[]),
    ("training.hold=1", &["training.tolerance=3"]),
    ("training.goal_lifetime=1", &[]),
    ("randomization.share=0", &[]),
    ("randomization.each=0.1", &[]),
    ("randomization.friction=[2,2]", &[]),
    ("randomization.cube_mass=[2,2]", &[]),
    ("randomization.hand_mass=[2,2]", &[]),
    ("randomization.cube_size=[1.1,1.1]", &[]),
    ("randomization.cube_com=0.01", &[]),
    ("randomization.gains=[2,2]", &[]),
    ("randomization.damping=[2,2]", &[]),
    ("randomization.frictionloss=[2,2]", &[]),
    ("randomization.gravity=1", &[]),
    ("randomization.delay=[3,3]", &[]),
    ("randomization.noise.joint_pos=0.1", &[]),
    ("randomization.bias.joint_pos=0.1", &[]),
    ("randomization.push=1", &[]),
    ("randomization.push_steps=1", &[]),
    ("randomization.push_steps=2", &["randomization.push=0"]),
    ("ppo.critic_first=1", &[]),
    ("ppo.horizon=4", &[]),
    ("ppo.epochs=1", &[]),
    ("ppo.minibatches=4", &[]),
    ("ppo.hidden=[8]", &[]),
    ("ppo.activation=relu", &[]),
    ("ppo.symmetry=none", &[]),
    ("ppo.backend=candle", &[]),
    ("ppo.precision=bf16-rounded", &[]),
    ("ppo.learning_rate=1e-3", &[]),
    (
        "ppo.learning_rate_range=[4e-4,6e-4]",
        &["ppo.desired_kl=1e-7"],
    ),
    ("ppo.learning_rate_range=[4e-4,6e-4]", &["ppo.desired_kl=0"]),
    ("ppo.desired_kl=1e-7", &[]),
    ("ppo.gamma=0.9", &[]),
    ("ppo.lambda=0.5", &[]),
    ("ppo.clip=0.001", &[]),
    ("ppo.value_clip=0.001", &[]),
    ("ppo.value_coef=1", &[]),
    (
        "ppo.bounds_coef=1",
        &["ppo.learning_rate=1", "ppo.desired_kl=0"],
    ),
    ("ppo.max_grad_norm=0.001", &[]),
    ("ppo.reward_scale=0.1", &[]),
    ("ppo.std=0.3", &[]),
    ("ppo.away_std=0.9", &[]),
    ("ppo.away_range=[0.1,3.2]", &["ppo.away_std=0.9"]),
    ("ppo.away_range=[0.1,3.2]", &["ppo.away_std=0"]),
    ("env.known.friction=2", &[]),
    ("run.total_steps=384", &[]),
    ("run.checkpoint_every=1", &[]),
    ("run.eval_every=2", &[]),
    ("run.eval_episodes=3", &[]),
    ("run.patience=1", &["run.total_steps=512"]),
    ("run.seed=1", &[]),
    ("run.shards=1", &[]),
];

/// What shows of a run with these settings, and what it says.
fn trained(folder: &Path, settings: &[&str]) -> (String, String) {
    let always = [
        "randomization.share=1",
        "run.threads=1",
        "run.total_steps=256",
    ];
    let settings = always
        .iter()
        .chain(settings)
        .flat_map(|setting| ["--set", setting]);
    let output = program(
        folder,
        &train(
            &["--run-dir", "run"]
                .into_iter()
                .chain(settings)
                .collect::<Vec<_>>(),
        ),
    );
    let said = stderr(&output);
    let run = folder.join("run");
    fs::create_dir_all(run.join("checkpoints")).unwrap();
    let rows = run.join("metrics.csv").exists().then(|| metrics(&run));
    (
        format!("{rows:?} {:?}", names(&run.join("checkpoints"))),
        said,
    )
}

/// The change, if it does nothing and nothing is said of it.
fn ignored(change: &str, more: &[&str]) -> Option<String> {
    let [before, after] = [0, 1].map(|_| tempfile::tempdir().unwrap());
    let (usual, usually_said) = trained(before.path(), more);
    let (found, said) = trained(after.path(), &[more, &[change]].concat());
    let key = change.split('=').next().unwrap();
    let is_about = |line: &str| line.contains(key) || line.contains("nothing");
    let is_told = said
        .lines()
        .any(|line| is_about(line) && !usually_said.contains(line));
    (found == usual && !is_told).then(|| format!("{change} {more:?}: {said}"))
}

#[test]
fn no_setting_is_ignored_without_a_word() {
    let hand = task(&[]).hand.parts.clone();
    let reversed = |key: &str, names: &[String]| {
        format!("hand.{key}={:?}", Vec::from_iter(names.iter().rev()))
    };
    let lists = [
        reversed("joints", &hand.joints),
        reversed("actuators", &hand.actuators),
        reversed("fingertips", &hand.fingertips),
    ];
    let lists: Vec<(&str, &[&str])> = lists.iter().map(|list| (&**list, &[][..])).collect();
    let changes = [CHANGES, &lists].concat();
    let base: toml::Table = BASE.parse().unwrap();
    let sections = base
        .iter()
        .map(|(section, keys)| (section, keys.as_table().unwrap()));
    let keys =
        sections.flat_map(|(section, keys)| keys.keys().map(move |key| format!("{section}.{key}")));
    let is_tried = |key: &String| changes.iter().any(|(change, _)| change.starts_with(&**key));
    // The height at which the goal is drawn shows in pictures alone, and threads only share the work.
    let untried: Vec<String> = keys.filter(|key| !is_tried(key)).collect();
    assert_eq!(untried, ["env.target_height", "run.threads"]);
    assert_ne!(
        task(&["env.target_height=0.3"]).goal_place(),
        task(&[]).goal_place()
    );
    let ignored: Vec<String> = changes
        .par_iter()
        .filter_map(|(change, more)| ignored(change, more))
        .collect();
    assert_eq!(ignored, [""; 0]);
}
