//! What a learner must know of the observations and actions of an environment.
//!
//! Apart, since the environment makes it and the learner reads it, and neither knows the other.

/// The sizes of observations and actions, and where in an observation stands what a learner makes use of.
#[derive(Clone, Copy, Debug)]
pub struct Spaces {
    /// Numbers in an observation.
    pub observation_size: usize,
    /// Numbers in an action.
    pub action_size: usize,
    /// Where the orientations (w,x,y,z) of a cube and of its goal begin, if there is one: for `ppo.symmetry`.
    pub cube_and_goal: Option<[usize; 2]>,
    /// How far from its goal an observation is, in the unit of `ppo.away_range`.
    pub distance: fn(&[f32]) -> f32,
}
