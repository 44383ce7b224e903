//! The commands that use each setting.

use anyhow::{Result, bail};
use toml::Table;

use super::BASE;
use super::layers::Override;
use super::overlay::table_of;

/// The commands that take settings.
const COMMANDS: [&str; 5] = ["train", "bench", "play", "view", "export"];

/// Settings of `[env]` and `[run]` that are used by fewer commands than the rest of their section.
const FEWER: [(&str, &[&str]); 6] = [
    ("env.num_envs", &["train", "bench"]),
    ("run.total_steps", &["train", "bench"]),
    ("run.checkpoint_every", &["train"]),
    ("run.eval_every", &["train"]),
    ("run.eval_episodes", &["train"]),
    ("run.film_every", &["train"]),
];

/// Checks that a command uses all of these single settings. A configuration file may hold any setting, because it is shared by
/// all commands.
///
/// # Errors
/// Fails on the first setting that the command does not use, and names the commands that do.
pub fn expect_used(overrides: &[Override], command: &str) -> Result<()> {
    let base: Table = BASE.parse().expect("the built-in configuration is TOML");
    for Override { key, value } in overrides {
        let table = table_of(key, value, &base);
        let in_sections = table.iter().filter_map(|(section, keys)| Some((section, keys.as_table()?)));
        for (section, name) in in_sections.flat_map(|(section, keys)| keys.keys().map(move |name| (section, name))) {
            // Unknown keys are reported elsewhere, with a suggestion.
            let known = base.get(section).and_then(|keys| keys.get(name)).is_some();
            let users = users(section, name);
            if known && !users.contains(&command) {
                let does = if users.len() == 1 { "does" } else { "do" };
                let users = users.join("` and `");
                bail!("--set {key}={value}: `{command}` does not use {section}.{name}; `{users}` {does}");
            }
        }
    }
    Ok(())
}

fn users(section: &str, name: &str) -> &'static [&'static str] {
    let key = format!("{section}.{name}");
    let fewer = FEWER.iter().find(|(of, _)| *of == key).map(|(_, users)| *users);
    fewer.unwrap_or(if section == "env" { &COMMANDS } else { &COMMANDS[..2] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_that_a_command_does_not_use_is_refused_with_those_that_do() {
        let answer =
            |set: &str, command| expect_used(&[set.parse().unwrap()], command).map_err(|error| error.to_string());
        for (set, command, users) in [
            ("env.num_envs=99", "play", "`train` and `bench` do"),
            ("ppo.gamma=0.5", "view", "`train` and `bench` do"),
            ("run.threads=3", "view", "`train` and `bench` do"),
            ("training.tolerance.to=1", "play", "`train` and `bench` do"),
            ("run.eval_every=3", "bench", "`train` does"),
            ("ppo={gamma=0.5}", "play", "`train` and `bench` do"),
            ("env={num_envs=9}", "view", "`train` and `bench` do"),
        ] {
            let refusal = answer(set, command).unwrap_err();
            assert!(refusal.contains(&format!("`{command}` does not use")) && refusal.contains(users), "{refusal}");
            assert!(answer(set, "train").is_ok());
        }
        assert!(answer("env.sim_dt=0.002", "view").is_ok() && answer("run.seed=3", "bench").is_ok());
        assert!(answer("env.foo=1", "view").is_ok(), "reported elsewhere");
    }
}
