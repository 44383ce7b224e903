//! The last steps of an episode whose physics diverged, as JSON: enough to replay them in any MuJoCo.

use serde_json::{Value, json};

use crate::config::EnvConfig;
use crate::env::Diverged;

/// Returns one object: `state` is MuJoCo's `mj_getState` for `mjSTATE_INTEGRATION` before the first step, `ctrl` the controls
/// of each step in the model's order, and `actions` the policy's actions.
pub fn of(diverged: &Diverged, config: &EnvConfig, iteration: u64, env: usize) -> String {
    let tail = &diverged.tail;
    let actions: Vec<Value> = tail.actions.iter().map(|action| json!(action.as_slice())).collect();
    let ctrl: Vec<Value> = tail.controls.iter().map(|controls| json!(controls.as_slice())).collect();
    let dump = json!({
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
    format!("{dump}\n")
}
