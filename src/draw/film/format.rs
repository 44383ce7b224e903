//! The common interface of the film encoders.

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

/// Frames `[height, width, 3]` for an encoder, which takes them one by one.
pub type Frames<'a> = &'a mut dyn Iterator<Item = Vec<u8>>;
