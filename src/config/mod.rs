//! The settings of the program: their types, the sources of their values, and the rules for valid values.
//!
//! No default is written in Rust: `configs/repose.toml` is the base, over which the user's file and `--set` are applied. They
//! are merged as tables before typing, so that every source goes through the same checks. Nothing here depends on the code
//! that uses a setting.
//!
//! `CONTRIBUTING.md` lists where a new setting is written.

mod applicability;
mod differences;
mod layers;
mod overlay;
mod ramp;
mod rules;
mod settings;

/// The default configuration, with comments.
pub const BASE: &str = include_str!("../../configs/repose.toml");

macro_rules! shipped {
    ($($name:literal)*) => {
        [$((concat!("configs/", $name), include_str!(concat!("../../configs/", $name)))),*]
    };
}

/// The settings files that come with the program: their places in the repository, and their texts.
pub const SHIPPED: [(&str, &str); 8] = shipped!(
    "repose.toml"
    "finetune.toml"
    "isaac-lab.toml"
    "other-hand.toml"
    "randomization-all.toml"
    "randomization-source.toml"
    "repose-continue.toml"
    "repose-robust.toml"
);

pub use applicability::expect_used;
pub use differences::{Difference, is_derived, short};
pub use layers::{MODEL, Override, Reader, Settings, Source, scene_option};
pub use ramp::{Geometric, Ramp};
pub use rules::FARTHEST;
pub use settings::{
    Activation, BUILTIN_MODEL, Backend, ByName, Config, EnvConfig, OfScene, PpoConfig, Precision,
    RandomizationConfig, RunConfig, SuccessHold, Symmetry, TrainingConfig,
};

#[cfg(test)]
mod tests {
    use std::path::Path;

    use toml::{Table, Value};

    use super::*;

    fn shipped(name: &str) -> Config {
        let (_, text) = SHIPPED
            .into_iter()
            .find(|(place, _)| *place == format!("configs/{name}.toml"))
            .unwrap();
        Settings::new().file(source(text)).resolve().unwrap()
    }

    #[test]
    fn the_program_contains_every_settings_file_and_uses_it_where_the_folder_has_none() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
        let mut names: Vec<String> = folder
            .read_dir()
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort_unstable();
        let mut places = SHIPPED.map(|(place, _)| place.strip_prefix("configs/").unwrap());
        places.sort_unstable();
        assert_eq!(names, places);
        let here = tempfile::tempdir().unwrap();
        for (place, text) in SHIPPED {
            let found = Settings::new()
                .user_file(Some(Path::new(place)))
                .unwrap()
                .resolve()
                .unwrap();
            assert_eq!(found, Settings::new().file(source(text)).resolve().unwrap());
            let other = Settings::new().user_file(Some(&here.path().join(place)));
            assert!(other.is_err(), "a path of another folder is not replaced");
        }
    }

    #[test]
    fn the_other_files_that_come_with_the_program_say_what_differs() {
        let published = shipped("isaac-lab");
        let EnvConfig {
            reach_goal_bonus,
            max_consecutive_successes,
            ..
        } = published.env;
        assert_eq!(
            (published.env.max_episode_steps(), published.env.substeps()),
            (600, 2)
        );
        assert_eq!((reach_goal_bonus, max_consecutive_successes), (250.0, 1));
        assert_eq!(
            (
                published.training.task_reward,
                published.training.hold_reward
            ),
            (Ramp::constant(1.0), 0.0)
        );
        let all = shipped("randomization-all");
        let source = shipped("randomization-source");
        let varied = |config: &Config| -> Vec<String> {
            let nothing = |value: &Value| {
                ["0.0", "[1.0, 1.0]", "[0, 0]", "{}"].contains(&value.to_string().trim())
            };
            let keys = Table::try_from(&config.randomization).unwrap();
            keys.into_iter()
                .filter(|(_, value)| !nothing(value))
                .map(|(key, _)| key)
                .collect()
        };
        assert_eq!(varied(&all).len(), 16, "everything is on");
        assert_eq!(
            varied(&source),
            [
                "share",
                "each",
                "friction",
                "cube_mass",
                "cube_com",
                "push_steps"
            ]
        );
        let share = |config: &Config| (config.randomization.share, config.randomization.each);
        assert_eq!(
            [share(&all), share(&source)],
            [(Ramp::constant(1.0), 1.0); 2]
        );
        assert!(!published.randomization.happens());
    }

    #[test]
    fn the_files_for_a_trained_policy_are_the_default_with_its_ramps_at_their_ends_and_less_noise_or_a_ramp_to_it()
     {
        let default = Config::default();
        let ended = |ramp: Ramp| Ramp::constant(ramp.to);
        let training = default.training;
        let ppo = default.ppo;
        let smoothing = ended(default.env.act_moving_average);
        let TrainingConfig {
            assist,
            drop_reward,
            tolerance,
            hold,
            ..
        } = training;
        let [assist, drop_reward, hold] = [assist, drop_reward, hold].map(ended);
        let tolerance = Geometric(ended(tolerance.0));
        let trained = TrainingConfig {
            assist,
            drop_reward,
            tolerance,
            hold,
            ..training
        };
        let minibatches = ppo.minibatches * (ppo.horizon.to / ppo.horizon.from) as usize;
        let horizon = ended(ppo.horizon);
        let desired_kl = Geometric(ended(ppo.desired_kl.0));
        let [std, away_std] = [0.13, 0.2].map(Ramp::constant);
        assert!(std.to < ppo.std.0.to && away_std.to < ppo.away_std.to);
        let learnt = PpoConfig {
            horizon,
            std: Geometric(std),
            away_std,
            desired_kl,
            minibatches,
            learning_rate: 1e-4,
            ..ppo
        };
        let tuning = shipped("finetune");
        let robust = shipped("repose-robust");
        let continuing = shipped("repose-continue");
        let drop_reward = robust.training.drop_reward;
        let careless = TrainingConfig {
            drop_reward,
            ..trained.clone()
        };
        let slower = PpoConfig {
            critic_first: continuing.ppo.critic_first,
            ..learnt.clone()
        };
        let late = |from, to| Ramp {
            from,
            to,
            steps: 1_000_000,
            after: 4_000_000,
        };
        let [horizon, std, away_std] = [
            late(ppo.horizon.from, horizon.to),
            late(ppo.std.0.to, std.to),
            late(ppo.away_std.to, away_std.to),
        ];
        let minibatches = ppo.minibatches;
        let explores = PpoConfig {
            horizon,
            minibatches,
            critic_first: 20,
            std: Geometric(std),
            away_std,
            ..learnt.clone()
        };
        let [fast, faster] = [0.6, 0.7].map(Ramp::constant);
        assert!(fast.to > smoothing.to);
        for (found, act_moving_average, training, ppo) in [
            (&continuing, fast, &trained, &slower),
            (&tuning, faster, &trained, &explores),
            (&robust, smoothing, &careless, &learnt),
        ] {
            assert_eq!((&found.training, &found.ppo), (training, ppo));
            assert_eq!(
                found.env,
                EnvConfig {
                    act_moving_average,
                    ..default.env.clone()
                }
            );
        }
    }

    fn source(text: &str) -> Source {
        Source::new("x.toml", text)
    }

    fn set(text: &str) -> Override {
        text.parse().unwrap()
    }

    #[test]
    fn a_ramp_of_the_task_is_stored_whole_and_is_played_with_the_value_that_training_had_reached() {
        let config = Config::default();
        let stored = source(&config.to_text());
        assert_eq!(
            Settings::new()
                .stored(stored.clone(), Reader::Run)
                .resolve()
                .unwrap(),
            config
        );
        let played = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            let player = Reader::Player {
                env_steps: 60_000_000,
            };
            Settings::new()
                .stored(stored.clone(), player)
                .sets(&sets)
                .resolve()
                .unwrap()
                .env
                .act_moving_average
        };
        assert_eq!(played(&[]), Ramp::constant(0.375));
        assert_eq!(played(&["env.act_moving_average=0.6"]), Ramp::constant(0.6));
        assert_eq!(config.env.at(0).act_moving_average, Ramp::constant(0.25));
        let refused = Settings::new()
            .sets(&[set("env.act_moving_average=0")])
            .resolve()
            .unwrap_err()
            .to_string();
        assert!(
            refused.contains("must be above 0 and at most 1"),
            "{refused}"
        );
    }

    #[test]
    fn an_own_scene_keeps_the_size_of_its_object_unless_others_are_named() {
        let sizes = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            Settings::new()
                .sets(&sets)
                .resolve()
                .unwrap()
                .randomization
                .cube_size
        };
        assert_eq!(sizes(&[]), [0.8, 1.2]);
        assert_eq!(sizes(&["env.model=own.xml"]), [1.0, 1.0]);
        assert_eq!(
            sizes(&["env.model=own.xml", "randomization.cube_size=[0.9,1.1]"]),
            [0.9, 1.1]
        );
    }
}
