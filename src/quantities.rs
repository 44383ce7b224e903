//! The quantities that a training logs: what each one is, and in which unit. The columns of `metrics.csv` and the tags in
//! TensorBoard are their names.

/// A logged quantity.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Quantity {
    /// What it is, in a few words, with its unit in brackets if it has one.
    pub title: String,
    /// What it is, in a sentence.
    pub description: String,
}

/// The groups of scores: the prefix of a name, what is added to a title, and the episodes.
const GROUPS: [(&str, &str, &str); 3] = [
    ("episode/", "training", "Training episodes that ended in the iteration; not those that were randomised."),
    ("randomized/", "randomised training", "Randomised training episodes that ended in the iteration."),
    ("eval/", "evaluation", "Episodes of the task itself with mean actions."),
];

/// The figures of a score: name, title, description.
const SCORES: [(&str, &str, &str); 7] = [
    ("return", "return", "Sum of the task's rewards of an episode."),
    ("length", "episode length (steps)", "Control steps of an episode."),
    ("goals", "goals per episode", "Goals reached and held in an episode."),
    ("in_tolerance", "share of steps in tolerance", "Fraction of the steps within the task's tolerance."),
    ("drop_rate", "share of episodes dropped", "Fraction of the episodes that ended with a drop."),
    ("rot_dist", "rotation error (rad)", "Rotation error, mean over the steps."),
    ("steps_per_goal", "steps per goal", "Control steps per goal reached."),
];

/// All other quantities: name, title, description.
const OTHERS: [(&str, &str, &str); 36] = [
    ("reward/rotation", "reward: rotation", "The task's reward for a small rotation error, mean per step."),
    (
        "reward/distance",
        "reward: distance",
        "The task's penalty for the cube's distance from its place, mean per step.",
    ),
    ("reward/action", "reward: action", "The task's penalty for large actions, mean per step."),
    ("reward/bonus", "reward: bonus", "The task's bonus within the tolerance, mean per step."),
    ("reward/fall", "reward: fall", "The task's penalty for a drop, mean per step."),
    (
        "training/progress",
        "training reward: progress",
        "What training pays for turning towards the goal, mean per step.",
    ),
    (
        "training/approach",
        "training reward: approach",
        "What training pays for coming nearer to the goal by a factor, mean per step.",
    ),
    ("training/within", "training reward: within", "What training pays within the tolerance, mean per step."),
    ("training/drop", "training reward: drop", "What a drop costs in training, mean per step."),
    ("training/tolerance", "tolerance in training (rad)", "The rotation error up to which a goal counts in training."),
    ("training/hold", "hold in training (steps)", "The steps within the tolerance that reach a goal in training."),
    ("training/task_reward", "weight of the task's reward", "The weight of the task's reward in training."),
    ("training/drop_reward", "reward of a drop", "What training adds to the reward of a step that drops the cube."),
    ("training/randomized", "share of episodes", "Probability that an episode that begins is randomised."),
    ("loss/policy", "policy loss", "The clipped surrogate, negated, mean over the minibatches."),
    ("loss/value", "value loss", "The squared error of the values, mean over the minibatches."),
    ("policy/entropy", "entropy (nats)", "Entropy of the action distribution."),
    ("policy/kl", "KL divergence (nats)", "KL divergence from the policy that collected; near ppo.desired_kl."),
    ("policy/first_kl", "first KL divergence (nats)", "The same before the first gradient step: 0 up to rounding."),
    ("policy/clip_fraction", "share of samples clipped", "Fraction of the samples whose ratio was clipped."),
    (
        "policy/std",
        "standard deviation of actions",
        "Mean standard deviation of the actions; 1 is half an actuator's range.",
    ),
    ("policy/excess", "excess of mean actions", "Squared distance of the mean actions from [-1, 1]."),
    ("value/explained_variance", "explained variance", "1: the values explain the returns, 0: not at all."),
    ("optim/learning_rate", "learning rate", "Learning rate after the update."),
    ("optim/grad_norm", "gradient norm", "Norm of the gradient before clipping, mean over the minibatches."),
    ("time/collect_s", "collecting (s)", "Seconds of collecting in the iteration."),
    ("time/update_s", "learning (s)", "Seconds of learning in the iteration."),
    ("time/steps_per_s", "speed (steps/s)", "Control steps per second of collecting and learning, over all hands."),
    (
        "time/exchange_s",
        "exchange (s)",
        "Seconds of collecting and learning in which the first of several ranks talked to the others or waited for them.",
    ),
    (
        "time/exchange_bytes",
        "exchange (bytes)",
        "Bytes that the first of several ranks sent to the others while collecting and learning.",
    ),
    ("sim/diverged", "diverged steps", "Steps of the iteration on which the physics diverged."),
    ("histogram/std", "standard deviations", "Standard deviations of the 20 actions; 1 is half an actuator's range."),
    (
        "histogram/actions",
        "actions",
        "Actions of the iteration as drawn, before they are clipped to [-1, 1]; of several ranks: those of the first.",
    ),
    (
        "histogram/advantages",
        "advantages",
        "Advantages of the iteration, with mean 0 and standard deviation 1; of several ranks: those of the first.",
    ),
    ("eval/film", "film", "The first evaluation episode with mean actions, at the speed of the simulation."),
    ("settings", "settings", "Every setting of the run, as in its config.toml."),
];

/// Returns the quantity with this name, if it is one of those that a training logs.
pub fn quantity(name: &str) -> Option<Quantity> {
    let other = OTHERS.iter().find(|(known, ..)| *known == name);
    if let Some((_, title, description)) = other {
        return Some(Quantity { title: (*title).to_owned(), description: (*description).to_owned() });
    }
    GROUPS.iter().find_map(|(group, of, episodes)| {
        let figure = name.strip_prefix(group)?;
        let (_, title, description) = SCORES.iter().find(|(known, ..)| *known == figure)?;
        Some(Quantity { title: format!("{title}, {of}"), description: format!("{description} {episodes}") })
    })
}
