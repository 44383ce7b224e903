//! Notes about settings that are valid but rarely intended, printed before a training run starts.

use crate::cli::TrainArgs;
use crate::config::{Config, short};

/// The number of samples below which a minibatch gives a noisy gradient and a step that is short for its cost.
const SMALL_MINIBATCH: usize = 1024;

/// The smallest weight of the task's reward at which its scales matter.
const LITTLE: f64 = 0.1;

/// Settings that another one leaves without effect: the beginnings of their keys, the other one, and its largest value that does so.
const WITHOUT_EFFECT: [(&str, &str, f64); 6] = [
    (
        "env.rot_reward_scale env.dist_reward_scale env.action_penalty_scale env.reach_goal_bonus env.fall_penalty",
        "training.task_reward",
        LITTLE,
    ),
    ("env.rot_eps", "env.rot_reward_scale", 0.0),
    ("randomization.push_steps", "randomization.push", 0.0),
    ("randomization.", "randomization.share", 0.0),
    ("ppo.learning_rate_range", "ppo.desired_kl", 0.0),
    ("ppo.away_range", "ppo.away_std", 0.0),
];

/// The notes about these settings, compared with the `default`.
pub fn hints(config: &Config, args: &TrainArgs, default: &Config) -> Vec<String> {
    let mut hints = Vec::from_iter(of_ramps(config));
    let samples = config.samples_per_minibatch();
    if samples < SMALL_MINIBATCH {
        hints.push(format!(
            "minibatches of {samples} samples: gradients are noisy below {SMALL_MINIBATCH}"
        ));
    }
    let begins = args.init.is_none() && args.fork.is_none() && args.resume.is_none();
    if config.ppo.critic_first > 0 && begins {
        hints.push(format!(
            "ppo.critic_first = {}: it is for a policy that can do something already (--init); random weights learn nothing in \
             these iterations",
            config.ppo.critic_first
        ));
    }
    hints.extend(without_effect(config, default));
    hints
}

/// The larger of the values of a setting at the beginning and at the end of the run.
fn reached(config: &Config, key: &str) -> f64 {
    match config.ramps().into_iter().find(|(ramped, _)| ramped == key) {
        Some((_, ramp)) => ramp.at(0).max(ramp.at(config.run.total_steps)),
        None => config.flat()[key].as_float().expect("a number"),
    }
}

/// A note about each setting that differs from the `default`, but does nothing.
fn without_effect(config: &Config, default: &Config) -> Vec<String> {
    let mut usual = default.clone();
    if config.env.model_file().is_some() {
        // By default, the size of an own object does not vary.
        usual.randomization.cube_size = [1.0; 2];
    }
    let mut notes = Vec::new();
    for (key, [_, value]) in usual.compared_with(config) {
        let is_about = |keys: &str| keys.split(' ').any(|begin| key.starts_with(begin));
        let cause = WITHOUT_EFFECT.iter().find(|(keys, other, most)| {
            is_about(keys) && *other != key && reached(config, other) <= *most
        });
        if let Some((_, other, _)) = cause {
            let [value, cause] = [&value, &config.flat()[*other]].map(short);
            notes.push(format!(
                "{key} = {value} has little or no effect with {other} = {cause}"
            ));
        }
    }
    notes
}

/// Ramps that may still grow at the end of a run: the penalty for drops and the share of randomised episodes.
const MAY_GROW: [&str; 2] = ["training.drop_reward", "randomization.share"];

/// A note about the ramps that are longer than the training run, if there are any.
fn of_ramps(config: &Config) -> Option<String> {
    let total = config.run.total_steps;
    let mut cut = config.ramps();
    cut.retain(|(key, ramp)| {
        ramp.end() > total && (ramp.after >= total || !MAY_GROW.contains(&&**key))
    });
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
        let config = Settings::new().sets(&sets).resolve().unwrap();
        hints(&config, &TrainArgs::default(), &Config::default())
    }

    #[test]
    fn what_is_rarely_meant_gets_a_line_each() {
        let [line] = &hints_for(&["run.total_steps=18000000"])[..] else {
            panic!("one line")
        };
        let ramps = "training.tolerance, training.hold, randomization.share, ppo.horizon";
        assert!(
            line.contains(&format!("{ramps}, which last up to 80000000 steps")),
            "{line}"
        );
        assert!(!line.contains("assist"), "its ramp ends in time: {line}");
        assert!(hints_for(&["run.total_steps=9000000"])[0].contains("training.assist"));
        let [line] = &hints_for(&["ppo.minibatches=32"])[..] else {
            panic!("one line")
        };
        assert!(line.starts_with("minibatches of 512 samples"), "{line}");
        let [line] = &hints_for(&["env.dist_reward_scale=-20"])[..] else {
            panic!("one line")
        };
        assert!(
            line.starts_with("env.dist_reward_scale = -20 has little or no effect with training.task_reward = 0.03"),
            "{line}"
        );
        assert!(hints_for(&["env.dist_reward_scale=-20", "training.task_reward=1"]).is_empty());
        let [line] = &hints_for(&["randomization.share={after=200_000_000}"])[..] else {
            panic!("one line")
        };
        assert!(
            line.contains("shorter than the ramps of randomization.share, which"),
            "{line}"
        );
        let ranges = hints_for(&[
            "randomization.friction=[0.3,2]",
            "run.total_steps=30_000_000",
        ]);
        assert!(
            ranges
                .concat()
                .contains("randomization.friction = [0.3,2] has little or no effect"),
            "{ranges:?}"
        );
        assert!(
            hints_for(&["env.fall_penalty=-100"])
                .concat()
                .contains("env.fall_penalty = -100 has little")
        );
    }

    #[test]
    fn a_setting_that_another_one_leaves_without_effect_gets_a_line() {
        for (sets, begin) in [
            (
                ["ppo.desired_kl=0", "ppo.learning_rate_range=[1e-6,1e-2]"],
                "ppo.learning_rate_range = [0.000001,0.01] has",
            ),
            (
                ["ppo.away_std=0", "ppo.away_range=[0.1,0.5]"],
                "ppo.away_range = [0.1,0.5] has",
            ),
            (
                ["randomization.push=0", "randomization.push_steps=3"],
                "randomization.push_steps = 3 has",
            ),
            (
                ["env.rot_reward_scale=0", "env.rot_eps=0.2"],
                "env.rot_eps = 0.2 has",
            ),
            (
                ["randomization.share=0", "randomization.each=0.9"],
                "randomization.each = 0.9 has",
            ),
            (
                ["ppo.critic_first=20", "run.seed=3"],
                "ppo.critic_first = 20: it is for a policy",
            ),
        ] {
            let hints = hints_for(&sets);
            assert!(
                hints.iter().any(|hint| hint.starts_with(begin)),
                "{begin}: {hints:?}"
            );
        }
    }

    #[test]
    fn no_settings_that_come_with_the_program_cause_a_line() {
        let default = Config::default();
        for (_, text) in SHIPPED {
            let source = Source::new("x.toml", text);
            let config = Settings::new().file(source).resolve().unwrap();
            let args = TrainArgs {
                init: Some("builtin".into()),
                ..TrainArgs::default()
            };
            assert_eq!(hints(&config, &args, &default), [""; 0]);
        }
    }
}
