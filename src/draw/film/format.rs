//! What the film encoders need to know of a film.

/// The parameters of a film file.
#[derive(Clone, Copy)]
pub struct FilmFormat {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Frames per second.
    pub fps: u32,
    /// The most frames that the film can have.
    pub longest: usize,
}
