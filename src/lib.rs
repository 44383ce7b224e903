//! Trains a simulated Shadow Hand to turn a cube in its palm to any requested orientation, on a CPU.
//!
//! This library is internal to the program `shadow-repose` and to its Python package. Its items promise nothing to other crates.
//!
//! # Vocabulary
//! A *substep* is one physics step. A *step* (or control step) is one action of an environment. An *iteration* is one
//! rollout of all environments and the update that learns from it. An *episode* ends *terminated* (the cube was dropped or
//! the physics diverged) or *truncated* (time is up). A *goal* is an orientation. It is *reached* when the cube has been
//! within the tolerance for long enough. Quaternions have the order w, x, y, z. Units are SI and radians. The frame is the
//! world frame unless stated otherwise. The simulation uses `f64`. Everything from the observation on uses `f32`.
//!
//! # Modules
//! The modules are listed from top to bottom. A test compares the last column with the actual imports.
//!
//! | module | what it is | imports |
//! |---|---|---|
//! | `main` | runs a command, prints errors, sets the exit code | bench, cli, export, manual, os, play, plot, ranks, runs, train, view |
//! | `processor` | the sentence about a processor that MuJoCo cannot run on; of the program only | - |
//! | [`mod@train`] | the training loop: collect, learn, evaluate, report, save | agent, check, cli, config, evaluate, load, os, ppo, ranks, repose, run, schedule, sim, tags |
//! | [`mod@play`] | plays a policy: in a window or a browser, as a film or an HTML file, or for its score as a table or JSON | cli, config, evaluate, goal_times, load, os, ppo, repose, robustness, run, see, sim, trace |
//! | [`mod@check`] | whether a hand can learn at all, before it is trained | config, env, quat, repose, rng, statistics |
//! | [`mod@robustness`] | the score of a policy under changed physics, noise and delays | config, draw, evaluate, os, repose, statistics |
//! | [`mod@view`] | shows the scene without a policy, and checks it | check, cli, config, evaluate, os, repose, run, see, sim |
//! | [`mod@export`] | a policy as an ONNX file | cli, config, evaluate, load, os, ppo, repose, run, spaces |
//! | [`mod@plot`] | learning curves of runs | cli, draw, os, run, statistics, tags |
//! | [`mod@runs`] | a table of run folders; two of them compared | cli, config, os, run, statistics |
//! | [`mod@bench`] | the speed of this machine | agent, cli, config, env, os, ppo, ranks, repose, rng, schedule, sim, spaces |
//! | [`manual`] | shell completions and a manual page | cli, os |
//! | [`cli`] | the structure of the command line | config, evaluate, os, sim |
//! | [`see`] | rendering of the task: window, film, picture, page | draw, env, evaluate, os, repose, sim |
//! | [`trace`] | episodes as JSON lines | env, evaluate, repose |
//! | [`goal_times`] | the time to reach a goal | config, env, evaluate, statistics |
//! | [`agent`] | environments, learner and rollout; one iteration of training | config, env, os, ppo, ranks, repose, schedule, spaces |
//! | [`load`] | checkpoints and policies from untrusted files | config, evaluate, os, ppo, repose, run, sim |
//! | [`mod@evaluate`] | whole episodes under one policy, the basis of scores | env, os, ppo, ranks, repose, rng, schedule, sim, spaces |
//! | [`repose`] | the task: hand, observation (one table), reward, changes for training | config, env, os, quat, rng, sim, spaces, statistics |
//! | [`mod@env`] | many environments, in blocks that step without a barrier or all at once; no hand in it | ranks, rng, schedule, sim, spaces |
//! | [`ppo`] | the learner: flat parameters, policy, two gradient backends (`fused`, ours; `candle`), one Adam, checkpoints | config, os, quat, ranks, rng, spaces |
//! | [`config`] | all settings, their defaults and rules | os, sim |
//! | [`sim`] | the only interface to MuJoCo | draw, os, quat, schedule |
//! | [`run`] | the folder of a run and its logs | os, sim |
//! | [`draw`] | charts, films, pictures and pages as files | os |
//! | [`os`] | the system around the program: files, terminal, signals, locks, pip, a server for a page | - |
//! | [`tags`] | what a training run logs: names, meanings, units | repose |
//! | [`ranks`] | the division of a training run into shards, and the ranks (processes) that compute them | os, rng, schedule |
//! | [`spaces`] | what a learner needs to know about observations and actions | - |
//! | [`schedule`] | blocks of work on all threads, over many rounds without a barrier | - |
//! | [`quat`] | rotations | - |
//! | [`statistics`] | means, percentiles, lines | - |
//! | [`rng`] | random generators named by (seed, purpose, index) | - |
//!
//! `env` and `ppo` do not depend on each other. They are combined in `agent`, `evaluate` and the modules above. `run` depends
//! on neither. There are no import cycles between files. Each part of the outside world (MuJoCo, candle, files, the terminal)
//! is confined to one folder, unsafe code to nine files.
//!
//! # Data path of an iteration
//! There are N environments in blocks of n, T steps, and O and A values in an observation and an action. A block's arrays
//! are time-major and allocated once. Each block goes through these steps independently, on whichever thread is free:
//! ```text
//! observations[t] --acting.act--> actions[t], log_probs[t], values[t]
//! actions[t] --envs.step--> rewards[t], ends, observations[t + 1] (of the new episode if one ended), final observations
//! rewards[t] --acting.scale_and_bootstrap--> scaled; + γ V(final observation) if the episode was truncated or its goal replaced
//! ```
//! Then the learner processes all blocks together:
//! ```text
//! rollout --ppo.update--> advantages, epochs × minibatches of (loss → flat gradient, summed over groups as a tree → norm
//!                         → Adam); then the normaliser
//! observations[T] --carry_over--> observations[0] of the next iteration
//! ```
//! Observations are stored raw everywhere: a policy turns the object onto itself and normalises them as it reads them.
//! `ppo::fused` describes how a minibatch is computed. `ppo::candle` computes the same with candle's tensors.
//!
//! A training run may be spread over several processes. [`ranks`] describes what they exchange.
//!
//! # Recovery
//! At the end of each iteration, [`mod@train`] puts a checkpoint together. It copies the state of the learner and of
//! the environments into a [`ppo::Checkpoint`]: everything that the next iteration depends on. If that iteration fails or
//! is stopped (a signal, a panic, a loss that is not finite), this checkpoint is written. [`run`] writes it whole or not
//! at all, under its number. Such files are read only by [`load`], which also finds the newest undamaged one.

pub mod agent;
pub mod bench;
pub mod check;
pub mod cli;
pub mod config;
pub mod draw;
pub mod env;
pub mod evaluate;
pub mod export;
pub mod goal_times;
pub mod load;
pub mod manual;
pub mod os;
pub mod play;
pub mod plot;
pub mod ppo;
pub mod quat;
pub mod ranks;
pub mod repose;
pub mod rng;
pub mod robustness;
pub mod run;
pub mod runs;
pub mod schedule;
pub mod see;
pub mod sim;
pub mod spaces;
pub mod statistics;
pub mod tags;
pub mod trace;
pub mod train;
pub mod view;
