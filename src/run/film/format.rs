//! What the kinds of film files have in common.

use anyhow::Result;

use crate::run::OutputFile;

/// What a film file is made for.
#[derive(Clone, Copy, Debug)]
pub struct FilmFormat {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Frames per second.
    pub fps: u32,
    /// The most frames it can have.
    pub longest: usize,
}

/// A kind of film file.
pub trait Film {
    /// Takes the next frame `[height, width, 3]`.
    fn push(&mut self, rgb: &[u8]) -> Result<()>;

    /// Writes what is still to be written.
    fn finish(self: Box<Self>) -> Result<OutputFile>;
}
