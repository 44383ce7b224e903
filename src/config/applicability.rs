//! The commands that use each setting.

use anyhow::{Result, bail};

use super::layers::Override;
use super::overlay::{DEFAULTS, lookup, settings, table_of};

/// Checks that a command uses all of these single settings. A configuration file may hold any setting, because it is shared by
/// all commands.
///
/// # Errors
/// Fails on the first setting that the command does not use, and names the commands that do.
pub fn expect_used(overrides: &[Override], command: &str) -> Result<()> {
    for Override { key, value } in overrides {
        for (name, _) in settings(&table_of(key, value, &DEFAULTS)) {
            // Unknown keys are reported elsewhere, with a suggestion.
            let known = lookup(&DEFAULTS, &name).is_some();
            let users = users(&name);
            if known && !users.contains(&command) {
                let users = users.join("` and `");
                bail!("--set {key}={value}: `{command}` does not use {name}; `{users}` can");
            }
        }
    }
    Ok(())
}

/// The commands that use a setting.
fn users(key: &str) -> &'static [&'static str] {
    match key {
        "run.checkpoint_every" | "run.eval_every" | "run.eval_episodes" | "run.patience" => {
            &["train"]
        }
        "env.num_envs" => &["train", "bench"],
        key if ["env.", "hand."].iter().any(|begin| key.starts_with(begin)) => {
            &["train", "bench", "play", "view", "export"]
        }
        _ => &["train", "bench"],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_that_a_command_does_not_use_is_refused_with_those_that_do() {
        let answer = |set: &str, command| {
            expect_used(&[set.parse().unwrap()], command).map_err(|error| error.to_string())
        };
        for (set, command, users) in [
            ("env.num_envs=99", "play", "`train` and `bench` can"),
            ("ppo.gamma=0.5", "view", "`train` and `bench` can"),
            ("run.threads=3", "view", "`train` and `bench` can"),
            ("training.tolerance.to=1", "play", "`train` and `bench` can"),
            ("run.eval_every=3", "bench", "`train` can"),
            ("ppo={gamma=0.5}", "play", "`train` and `bench` can"),
            ("env={num_envs=9}", "view", "`train` and `bench` can"),
        ] {
            let refusal = answer(set, command).unwrap_err();
            assert!(
                refusal.contains(&format!("`{command}` does not use")) && refusal.contains(users),
                "{refusal}"
            );
            assert!(answer(set, "train").is_ok());
        }
        assert!(
            answer("env.sim_dt=0.002", "view").is_ok() && answer("run.seed=3", "bench").is_ok()
        );
        assert!(answer("env.foo=1", "view").is_ok(), "reported elsewhere");
    }
}
