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
//! | [`train`] | the training, from top to bottom: collect, learn, evaluate, report, save |
//! | [`agent`] | what learns: environments, learner, rollout; one iteration of it |
//! | [`mod@collect`] | environments stepping under the policy |
//! | [`mod@evaluate`] | whole episodes under one policy: what scores are made of |
//! | [`dump`] | what led to a diverged state, as JSON |
//! | [`load`] | checkpoints and policies from files that nobody vouches for |
//! | [`play`], [`pace`], [`trace`] | a policy plays: scores as table and JSON; how long goals take; episodes as JSON lines |
//! | [`mod@view`] | the scene without a policy |
//! | [`scenery`], [`window`], [`film`] | the task in a scene to be looked at; interactively; as a film or a picture |
//! | [`plot`] | learning curves of runs |
//! | [`mod@bench`] | what this machine can do |
//! | [`mod@env`] | the task: observation (one table), reward, what training changes of it; many of them in blocks |
//! | [`schedule`] | blocks of work on all threads, through many rounds without a barrier |
//! | [`sim`] | the fence around MuJoCo |
//! | [`ppo`] | the learner: flat parameters, policy, two ways to a gradient (`kernels`, ours; `candle`), one Adam, checkpoints |
//! | [`ranks`] | how a training is divided: shards, and the ranks that compute them |
//! | [`spaces`] | what a learner must know of observations and actions |
//! | [`run`] | the outside: run folder, logs, terminal, signals |
//! | [`quat`], [`rng`] | rotations; generators named by (seed, purpose, index) |
//!
//! Direction of knowledge: `main → commands (train, play, view, plot, bench) → {agent, evaluate, window, film} → {collect, load} →
//! {env → sim, ppo, run} → {config, ranks, spaces, rng, quat, schedule}`. `env` and `ppo` do not know each other, `run` knows neither;
//! a test holds the fences up.
//!
//! # Data path of an iteration
//! N environments in blocks of n, T steps, O and A numbers in an observation and an action; a block's arrays are time-major
//! and allocated once. Each block goes through this by itself, on whichever thread is free:
//! ```text
//! observations[t] --acting.act--> actions[t], log_probs[t], values[t]
//! actions[t] --envs.step--> rewards[t], ends, observations[t + 1] (of the new episode where one ended), final observations
//! rewards[t] --acting.settle--> scaled; + γ V(final observation) where the episode was truncated or its goal replaced
//! ```
//! Then the learner takes all blocks together:
//! ```text
//! rollout --ppo.update--> advantages, epochs × minibatches (as many samples of each shard) of (loss → flat gradient, added over
//!                         the shards as a tree → norm → Adam); then the normaliser
//! observations[T] --carry_over--> observations[0] of the next iteration
//! ```
//! Observations are raw everywhere: a policy perceives (its symmetry) and normalises them as it reads them. How a minibatch is
//! computed is described in `ppo::kernels`; `ppo::candle` is the same in candle's tensors.
//!
//! # What survives
//! At the end of each iteration [`train`] takes everything that the next one depends on into a [`ppo::Checkpoint`], by
//! [`agent::Agent::checkpoint`]: the learner's part and the environments'. Whatever ends the iteration after it (a signal, a panic,
//! a loss that is not finite) leaves that one to be written. [`run`] writes it whole or not at all, under its number, and finds the
//! newest sound one again. [`load`] is the only way in for files.
//!
//! # Features
//! Without `viewer` there is no window, without `video` there are no films and pictures: [`window`] and [`film`] are then
//! replaced by modules of the same shape that say so. Neither changes anything else.

pub mod agent;
pub mod bench;
pub mod cli;
pub mod collect;
pub mod config;
pub mod dump;
pub mod env;
pub mod evaluate;
#[cfg_attr(not(feature = "video"), path = "film_absent.rs")]
pub mod film;
pub mod load;
pub mod pace;
pub mod play;
pub mod plot;
pub mod ppo;
pub mod quat;
pub mod ranks;
pub mod rng;
pub mod run;
pub mod scenery;
pub mod schedule;
pub mod sim;
pub mod spaces;
pub mod trace;
pub mod train;
pub mod view;
#[cfg_attr(not(feature = "viewer"), path = "window_absent.rs")]
pub mod window;
