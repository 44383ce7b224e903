//! Who plays: a policy, or a baseline.

use crate::cli::{Baseline, PlayArgs};
use crate::evaluate::Actor;
use crate::load::Loaded;

/// Returns the baseline that the user wants.
pub(super) fn baseline(args: &PlayArgs) -> Actor<'static> {
    if args.policy == Some(Baseline::Random) { Actor::Random } else { Actor::Zero }
}

/// Returns the actor that a policy is played as.
pub(super) fn actor_of<'a>(loaded: &'a Loaded, args: &PlayArgs) -> Actor<'a> {
    let policy = loaded.policy.freeze();
    if args.stochastic { Actor::Stochastic(policy) } else { Actor::Mean(policy) }
}
