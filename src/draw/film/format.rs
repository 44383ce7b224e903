//! The common interface of the film encoders.

use anyhow::Result;

use crate::os::OutputFile;

/// The parameters of a film file.
#[derive(Clone, Copy, Debug)]
pub struct FilmFormat {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Frames per second.
    pub fps: u32,
    /// The most frames that the film can have.
    pub longest: usize,
}

/// An encoder for one kind of film file.
pub(super) trait FilmEncoder {
    /// Adds the next frame `[height, width, 3]`.
    fn push(&mut self, rgb: &[u8]) -> Result<()>;

    /// Writes what is left and returns the file.
    fn finish(self: Box<Self>) -> Result<OutputFile>;
}
