//! Which values are allowed.

use super::{Backend, Config, Precision};

impl Config {
    /// Every rule that the values break, as "key = value: must …".
    pub(super) fn violations(&self) -> Vec<String> {
        let Self { env, training, ppo, run } = self;
        let mut rules = Rules::default();
        rules.at_least("env.num_envs", env.num_envs, 1);
        rules.at_most("env.num_envs", env.num_envs, 1 << 16);
        rules.check(!env.model.is_empty(), "env.model", &env.model, "be a path or \"builtin\"");
        rules.equal("env.num_hand_dofs", env.num_hand_dofs, 24);
        rules.equal("env.num_actuators", env.num_actuators, 20);
        rules.positive("env.sim_dt", env.sim_dt);
        rules.positive("env.ctrl_dt", env.ctrl_dt);
        rules.positive("env.friction_scale", env.friction_scale);
        rules.positive("env.cube_mass_scale", env.cube_mass_scale);
        let ratio = env.ctrl_dt / env.sim_dt;
        rules.check(
            ratio.is_nan()
                || ratio <= 0.0
                || ((1.0..=1e4).contains(&ratio.round()) && (ratio / ratio.round() - 1.0).abs() < 1e-6),
            "env.ctrl_dt",
            env.ctrl_dt,
            &format!("be a whole multiple of env.sim_dt = {}, up to 10000 of them", env.sim_dt),
        );
        rules.check(
            (1.0..=1e9).contains(&(env.max_episode_seconds / env.ctrl_dt).round()),
            "env.max_episode_seconds",
            env.max_episode_seconds,
            "last between one and 1e9 steps of env.ctrl_dt",
        );
        rules.between("env.act_moving_average", env.act_moving_average, 0.0, 1.0);
        rules.check(
            env.act_moving_average != 0.0,
            "env.act_moving_average",
            env.act_moving_average,
            "be above 0 (at 0 no action would have an effect)",
        );
        rules.positive("env.rot_eps", env.rot_eps);
        rules.positive("env.success_tolerance", env.success_tolerance);
        rules.at_least("env.max_consecutive_successes", env.max_consecutive_successes as usize, 1);
        rules.positive("env.fall_dist", env.fall_dist);
        rules.not_negative("env.reset_position_noise", env.reset_position_noise);
        rules.not_negative("env.reset_dof_pos_noise", env.reset_dof_pos_noise);
        rules.not_negative("env.reset_dof_vel_noise", env.reset_dof_vel_noise);

        rules.not_negative("training.task_reward", training.task_reward);
        rules.not_negative("training.task_reward_start", training.task_reward_start);
        rules.positive("training.tolerance_scale", training.tolerance_scale);
        rules.positive("training.tolerance_start", training.tolerance_start);
        let shrinks = 0.0 < training.hold_scale && training.hold_scale <= 1.0;
        rules.check(shrinks, "training.hold_scale", training.hold_scale, "be above 0 and at most 1");
        rules.at_least("training.hold_start", training.hold_start as usize, 1);
        rules.positive("training.goal_angle_start", training.goal_angle_start);
        let half_turn = training.goal_angle_start <= std::f64::consts::PI;
        rules.check(half_turn, "training.goal_angle_start", training.goal_angle_start, "be at most pi");
        let seconds = training.episode_seconds;
        let lasts = env.control_steps(seconds) >= 1;
        let rule = "be 0, or last at least a step of env.ctrl_dt";
        rules.check(seconds == 0.0 || lasts, "training.episode_seconds", seconds, rule);

        rules.at_least("ppo.horizon", ppo.horizon, 1);
        rules.at_least("ppo.epochs", ppo.epochs, 1);
        let samples = env.num_envs.saturating_mul(ppo.horizon);
        let rule = "be at most 2^22 samples together with env.num_envs";
        rules.check(samples <= 1 << 22, "ppo.horizon", ppo.horizon, rule);
        rules.check(
            ppo.minibatches >= 1 && samples.is_multiple_of(ppo.minibatches),
            "ppo.minibatches",
            ppo.minibatches,
            &format!("divide num_envs * horizon = {samples}"),
        );
        rules.check(
            ppo.precision == Precision::F32 || ppo.backend == Backend::Fused,
            "ppo.precision",
            toml::Value::try_from(ppo.precision).expect("a word"),
            "be \"f32\" with ppo.backend = \"candle\"",
        );
        let sizes_fit = (1..=64).contains(&ppo.hidden.len()) && ppo.hidden.iter().all(|h| (1..=16384).contains(h));
        let hidden = format!("{:?}", &ppo.hidden[..ppo.hidden.len().min(65)]);
        rules.check(sizes_fit, "ppo.hidden", &hidden, "hold one to 64 sizes from 1 to 16384");
        let weights =
            ppo.hidden.windows(2).fold(0_usize, |sum, pair| sum.saturating_add(pair[0].saturating_mul(pair[1])));
        rules.check(weights <= 1 << 25, "ppo.hidden", hidden, "have at most 2^25 weights between them");
        rules.positive("ppo.learning_rate", ppo.learning_rate);
        let [low, high] = ppo.learning_rate_range;
        let range = format!("[{low}, {high}]");
        rules.check(0.0 < low && low <= high, "ppo.learning_rate_range", range, "rise from above 0");
        rules.check(
            ppo.desired_kl == 0.0 || (low..=high).contains(&ppo.learning_rate),
            "ppo.learning_rate",
            ppo.learning_rate,
            &format!("lie in ppo.learning_rate_range = [{low}, {high}] unless ppo.desired_kl = 0"),
        );
        rules.not_negative("ppo.desired_kl", ppo.desired_kl);
        rules.not_negative("ppo.critic_learning_rate", ppo.critic_learning_rate);
        rules.between("ppo.gamma", ppo.gamma, 0.0, 1.0);
        rules.between("ppo.lambda", ppo.lambda, 0.0, 1.0);
        rules.positive("ppo.clip", ppo.clip);
        rules.not_negative("ppo.value_clip", ppo.value_clip);
        rules.not_negative("ppo.value_coef", ppo.value_coef);
        rules.not_negative("ppo.entropy_coef", ppo.entropy_coef);
        rules.not_negative("ppo.bounds_coef", ppo.bounds_coef);
        rules.positive("ppo.max_grad_norm", ppo.max_grad_norm);
        rules.positive("ppo.reward_scale", ppo.reward_scale);
        rules.positive("ppo.init_std", ppo.init_std);
        rules.positive("ppo.max_std", ppo.max_std);
        rules.between("ppo.exploring_share", ppo.exploring_share, 0.0, 1.0);
        rules.between("ppo.exploring_scale", ppo.exploring_scale, 0.01, 100.0);
        rules.not_negative("ppo.away_std", ppo.away_std);
        let [near, far] = ppo.away_range;
        let rises = 0.0 <= near && near < far;
        rules.check(rises, "ppo.away_range", format!("[{near}, {far}]"), "rise from 0 or more");
        let falls = ppo.max_std_steps == 0 || ppo.max_std <= ppo.init_std;
        let rule = format!("be at most ppo.init_std = {} unless ppo.max_std_steps = 0", ppo.init_std);
        rules.check(falls, "ppo.max_std", ppo.max_std, &rule);
        let (least, most) = (ppo.min_std, if ppo.max_std_steps > 0 { ppo.max_std } else { ppo.init_std });
        rules.between("ppo.min_std", least, 0.0, most);

        rules.at_least("run.total_steps", run.total_steps as usize, 1);
        rules.at_least("run.checkpoint_every", run.checkpoint_every as usize, 1);
        rules.at_least("run.eval_every", run.eval_every as usize, 1);
        rules.at_least("run.eval_episodes", run.eval_episodes, 1);
        rules.at_most("run.eval_episodes", run.eval_episodes, 1 << 20);
        rules.at_most("run.threads", run.threads, 4096);
        rules.broken
    }
}

/// Collects the rules that were broken.
#[derive(Default)]
struct Rules {
    broken: Vec<String>,
}

impl Rules {
    fn check(&mut self, holds: bool, key: &str, value: impl std::fmt::Display, rule: &str) {
        if !holds {
            self.broken.push(format!("{key} = {value}: must {rule}"));
        }
    }

    fn at_least(&mut self, key: &str, value: usize, least: usize) {
        self.check(value >= least, key, value, &format!("be at least {least}"));
    }

    fn at_most(&mut self, key: &str, value: usize, most: usize) {
        self.check(value <= most, key, value, &format!("be at most {most}"));
    }

    fn equal(&mut self, key: &str, value: usize, only: usize) {
        self.check(value == only, key, value, &format!("be {only}, the task is laid out for it"));
    }

    fn positive(&mut self, key: &str, value: f64) {
        self.check(value > 0.0, key, value, "be above 0");
    }

    fn not_negative(&mut self, key: &str, value: f64) {
        self.check(value >= 0.0, key, value, "not be negative");
    }

    fn between(&mut self, key: &str, value: f64, low: f64, high: f64) {
        self.check((low..=high).contains(&value), key, value, &format!("lie in [{low}, {high}]"));
    }
}
