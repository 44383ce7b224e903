//! Films and pictures: H.264 in MP4, GIF and PNG files.
//!
//! One thread draws a film and another encodes it, which keeps both cores of a small machine busy.

mod caption;
mod format;
mod gif;
mod mp4;

use std::path::PathBuf;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::{self, JoinHandle};

use anyhow::{Context, Result, bail, ensure};

use crate::os::{Destination, OutputFile};

pub use self::format::FilmFormat;

/// The most frames that wait for the encoder.
const WAITING: usize = 4;

/// The most frames of a film. The index of an MP4 is kept in memory, and space for it is reserved in the file.
const MOST_FRAMES: usize = 2_000_000;

/// A frame `[height, width, 3]`, and the lines of text in its corner.
type CaptionedFrame = (Vec<u8>, Vec<String>);

/// A film being written. The file appears once the film is finished.
pub struct FilmWriter {
    path: PathBuf,
    frames: SyncSender<CaptionedFrame>,
    encoder: JoinHandle<Result<OutputFile>>,
}

impl FilmWriter {
    /// Starts a film.
    ///
    /// # Errors
    /// Fails for a format that the kind of file does not support, or if the file cannot be written.
    pub fn create(to: &Destination, format: FilmFormat) -> Result<Self> {
        let is_gif = to.ending == "gif";
        let [width, height] = format.size;
        let even = width.is_multiple_of(2) && height.is_multiple_of(2);
        ensure!(
            is_gif || even,
            "{width}x{height}: the width and height of an MP4 film must be even"
        );
        ensure!(
            !is_gif || format.fps <= 50,
            "{} fps: a GIF has at most 50 frames per second",
            format.fps
        );
        ensure!(
            format.longest <= MOST_FRAMES,
            "{} frames: a film has at most {MOST_FRAMES}; use fewer or shorter episodes",
            format.longest
        );
        let file = OutputFile::create(&to.path)?;
        let (frames, incoming) = sync_channel::<CaptionedFrame>(WAITING);
        let encode = move || {
            let frames = incoming.into_iter().map(|(mut rgb, lines)| {
                caption::draw(&mut rgb, format.size, &lines);
                rgb
            });
            let encoded = if is_gif {
                gif::encode(&file.file, format, frames)
            } else {
                mp4::encode(&file.file, format, frames)
            };
            encoded.map(|()| file)
        };
        let encoder = thread::Builder::new()
            .name("film".into())
            .spawn(encode)
            .context("cannot start a thread")?;
        Ok(Self {
            path: to.path.clone(),
            frames,
            encoder,
        })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// Fails if the encoder has stopped early. [`FilmWriter::finish`] returns the reason.
    pub fn push(&mut self, frame: CaptionedFrame) -> Result<()> {
        self.frames
            .send(frame)
            .ok()
            .context("the film cannot be continued")
    }

    /// Completes the file. Without `keep`, abandons the film and leaves an existing file as it was.
    ///
    /// # Errors
    /// Fails if the encoder or the file failed, on this or an earlier frame.
    pub fn finish(self, keep: bool) -> Result<()> {
        drop(self.frames);
        let encoded = self
            .encoder
            .join()
            .unwrap_or_else(|_| bail!("the encoder failed"));
        encoded
            .and_then(|file| if keep { file.complete() } else { Ok(()) })
            .with_context(|| format!("cannot write the film {}", self.path.display()))
    }
}

/// Writes a picture `[height, width, 3]` as PNG.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_png(output: OutputFile, [width, height]: [u32; 2], rgb: &[u8]) -> Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    encoder.write_header()?.write_image_data(rgb)?;
    output.finish(&bytes)
}
