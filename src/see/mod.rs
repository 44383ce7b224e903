//! The task on display: in a window, as a film or as a picture, and in a browser.
//!
//! Without the feature `viewer` there is no window. Without `video` there are no films or pictures. A request for them fails
//! with one of the messages below. The features have no other effect.

mod clock;
mod columns;
mod display;
#[cfg(feature = "video")]
mod film;
mod live;
mod replay;
mod sliders;
#[cfg(feature = "viewer")]
mod window;

pub use columns::About;
pub use display::{dress, mesh_files, task_for_display};
#[cfg(feature = "video")]
pub use film::{Film, screenshot};
pub use live::{Live, LiveActor};
pub use replay::Replay;
pub use sliders::{Order, Slider, Sliders};
#[cfg(feature = "viewer")]
pub use window::Window;

/// The message of a build without films and pictures.
pub const NO_FILMS: &str =
    "this build cannot make films or pictures: it was built without the feature `video`";

/// The message of a build without windows.
pub const NO_WINDOWS: &str =
    "this build cannot open windows: it was built without the feature `viewer`";
