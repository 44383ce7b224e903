//! Settings of version 0.1.0 and of the beginnings of 0.2.0 that were removed, and what to use instead.

use toml::Value;

/// Lists of keys, separated by spaces, with the advice for each list.
const KEYS: [(&str, &str); 6] = [
    (
        "training.task_reward_start training.task_reward_steps training.drop_reward_start training.drop_reward_steps \
         training.tolerance_start training.tolerance_steps training.hold_start training.hold_steps",
        "write it as a ramp, e.g. training.drop_reward = { from = -50, to = -1500, steps = 150e6 }",
    ),
    ("ppo.max_std ppo.min_std", "the std is not learnt any more; ppo.std is what ppo.max_std was"),
    ("ppo.init_std ppo.max_std_steps", "the std follows a ramp, e.g. ppo.std = { from = 0.6, to = 0.2, steps = 25e6 }"),
    (
        "training.tolerance_scale training.hold_scale",
        "training.tolerance is in rad and training.hold in steps, independent of the task's values",
    ),
    ("training.bootstrap_reached", "training now always behaves as it did with true"),
    (
        "training.goal_angle_start training.goal_angle_steps training.goal_reward training.episode_seconds \
         ppo.critic_learning_rate ppo.entropy_coef ppo.exploring_share ppo.exploring_scale",
        "it did not help",
    ),
];

/// Returns the message about a key or a value if it was removed.
pub(super) fn answer(name: &str, value: &Value) -> Option<String> {
    if name == "ppo.activation" && value.as_str() == Some("silu") {
        return Some(format!("{name} = {value}: gone since 0.2.0: no policy that came with the program used it"));
    }
    let (_, advice) = KEYS.iter().find(|(keys, _)| keys.split_whitespace().any(|key| key == name))?;
    Some(format!("{name}: gone since 0.2.0: {advice}"))
}
