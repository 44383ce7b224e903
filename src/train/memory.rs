//! The memory that a training run needs at its most.

use super::session::Session;
use crate::os::memory;
use crate::ppo::GROUP;

/// The memory for the contacts and constraints of an environment, bytes. MuJoCo reserves 2 MiB. In the hands that were tried, it
/// uses at most 0.15 MB.
const CONTACTS: usize = 128 << 10;

/// The memory of an environment before it is stepped, bytes. MuJoCo's statistics of its solver take most of it.
const ENVIRONMENT: usize = 224 << 10;

/// The models besides one for each thread: one for each size of the object.
const MODELS: usize = 5;

/// The memory that the training needs in this process, and that the machine has, GiB, where the system says them. The need is an
/// estimate, before the environments are stepped.
pub fn need(session: &Session) -> Option<[f64; 2]> {
    let both = [
        memory::used()? + growth(session) as f64,
        memory::of_machine()?,
    ];
    Some(both.map(|bytes| bytes / f64::from(1 << 30)))
}

/// The memory that the training will need besides what is used before the environments are stepped, bytes.
pub fn growth(session: &Session) -> usize {
    let Session {
        config,
        task,
        agent,
        ..
    } = session;
    let spaces = task.spaces();
    let sample = 4 * (2 * (spaces.observation_size + spaces.action_size) + 8);
    let horizon = config.ppo.horizon_at(config.run.total_steps) + 1;
    let hidden: usize = config.ppo.hidden.iter().sum();
    // The outputs of the hidden layers for a minibatch and their gradients. For each parameter, the gradients of 16 groups, and three
    // values in the bytes of a checkpoint.
    let learner =
        8 * config.samples_per_minibatch() * hidden + 76 * agent.ppo.policy.layout.count();
    let models = (rayon::current_num_threads() + MODELS) * task.scene.size();
    let of_environment = CONTACTS + horizon * sample + learner / config.env.num_envs;
    agent.pool.count() * of_environment + GROUP * (ENVIRONMENT + CONTACTS) + models
}
