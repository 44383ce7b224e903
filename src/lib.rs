//! Trains a simulated Shadow Hand to turn a cube in its palm to any asked orientation, on a CPU.
//!
//! # Vocabulary
//! A *substep* is one physics step, a *step* (or control step) one action of an environment, an *iteration* one rollout of
//! all environments and the update that learns from it. An *episode* ends *terminated* (the cube was dropped, the physics
//! diverged) or *truncated* (time is up). A *goal* is an orientation; it is *reached* when the cube has been within the
//! tolerance for long enough. Quaternions are w, x, y, z; units are SI and radians, the frame is the world's where nothing
//! else is said. Doubles in the simulation, floats from the observation on.
//!
//! # Modules
//! | module | what it is |
//! |---|---|
//! | [`cli`] | the shape of the command line |
//! | [`config`] | all settings, their defaults and rules |
//! | [`train`] | the training: the only place where environments and the learner meet |
//! | [`mod@evaluate`] | whole episodes under one policy: what scores are made of |
//! | [`play`], [`trace`] | scores as table and JSON; episodes as JSON lines |
//! | [`mod@bench`] | what this machine can do |
//! | [`mod@env`] | the task, its reward, and many of them on worker threads |
//! | [`sim`] | the fence around MuJoCo |
//! | [`ppo`] | the fence around candle: policy, losses, optimizer, checkpoint as bytes |
//! | [`run`] | the outside: run folder, logs, terminal, signals |
//! | [`quat`], [`rng`] | rotations; generators named by (seed, purpose, index) |
//!
//! Direction of knowledge: `main → {train, play, bench} → evaluate → {env → sim, ppo, run} → {config, rng, quat}`. `env` and
//! `ppo` do not know each other, `run` knows neither; a test holds the fences up.
//!
//! # Data path of an iteration
//! N environments, T steps, O and A numbers in an observation and an action; all arrays time-major and allocated once:
//! ```text
//! rollout.observations[t] --ppo.act--> actions[t], log_probs[t], values[t]
//! actions[t] --pool.step--> rewards[t], ends, observations[t + 1] (of the new episode where one ended), final observations
//! rewards[t] --ppo.settle--> scaled; + γ V(final observation) where the episode was truncated
//! rollout --ppo.update--> advantages, epochs × minibatches of loss, gradient, Adam; then the normaliser
//! observations[T] --carry_over--> observations[0] of the next iteration
//! ```

pub mod bench;
pub mod cli;
pub mod config;
pub mod env;
pub mod evaluate;
pub mod play;
pub mod ppo;
pub mod quat;
pub mod rng;
pub mod run;
pub mod sim;
pub mod trace;
pub mod train;
