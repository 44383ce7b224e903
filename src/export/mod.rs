//! Exports a policy as an ONNX file, which programs in other languages run. One graph holds perception, normaliser and actor. The
//! metadata holds what a program must know to use it.

mod graph;
mod onnx;

use anyhow::{Context, Result, bail};
use toml::{Table, Value};

use crate::cli::ExportArgs;
use crate::config::{EnvConfig, expect_used};
use crate::evaluate::expect_finite;
use crate::load::Loaded;
use crate::os::{self, say};
use crate::ppo::Checkpoint;
use crate::repose::{Hand, Task};
use crate::run;
use graph::policy_graph;

/// Writes a policy as an ONNX file. The same policy gives the same bytes.
///
/// # Errors
/// Fails if the policy, a setting or the scene cannot be used, or if the file cannot be written.
pub fn export(args: &ExportArgs) -> Result<()> {
    expect_used(&args.set, "export")?;
    let loaded = Loaded::find(args.ckpt.as_deref(), &args.set)?;
    let task = loaded
        .task(&args.set)
        .context("the file needs the actuator ranges of the scene")?;
    task.say_warnings();
    task.notes().iter().for_each(|note| say!("note: {note}"));
    expect_finite(&task, &loaded.policy, false)
        .with_context(|| format!("cannot export {}", loaded.origin))?;
    run::expect_output(&args.out, loaded.origin.file(), task.config.model_file())?;
    let parts = &task.hand.parts;
    let mut names = [&parts.joints, &parts.actuators, &parts.fingertips]
        .into_iter()
        .flatten();
    if let Some(name) = names.find(|name| name.contains(',')) {
        bail!(
            "`{name}`: an exported file separates names by commas, so a name must not contain one"
        );
    }
    let output = os::OutputFile::create(&args.out)?;
    let bytes =
        policy_graph(&loaded.policy, task.mirror().as_deref()).file(metadata(&loaded, &task));
    output.finish(&bytes)?;
    say!(
        "{}: {}, {} bytes",
        args.out.display(),
        loaded.name,
        bytes.len()
    );
    Ok(())
}

/// What a program must know to run the policy: lists are comma-separated, numbers can be read back exactly.
///
/// The names follow mjlab's runners where they define one. `joint_names` are what an action drives, here the actuators. Their
/// target is `action_offset + action_scale * action`, smoothed with `ema_alpha`.
fn metadata(loaded: &Loaded, task: &Task) -> Vec<(&'static str, String)> {
    let config = &task.config;
    let hand = &task.hand;
    let parts = &hand.parts;
    let groups = || hand.layout.groups();
    let ranges = || hand.actuators.iter().map(|actuator| actuator.range);
    let offsets = list(ranges().map(|[low, high]| (low + high) / 2.0));
    let mut facts = vec![
        ("action_offset", offsets.clone()),
        (
            "action_scale",
            list(ranges().map(|[low, high]| (high - low) / 2.0)),
        ),
        ("actions_clipped", "true".into()),
        ("commit", env!("SHADOW_REPOSE_COMMIT").into()),
        ("config", settings(loaded, config)),
        ("ctrl_dt", config.ctrl_dt.to_string()),
        ("default_joint_pos", offsets),
        ("ema_alpha", config.act_moving_average.at(0).to_string()),
        ("fingertip_names", list(&parts.fingertips)),
        ("goal_name", parts.goal.clone()),
        ("hand", described(hand)),
        ("hinge_names", list(&parts.joints)),
        ("joint_names", list(&parts.actuators)),
        ("object_name", parts.object.clone()),
        ("observation_names", list(groups().map(|group| group.name))),
        (
            "observation_sizes",
            list(groups().map(|group| group.length)),
        ),
        ("prediction", config.prediction.to_string()),
        (
            "program",
            concat!("shadow-repose ", env!("CARGO_PKG_VERSION")).into(),
        ),
        (
            "quaternion_order",
            "wxyz, w >= 0 but for the fingertips".into(),
        ),
        (
            "start_keyframe",
            hand.keyframe
                .map_or(String::new(), |keyframe| keyframe.to_string()),
        ),
        ("vel_obs_scale", config.vel_obs_scale.to_string()),
    ];
    add_training(&mut facts, &loaded.checkpoint);
    facts
}

/// Adds what is known of the training run that made the policy.
fn add_training(facts: &mut Vec<(&'static str, String)>, checkpoint: &Checkpoint) {
    let progress = &checkpoint.progress;
    facts.extend((progress.env_steps > 0).then(|| ("env_steps", progress.env_steps.to_string())));
    facts.extend(
        progress
            .best
            .map(|[goals, _]| ("goals_per_episode", goals.to_string())),
    );
    facts.extend(
        checkpoint
            .provenance
            .clone()
            .map(|text| ("provenance", text)),
    );
}

fn described(hand: &Hand) -> String {
    let kind = match hand.side() {
        Some("rh_") => "right Shadow Hand",
        Some("lh_") => "left Shadow Hand",
        _ => "own hand",
    };
    format!(
        "{kind}, {} joints, {} actuators",
        hand.joints.len(),
        hand.actuators.len()
    )
}

/// All settings of the training run as TOML, with the task as it is exported.
fn settings(loaded: &Loaded, config: &EnvConfig) -> String {
    let mut table: Table = loaded
        .checkpoint
        .config
        .parse()
        .expect("it was read when the policy was loaded");
    table.insert(
        "env".into(),
        Value::try_from(config).expect("settings are a table"),
    );
    table.to_string()
}

fn list<T: ToString>(values: impl IntoIterator<Item = T>) -> String {
    values
        .into_iter()
        .map(|value| value.to_string())
        .collect::<Vec<_>>()
        .join(",")
}
