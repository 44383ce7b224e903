//! Charts, films and pictures as files.

mod bar_chart;
mod chart;
mod page;
#[cfg(feature = "video")]
mod film;

pub use bar_chart::{BarChart, HeatMap, NamedBar};
pub use page::{Mesh, Page};
pub use chart::{Chart, Curve, Picture, Subplot, picture_format};
#[cfg(feature = "video")]
pub use film::{FilmFormat, FilmWriter, Frame, gif_of, write_png};
