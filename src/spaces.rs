//! What a learner must know about the observations and actions of an environment.
//!
//! It is separate because the environment creates it and the learner reads it, and neither depends on the other.

/// The sizes of observations and actions, and the parts of an observation that a learner uses.
#[derive(Clone, Copy)]
pub struct Spaces {
    /// The number of values in an observation.
    pub observation_size: usize,
    /// The number of values in an action.
    pub action_size: usize,
    /// The location of an object and its goal, if there is one.
    pub object_and_goal: Option<ObjectAndGoal>,
    /// The distance of an observation from its goal, in the unit of `ppo.away_range`.
    pub distance: fn(&Self, &[f32]) -> f32,
}

/// The offsets of orientations (w, x, y, z) in an observation.
#[derive(Clone, Copy)]
pub struct ObjectAndGoal {
    /// The offset of the orientation of the object.
    pub object: usize,
    /// The offset of the orientation of its goal.
    pub goal: usize,
    /// The offset of the orientation of the object relative to its goal.
    pub relative: usize,
    /// The rotations that a policy treats as the same: bit i is set if it is number i of [`crate::quat::CUBE_ROTATIONS`].
    pub rotations: u32,
}
