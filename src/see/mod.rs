//! The task on display: in a window, as a film or as a picture.
//!
//! Without the feature `viewer` there is no window; without `video` there are no films or pictures. Modules with the same
//! interface then take their place and fail with a message that says so. Neither feature changes anything else.

mod display;
#[cfg_attr(not(feature = "video"), path = "film_absent.rs")]
mod film;
#[cfg_attr(not(feature = "viewer"), path = "window_absent.rs")]
mod window;

pub use display::task_for_display;
pub use film::{EpisodeFilms, Film, screenshot};
pub use window::{HAS_WINDOWS, Window};
