//! The settings of the program: their types, the sources of their values, and the rules for valid values.
//!
//! No default is written in Rust: `configs/repose.toml` is the base, over which the user's file and `--set` are applied. They
//! are merged as tables before typing, so that every source goes through the same checks. Nothing here depends on the code
//! that uses a setting.
//!
//! A new training key is written in four places: `configs/repose.toml`, its field in `settings`, its rule in `rules`, its use.

mod applicability;
mod differences;
mod layers;
mod overlay;
mod ramp;
mod rules;
mod settings;

/// The default configuration, with comments.
pub const BASE: &str = include_str!("../../configs/repose.toml");

pub use applicability::expect_used;
pub use differences::{Difference, short};
pub use layers::{Override, PolicyConfig, Source, user_file};
pub use ramp::Ramp;
pub use rules::FARTHEST;
pub use settings::{
    Activation, BUILTIN_MODEL, Backend, ByGroup, Config, EnvConfig, NetConfig, OfScene, PpoConfig, Precision,
    RandomizationConfig, RunConfig, SuccessHold, Symmetry, TrainingConfig,
};

#[cfg(test)]
mod tests {
    use toml::{Table, Value};

    use super::*;

    fn shipped(text: &str) -> Config {
        Config::resolve(Some(&Source { path: "x.toml".into(), text: text.into() }), &[]).unwrap()
    }

    #[test]
    fn the_other_files_that_come_with_the_program_say_what_differs() {
        let published = shipped(include_str!("../../configs/isaac-lab.toml"));
        let EnvConfig { reach_goal_bonus, max_consecutive_successes, .. } = published.env;
        assert_eq!((published.env.max_episode_steps(), published.env.substeps()), (600, 2));
        assert_eq!((reach_goal_bonus, max_consecutive_successes), (250.0, 1));
        assert_eq!((published.training.task_reward, published.training.hold_reward), (Ramp::constant(1.0), 0.0));
        let all = shipped(include_str!("../../configs/randomization-all.toml"));
        let source = shipped(include_str!("../../configs/randomization-source.toml"));
        let varied = |config: &Config| -> Vec<String> {
            let nothing = |value: &Value| ["0.0", "[1.0, 1.0]", "[0, 0]", "{}"].contains(&value.to_string().trim());
            let keys = Table::try_from(&config.randomization).unwrap();
            keys.into_iter().filter(|(_, value)| !nothing(value)).map(|(key, _)| key).collect()
        };
        assert_eq!(varied(&all).len(), 16, "everything is on");
        assert_eq!(varied(&source), ["share", "each", "friction", "cube_mass", "cube_com", "push_steps"]);
        let share = |config: &Config| (config.randomization.share, config.randomization.each);
        assert_eq!([share(&all), share(&source)], [(Ramp::constant(1.0), 1.0); 2]);
        assert!(!published.randomization.happens());
    }

    #[test]
    fn the_files_for_a_trained_policy_are_the_default_with_its_ramps_at_their_ends_less_smoothing_and_less_noise() {
        let default = Config::resolve(None, &[]).unwrap();
        let continuing = shipped(include_str!("../../configs/repose-continue.toml"));
        let ended = |ramp: Ramp| Ramp::constant(ramp.to);
        let (training, ppo) = (default.training, default.ppo);
        let (drop_reward, tolerance, hold) = (training.drop_reward, training.tolerance, training.hold);
        let [drop_reward, tolerance, hold] = [drop_reward, tolerance, hold].map(ended);
        assert_eq!(continuing.training, TrainingConfig { drop_reward, tolerance, hold, ..training });
        let share = ended(default.randomization.share);
        assert_eq!(continuing.randomization, RandomizationConfig { share, ..default.randomization });
        let minibatches = ppo.minibatches * (ppo.horizon.to / ppo.horizon.from) as usize;
        let [horizon, desired_kl] = [ppo.horizon, ppo.desired_kl].map(ended);
        let PpoConfig { std, away_std, learning_rate, .. } = continuing.ppo;
        assert!(std.from == std.to && std.to < ppo.std.to && away_std < ppo.away_std);
        let expected = PpoConfig { horizon, std, away_std, desired_kl, minibatches, learning_rate, ..ppo };
        assert_eq!(continuing.ppo, expected, "only noise and the first learning rate are its own");
        let act_moving_average = continuing.env.act_moving_average;
        assert!(act_moving_average > default.env.act_moving_average);
        assert_eq!(continuing.env, EnvConfig { act_moving_average, ..default.env });
        let robust = shipped(include_str!("../../configs/repose-robust.toml"));
        assert_eq!((&robust.env, &robust.ppo), (&continuing.env, &continuing.ppo));
        assert_eq!(robust.training, TrainingConfig { drop_reward: robust.training.drop_reward, ..continuing.training });
    }
}
