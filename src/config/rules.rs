//! The rules for valid values.

use std::f64::consts::PI;
use std::fmt::Display;

use toml::{Table, Value};

use super::overlay::{brief, lookup, number, settings, shown};
use super::settings::{Backend, Config, PpoConfig, Precision};
use crate::os::shortened;

/// Keys, separated by spaces, the rule for their numbers, and its text.
type Range = (&'static str, fn(f64) -> bool, &'static str);

/// The ranges of settings. Both ends of a ramp must lie in its range, and so must all values by group.
const RANGES: [Range; 5] = [
    (
        "env.known env.sim_dt env.ctrl_dt env.rot_eps env.success_tolerance env.fall_dist training.tolerance ppo.learning_rate ppo.clip \
         ppo.max_grad_norm ppo.reward_scale ppo.std",
        |x| x > 0.0,
        "be above 0",
    ),
    (
        "env.reset_position_noise env.reset_dof_pos_noise env.reset_dof_vel_noise env.noise env.bias randomization.noise \
         randomization.bias randomization.cube_com randomization.gravity randomization.push training.task_reward training.assist \
         ppo.desired_kl ppo.value_clip ppo.value_coef ppo.bounds_coef ppo.away_std",
        |x| x >= 0.0,
        "not be negative",
    ),
    (
        "env.num_envs env.max_consecutive_successes training.hold ppo.horizon ppo.epochs ppo.minibatches randomization.push_steps \
         run.total_steps run.checkpoint_every run.eval_every run.eval_episodes",
        |x| x >= 1.0,
        "be at least 1",
    ),
    (
        "randomization.share randomization.each ppo.gamma ppo.lambda",
        |x| (0.0..=1.0).contains(&x),
        "lie in [0, 1]",
    ),
    (
        "env.act_moving_average",
        |x| 0.0 < x && x <= 1.0,
        "be above 0 and at most 1",
    ),
];

/// The largest valid values of settings.
const AT_MOST: &[(&str, f64)] = &[
    ("env.num_envs", 65536.0),
    ("training.hold", 1e9),
    ("run.eval_episodes", 1048576.0),
    ("run.threads", 4096.0),
    // No rotation error is larger.
    ("env.success_tolerance", PI),
    // Observed values are squared in `f32`.
    ("env.vel_obs_scale", 1e6),
];

/// The largest magnitude of a value in `[env]`, `[training]` and `[randomization]` that is not a count: anything near it is a
/// mistake.
const LARGEST: f64 = 1e9;

/// The longest delay, control steps. Delayed actions are kept and saved for each environment.
const LONGEST_DELAY: u32 = 1000;

/// The largest coordinate of the goal, m: everything near it is measured in `f32`.
pub const FARTHEST: f64 = 100.0;

/// Every rule that the values break, as "key = value: must …".
pub fn violations(config: &Config) -> Vec<String> {
    let table = Table::try_from(config).expect("a configuration is a tree of tables");
    let mut rules = Rules {
        table: &table,
        broken: Vec::new(),
    };
    for (keys, holds, rule) in RANGES {
        for key in keys.split_whitespace() {
            rules.number(key, holds, rule);
        }
    }
    for (key, most) in AT_MOST {
        rules.number(key, |x| x <= *most, format!("be at most {most}"));
    }
    magnitudes(&mut rules);
    env(config, &mut rules);
    hand(&mut rules);
    randomization(config, &mut rules);
    nets(config, &mut rules);
    samples(config, &mut rules);
    learning(&config.ppo, &mut rules);
    rules.broken
}

fn magnitudes(rules: &mut Rules) {
    let limited = ["env.", "training.", "randomization."];
    // Much is computed from these values in `f32`.
    let [least, most] = [1e-37, 1e38];
    for (key, value) in settings(rules.table).filter(|(key, _)| key != "training.hold") {
        let is_limited = limited.iter().any(|section| key.starts_with(section));
        let most = if is_limited { LARGEST } else { most };
        for x in floats(value) {
            let rule = format!("be at most {} in magnitude", brief(most));
            rules.check_part(x.abs() <= most, &key, brief(x), rule);
            let rule = format!("be 0, or at least {least:e} in magnitude");
            rules.check_part(x == 0.0 || x.abs() >= least, &key, brief(x), rule);
        }
    }
}

/// The values of a setting that are not counts.
fn floats(value: &Value) -> Vec<f64> {
    match value {
        Value::Float(x) => vec![*x],
        Value::Array(values) => values.iter().flat_map(floats).collect(),
        Value::Table(ramp) => ramp.values().flat_map(floats).collect(),
        _ => Vec::new(),
    }
}

fn hand(rules: &mut Rules) {
    for (key, value) in settings(rules.table).filter(|(key, _)| key.starts_with("hand.")) {
        let names = match value {
            Value::Array(names) => &names[..],
            // It names nothing.
            Value::String(name) if name.is_empty() => &[],
            name => std::slice::from_ref(name),
        };
        for name in names.iter().filter_map(Value::as_str) {
            let fits = (1..=200).contains(&name.len()) && !name.contains(char::is_control);
            let rule = "hold names of 1 to 200 bytes without control characters";
            rules.check_part(fits, &key, name, rule);
        }
    }
}

fn env(config: &Config, rules: &mut Rules) {
    let env = &config.env;
    let near = env.goal_position.value.iter().all(|x| x.abs() <= FARTHEST);
    let rule = format!("have coordinates of at most {FARTHEST} m");
    rules.check(near, "env.goal_position", rule);
    let model = &env.model;
    let is_path = (1..=4095).contains(&model.len()) && !model.contains(char::is_control);
    rules.check_part(is_path, "env.model", model, "be a path or \"builtin\"");
    let ratio = env.ctrl_dt / env.sim_dt;
    rules.check(
        env.is_multiple_of(env.sim_dt) || ratio.is_nan() || ratio <= 0.0,
        "env.ctrl_dt",
        format!(
            "be a whole multiple of env.sim_dt = {}, at most 10000 times it",
            env.sim_dt
        ),
    );
    let steps = (env.max_episode_seconds / env.ctrl_dt).round();
    rules.check(
        (1.0..=1e9).contains(&steps),
        "env.max_episode_seconds",
        "last between one and 1e9 steps of env.ctrl_dt",
    );
}

fn randomization(config: &Config, rules: &mut Rules) {
    let env = &config.env;
    // A factor that is drawn from a range also has a setting in [env].
    let table = rules.table;
    for (key, value) in table["randomization"].as_table().into_iter().flatten() {
        let Some([Value::Float(low), Value::Float(high)]) = value.as_array().map(Vec::as_slice)
        else {
            continue;
        };
        rules.check(
            0.0 < *low && low <= high,
            &format!("randomization.{key}"),
            "be [low, high] with 0 < low <= high",
        );
        let scale = format!("{key}_scale");
        let factor = table["env"][&scale].as_float().expect("a factor");
        rules.check(factor > 0.0, &format!("env.{scale}"), "be above 0");
    }
    let [low, high] = config.randomization.delay;
    rules.check(
        low <= high,
        "randomization.delay",
        "be [low, high] with low <= high",
    );
    let steps = if env.max_episode_seconds >= env.ctrl_dt {
        env.max_episode_steps()
    } else {
        u32::MAX
    };
    let drawn = if high > 0 {
        env.action_delay.saturating_add(high)
    } else {
        0
    };
    for (key, delay, with) in [
        ("env.action_delay", env.action_delay, ""),
        ("env.prediction", env.prediction, ""),
        ("randomization.delay", drawn, ", with env.action_delay,"),
    ] {
        let rule = format!("be{with} shorter than an episode, which lasts {steps} steps");
        rules.check(delay < steps, key, rule);
        let rule = format!("be{with} at most {LONGEST_DELAY}");
        rules.check(delay <= LONGEST_DELAY, key, rule);
    }
    rules.check(
        env.prediction == 0 || env.vel_obs_scale != 0.0,
        "env.vel_obs_scale",
        "not be 0 with env.prediction: velocities must be observed",
    );
}

fn nets(config: &Config, rules: &mut Rules) {
    let hidden = &config.ppo.hidden;
    rules.check(
        (1..=64).contains(&hidden.len()) && hidden.iter().all(|h| (1..=16384).contains(h)),
        "ppo.hidden",
        "hold one to 64 sizes from 1 to 16384",
    );
    let weights = hidden.array_windows().fold(0_usize, |sum, [a, b]| {
        sum.saturating_add(a.saturating_mul(*b))
    });
    rules.check(
        weights <= 1 << 25,
        "ppo.hidden",
        "have at most 2^25 weights between its layers",
    );
}

fn samples(config: &Config, rules: &mut Rules) {
    let ppo = &config.ppo;
    let horizon = ppo.horizon;
    let whole = horizon.from.fract() == 0.0;
    let multiple = horizon.from < 1.0 || whole && horizon.to % horizon.from == 0.0;
    rules.check(
        multiple,
        "ppo.horizon",
        "be a whole number, or a ramp that ends at a multiple of its start",
    );
    let most = config.env.num_envs as f64 * horizon.to;
    rules.check(
        most <= (1 << 22).into(),
        "ppo.horizon",
        "give at most 2^22 samples (num_envs * horizon)",
    );
    let samples = config.steps_per_iteration() as usize;
    let parts = ppo.minibatches;
    // A number of 0 is reported elsewhere.
    let divides = parts == 0 || samples.is_multiple_of(parts);
    rules.check(
        divides,
        "ppo.minibatches",
        format!("divide num_envs * horizon = {samples}"),
    );
    let shards = config.run.shards;
    let dealt =
        !divides || parts == 0 || shards == 0 || shards.is_power_of_two() && config.divides(shards);
    let rule = "be 0, or a power of two that divides env.num_envs and the samples of a minibatch";
    rules.check(dealt, "run.shards", rule);
}

fn learning(ppo: &PpoConfig, rules: &mut Rules) {
    rules.check(
        ppo.precision == Precision::F32 || ppo.backend == Backend::Fused,
        "ppo.precision",
        "be \"f32\" with ppo.backend = \"candle\"",
    );
    let [low, high] = ppo.learning_rate_range;
    let kl = ppo.desired_kl.0;
    let fixed = [kl.from, kl.to].contains(&0.0);
    rules.check(
        !fixed || kl.from == kl.to,
        "ppo.desired_kl",
        "be above 0 at both ends, or 0 throughout",
    );
    let within = fixed || (low..=high).contains(&ppo.learning_rate);
    let rule =
        format!("lie in ppo.learning_rate_range = [{low}, {high}] unless ppo.desired_kl = 0");
    rules.check(within, "ppo.learning_rate", rule);
    rules.check(
        0.0 < low && low <= high,
        "ppo.learning_rate_range",
        "be [low, high] with 0 < low <= high",
    );
    let [near, far] = ppo.away_range;
    rules.check(
        0.0 <= near && near < far,
        "ppo.away_range",
        "be [near, far] with 0 <= near < far",
    );
}

/// The rules that were broken.
struct Rules<'a> {
    /// The settings.
    table: &'a Table,
    broken: Vec<String>,
}

impl Rules<'_> {
    fn check(&mut self, holds: bool, key: &str, rule: impl Display) {
        let value = lookup(self.table, key).expect("a setting");
        self.check_part(holds, key, shown(value), rule);
    }

    /// Checks part of a setting, which is shown alone.
    fn check_part(&mut self, holds: bool, key: &str, value: impl Display, rule: impl Display) {
        if !holds {
            self.broken.push(format!(
                "{} = {}: must {rule}",
                shortened(key),
                shortened(&value.to_string())
            ));
        }
    }

    /// Checks a number, both ends of a ramp, or the numbers of all groups.
    fn number(&mut self, key: &str, holds: impl Fn(f64) -> bool, rule: impl Display) {
        let setting = lookup(self.table, key).expect("a setting");
        let mut check = |name: &str, value: &Value| {
            let x = number(value).expect("a number");
            self.check_part(holds(x), name, brief(x), &rule);
        };
        match setting {
            Value::Table(parts) => {
                // The other parts of a ramp are counts of steps.
                for (part, value) in parts.iter().filter(|(_, value)| value.is_float()) {
                    check(&format!("{key}.{part}"), value);
                }
            }
            value => check(key, value),
        }
    }
}
