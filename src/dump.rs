//! The last steps of an episode whose physics diverged, as JSON: enough to replay them in any MuJoCo.

use serde_json::{Value, json};

use crate::config::EnvConfig;
use crate::repose::Diverged;

/// Returns one object: `state` is MuJoCo's `mj_getState` for `mjSTATE_INTEGRATION` before the first step, `ctrl` the controls
/// of each step in the model's order, and `actions` the policy's actions. In a training with randomised episodes, `randomization`
/// is what this one has drawn (null if nothing), on top of the settings, and `pushes` the force on the cube in each step.
pub fn of(diverged: &Diverged, config: &EnvConfig, iteration: u64, env: usize) -> String {
    let tail = &diverged.tail;
    let actions: Vec<Value> = tail.actions.iter().map(|action| json!(action.as_slice())).collect();
    let ctrl: Vec<Value> = tail.controls.iter().map(|controls| json!(controls.as_slice())).collect();
    let mut dump = json!({
        "model": config.model,
        "friction_scale": config.friction_scale,
        "cube_mass_scale": config.cube_mass_scale,
        "sim_dt": config.sim_dt,
        "ctrl_dt": config.ctrl_dt,
        "iteration": iteration,
        "environment": env,
        "episode_length": diverged.length,
        "state": tail.start.numbers(),
        "ctrl": ctrl,
        "actions": actions,
    });
    config.varied().for_each(|(key, value)| dump[key] = json!(value));
    dump["randomization"] = diverged.draw.as_ref().map_or(Value::Null, |draw| {
        json!({
            "friction": draw.friction,
            "cube_mass": draw.cube_mass,
            "hand_mass": draw.hand_mass,
            "cube_size": draw.cube_size,
            "cube_com": draw.cube_com,
            "gains": draw.gains,
            "damping": draw.damping,
            "frictionloss": draw.frictionloss,
            "gravity": draw.gravity,
            "delay": draw.delay,
        })
    });
    dump["pushes"] = json!(tail.pushes);
    format!("{dump}\n")
}
