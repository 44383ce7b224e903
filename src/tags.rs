//! The quantities that a training run logs: what each one is, and in which unit. The columns of `metrics.csv` and the tags in
//! TensorBoard are their names.

use crate::repose::{
    Better, Description, Lesson, OF_EVALUATIONS, OF_TRAINING, measure, task_terms, training_terms,
};

/// A logged quantity.
pub struct Tag {
    /// What it is, in a few words, with its unit in brackets if it has one.
    pub title: String,
    /// What it is, in a sentence.
    pub description: String,
}

/// The groups of scores: the first part of a name, its measures, what is added to a title, and the episodes.
const GROUPS: [(&str, &[&str], &str, &str); 3] = [
    (
        "episode",
        &OF_TRAINING,
        "training",
        "Training episodes that ended in the iteration, without the randomised ones.",
    ),
    (
        "randomized",
        &OF_TRAINING,
        "randomised training",
        "Randomised training episodes that ended in the iteration.",
    ),
    (
        "eval",
        &OF_EVALUATIONS,
        "evaluation",
        "Episodes of the task itself with mean actions.",
    ),
];

/// What is logged besides scores and rewards: name, title, description.
#[rustfmt::skip]
const OTHERS: [(&str, &str, &str); 21] = [
    ("training/turned", "turned towards the goal (rad/100 steps)",
        "Rotation towards the goal in 100 steps, rad; no weight changes it."),
    ("loss/policy", "policy loss", "The clipped surrogate, negated, mean over the minibatches."),
    ("loss/value", "value loss", "The squared error of the values, mean over the minibatches."),
    ("policy/entropy", "entropy (nats)", "Entropy of the action distribution."),
    ("policy/kl", "KL divergence (nats)", "KL divergence from the policy that collected; near ppo.desired_kl."),
    ("policy/first_kl", "first KL divergence (nats)", "KL divergence before the first gradient step: 0 up to rounding."),
    ("policy/clip_fraction", "share of samples clipped", "Fraction of the samples whose ratio was clipped."),
    ("policy/std", "standard deviation of actions", "Standard deviation of the actions; 1 is half an actuator's range."),
    ("policy/excess", "excess of mean actions", "Squared distance of the mean actions from [-1, 1]."),
    ("value/explained_variance", "explained variance", "1: the values explain the returns, 0: not at all."),
    ("optim/learning_rate", "learning rate", "Learning rate after the update."),
    ("optim/grad_norm", "gradient norm", "Norm of the gradient before clipping, mean over the minibatches."),
    ("time/collect_s", "collecting (s)", "Seconds of collecting in the iteration."),
    ("time/update_s", "learning (s)", "Seconds of learning in the iteration."),
    ("time/steps_per_s", "speed (steps/s)", "Control steps per second of collecting and learning, over all environments."),
    ("time/exchange_s", "exchange (s)", "Seconds of collecting and learning that the exchange took, waiting included; with MPI only."),
    ("time/exchange_bytes", "exchange (bytes)", "Bytes that were sent while collecting and learning; with MPI only."),
    ("sim/diverged", "diverged steps", "Steps of the iteration on which the physics diverged."),
    ("histogram/actions", "actions", "Actions of the iteration as drawn, before they are clipped to [-1, 1]."),
    ("histogram/advantages", "advantages", "Advantages of the iteration, with mean 0 and standard deviation 1."),
    ("settings", "settings", "Every setting of the run, as in its config.toml."),
];

/// The quantity with this name, if a training run logs it.
pub fn tag(name: &str) -> Option<Tag> {
    for (known, title, description) in OTHERS {
        if known == name {
            return Some(Tag {
                title: title.into(),
                description: description.into(),
            });
        }
    }
    let (group, part) = name.split_once('/')?;
    let term = |list: &[Description]| {
        let found = list.iter().find(|term| term.0 == part)?;
        Some(format!("{}, mean per step.", found.1.trim_end_matches('.')))
    };
    let of_lesson = || {
        Some(
            Lesson::default()
                .described()
                .into_iter()
                .find(|(value, _)| value.0 == part)?
                .0
                .1
                .to_owned(),
        )
    };
    let description = match group {
        "reward" => term(&task_terms()),
        "training" => term(&training_terms()).or_else(of_lesson),
        _ => None,
    };
    if let Some(description) = description {
        return Some(Tag {
            title: format!("{group}: {part}"),
            description,
        });
    }
    let (_, measures, of, episodes) = GROUPS.iter().find(|(known, ..)| *known == group)?;
    let column = measures.iter().find(|column| **column == part)?;
    let measure = measure(column);
    let better = match measure.better {
        Better::Higher => "Higher is better.",
        Better::Lower => "Lower is better.",
    };
    // Charts show a share as a fraction.
    let unit = match measure.unit {
        "" | "%" => String::new(),
        unit => format!(" ({unit})"),
    };
    Some(Tag {
        title: format!("{}{unit}, {of}", measure.title),
        description: format!("{} {episodes} {better}", measure.description),
    })
}
