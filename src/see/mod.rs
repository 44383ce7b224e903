//! The task on display: in a window, as a film or as a picture.
//!
//! Without the feature `viewer` there is no window; without `video` there are no films or pictures. Modules with the same
//! interface then take their place and fail with a message that says so. Neither feature changes anything else.

#[cfg_attr(not(feature = "video"), path = "film_absent.rs")]
mod film;
mod scenery;
#[cfg_attr(not(feature = "viewer"), path = "window_absent.rs")]
mod window;

pub use film::{EpisodeFilms, Film, screenshot};
pub use scenery::task_to_see;
pub use window::{HAS_WINDOWS, Window};
