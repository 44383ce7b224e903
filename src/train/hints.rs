//! Notes about settings that are valid but rarely intended, printed before a training run starts.

use crate::config::Config;

/// The number of samples below which a minibatch gives a noisy gradient and a step that is short for its cost.
const SMALL_MINIBATCH: usize = 1024;

/// The smallest weight of the task's reward at which its scales matter.
const LITTLE: f64 = 0.1;

/// The memory for the models of randomised environments above which there is a note, bytes.
const MUCH: usize = 2 << 30;

/// The notes about these settings, compared with the `default`, for a scene of this size in bytes.
pub(super) fn hints(config: &Config, default: &Config, scene: usize) -> Vec<String> {
    let mut hints = Vec::from_iter(of_ramps(config));
    let total = config.run.total_steps;
    let samples = config.samples_per_minibatch();
    if samples < SMALL_MINIBATCH {
        hints.push(format!("minibatches of {samples} samples: gradients are noisy below {SMALL_MINIBATCH}"));
    }
    let env = &config.env;
    let usual = &default.env;
    let weight = config.training.task_reward.to;
    for (key, value, usual) in [
        ("env.rot_reward_scale", env.rot_reward_scale, usual.rot_reward_scale),
        ("env.dist_reward_scale", env.dist_reward_scale, usual.dist_reward_scale),
        ("env.action_penalty_scale", env.action_penalty_scale, usual.action_penalty_scale),
        ("env.reach_goal_bonus", env.reach_goal_bonus, usual.reach_goal_bonus),
        ("env.fall_penalty", env.fall_penalty, usual.fall_penalty),
    ] {
        if value != usual && weight < LITTLE {
            hints.push(format!("{key} = {value}: training.task_reward multiplies it by only {weight}"));
        }
    }
    let models = scene.saturating_mul(env.num_envs);
    let share = config.randomization.share;
    let randomizes = [0, total].into_iter().any(|steps| share.at(steps) > 0.0);
    let mut usual = default.randomization.clone();
    if config.env.model_file().is_some() {
        // By default, the size of an own object does not vary.
        usual.cube_size = [1.0; 2];
    }
    if config.randomization.happens() && !randomizes && config.randomization != usual {
        hints.push(format!("randomization.share = {share}: nothing is randomised in {total} steps"));
    }
    if randomizes && models > MUCH {
        let gib = models as f64 / f64::from(1 << 30);
        hints.push(format!(
            "[randomization]: each of {} environments gets its own model of this scene, from {} steps on: {gib:.1} GiB in total \
             (randomization.share=0 avoids this)",
            env.num_envs,
            if share.at(0) > 0.0 { 0 } else { share.after }
        ));
    }
    hints
}

/// Ramps that may still grow at the end of a run: the penalty for drops and the share of randomised episodes.
const MAY_GROW: [&str; 2] = ["training.drop_reward", "randomization.share"];

/// A note about the ramps that are longer than the training run, if there are any.
fn of_ramps(config: &Config) -> Option<String> {
    let total = config.run.total_steps;
    let mut cut = config.ramps();
    cut.retain(|(key, ramp)| ramp.from != ramp.to && ramp.end() > total && !MAY_GROW.contains(&&**key));
    let longest = cut.iter().map(|(_, ramp)| ramp.end()).max()?;
    let names: Vec<String> = cut.into_iter().map(|(key, _)| key).collect();
    Some(format!(
        "run.total_steps = {total} is shorter than the ramps of {}, which last up to {longest} steps",
        names.join(", ")
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Override, SHIPPED, Settings, Source};

    fn hints_for(sets: &[&str]) -> Vec<String> {
        let sets: Vec<Override> = sets.iter().map(|set| set.parse().unwrap()).collect();
        let default = Config::default();
        hints(&Settings::new().sets(&sets).resolve().unwrap(), &default, 1 << 20)
    }

    #[test]
    fn what_is_rarely_meant_gets_a_line_each() {
        let [line] = &hints_for(&["run.total_steps=18000000"])[..] else { panic!("one line") };
        let ramps = "env.act_moving_average, training.tolerance, training.hold, ppo.horizon";
        assert!(line.contains(&format!("{ramps}, which last up to 80000000 steps")), "{line}");
        assert!(!line.contains("assist"), "its ramp ends in time: {line}");
        assert!(hints_for(&["run.total_steps=9000000"])[0].contains("training.assist"));
        let [line] = &hints_for(&["ppo.minibatches=32"])[..] else { panic!("one line") };
        assert!(line.starts_with("minibatches of 512 samples"), "{line}");
        let [line] = &hints_for(&["env.dist_reward_scale=-20"])[..] else { panic!("one line") };
        assert!(
            line.starts_with("env.dist_reward_scale = -20: training.task_reward multiplies it by only 0.03"),
            "{line}"
        );
        assert!(hints_for(&["env.dist_reward_scale=-20", "training.task_reward=1"]).is_empty());
        let [line] = &hints_for(&["env.num_envs=8192"])[..] else { panic!("one line") };
        assert!(
            line.contains("8192 environments gets its own model of this scene, from 40000000 steps on: 8.0 GiB"),
            "{line}"
        );
        assert!(hints_for(&["env.num_envs=8192", "randomization.share=0"]).is_empty());
        let [line] = &hints_for(&["env.num_envs=8192", "randomization.share.from=0.2"])[..] else { panic!("one line") };
        assert!(line.contains("from 0 steps on"), "{line}");
        let short = hints_for(&["env.num_envs=8192", "run.total_steps=30_000_000"]);
        assert!(!short.concat().contains("own model"), "it ends before");
        let [line] = &hints_for(&["randomization.share={after=200_000_000}"])[..] else { panic!("one line") };
        assert!(line.ends_with("nothing is randomised in 200000000 steps"), "{line}");
        let ranges = hints_for(&["randomization.friction=[0.3,2]", "run.total_steps=30_000_000"]);
        assert!(ranges.concat().contains("nothing is randomised in 30000000 steps"), "{ranges:?}");
        assert!(
            hints_for(&["env.fall_penalty=-100"]).concat().contains("env.fall_penalty = -100: training.task_reward")
        );
    }

    #[test]
    fn no_settings_that_come_with_the_program_cause_a_line() {
        let default = Config::default();
        for (_, text) in SHIPPED {
            let source = Source::new("x.toml", text);
            let config = Settings::new().file(source).resolve().unwrap();
            assert_eq!(hints(&config, &default, 1 << 19), [""; 0]);
        }
    }
}
