//! Charts, films and pictures as files.

mod bar_chart;
mod chart;
#[cfg(feature = "video")]
mod film;
mod page;

pub use bar_chart::{BarChart, NamedBar};
pub use chart::{Chart, Curve, Picture, PictureFile, Subplot};
#[cfg(feature = "video")]
pub use film::{FilmFormat, FilmWriter, write_png};
pub use page::{Mesh, Page};
