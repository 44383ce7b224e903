//! Films and pictures: H.264 in MP4, GIF, PNG; in files, or a GIF in memory.
//!
//! One thread draws a film and another encodes it, which keeps both cores of a small machine busy.

mod caption;
mod format;
mod gif;
mod mp4;

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};

use anyhow::{Context, Result, bail, ensure};

use self::caption::Captions;
use self::format::FilmEncoder;
use self::gif::GifFilm;
use self::mp4::Mp4Film;
use crate::os::OutputFile;

pub use self::format::FilmFormat;

/// The most frames that wait for the encoder.
const WAITING: usize = 4;

/// The most frames of a film. The index of an MP4 is kept in memory, and space for it is reserved in the file.
const MOST_FRAMES: usize = 2_000_000;

/// A film being written. The file appears once the film is finished.
pub struct FilmWriter {
    path: PathBuf,
    frames: SyncSender<Frame>,
    /// Buffers of encoded frames, for reuse.
    spare: Receiver<Vec<u8>>,
    encoder: JoinHandle<Result<OutputFile>>,
}

struct Frame {
    /// `[height, width, 3]`
    rgb: Vec<u8>,
    caption: Vec<String>,
}

impl FilmWriter {
    /// Starts a film: MP4 or GIF, by the extension of `path`.
    ///
    /// # Errors
    /// Fails for any other extension, for a format that the kind of file does not support, or if the file cannot be written.
    pub fn create(path: &Path, format: FilmFormat) -> Result<Self> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
        let begin: fn(OutputFile, FilmFormat) -> Result<Box<dyn FilmEncoder>> = match extension.as_str() {
            "mp4" => |file, format| Ok(Box::new(Mp4Film::new(file, format)?)),
            "gif" => |file, format| Ok(Box::new(GifFilm::new(file, format))),
            _ => bail!("{}: the name of a film must end in .mp4 or .gif", path.display()),
        };
        let [width, height] = format.size;
        let even = width.is_multiple_of(2) && height.is_multiple_of(2);
        ensure!(extension == "gif" || even, "{width}x{height}: the width and height of an MP4 film must be even");
        let steady = format.fps <= 50;
        ensure!(extension == "mp4" || steady, "{} fps: a GIF has at most 50 frames per second", format.fps);
        let fits = format.longest <= MOST_FRAMES;
        ensure!(fits, "{} frames: a film has at most {MOST_FRAMES}; use fewer or shorter episodes", format.longest);
        let file = OutputFile::create(path)?;
        let (frames, incoming) = sync_channel::<Frame>(WAITING);
        let (done, spare) = sync_channel(WAITING + 1);
        let encode = move || {
            let mut film = begin(file, format)?;
            let captions = Captions::new(format.size);
            for mut frame in incoming {
                captions.draw(&mut frame.rgb, &frame.caption);
                film.push(&frame.rgb)?;
                let _ = done.try_send(frame.rgb);
            }
            film.finish()
        };
        let encoder = thread::Builder::new().name("film".into()).spawn(encode).context("cannot start a thread")?;
        Ok(Self { path: path.to_owned(), frames, spare, encoder })
    }

    /// Adds a frame `[height, width, 3]` with these lines of text in its corner. Does nothing if the encoder has failed:
    /// [`FilmWriter::failed`] reports that, and [`FilmWriter::finish`] returns the reason.
    pub fn push(&mut self, rgb: &[u8], caption: Vec<String>) {
        let mut buffer = self.spare.try_recv().unwrap_or_default();
        buffer.clear();
        buffer.extend_from_slice(rgb);
        let _ = self.frames.send(Frame { rgb: buffer, caption });
    }

    /// Whether the encoder has stopped early.
    pub fn failed(&self) -> bool {
        self.encoder.is_finished()
    }

    /// Abandons the film and leaves an existing file as it was. Returns why the encoder failed, if it did.
    pub fn abandon(self) -> Option<anyhow::Error> {
        drop(self.frames);
        let encoded = self.encoder.join().unwrap_or_else(|_| bail!("the encoder failed"));
        encoded.err().map(|error| error.context(format!("cannot write the film {}", self.path.display())))
    }

    /// Completes the file.
    ///
    /// # Errors
    /// Fails if the encoder or the file failed, on this or an earlier frame.
    pub fn finish(self) -> Result<()> {
        drop(self.frames);
        let encoded = self.encoder.join().unwrap_or_else(|_| bail!("the encoder failed"));
        encoded.and_then(OutputFile::complete).with_context(|| format!("cannot write the film {}", self.path.display()))
    }
}

/// A short film in memory, as a GIF.
pub struct Clip {
    film: GifFilm<Vec<u8>>,
    captions: Captions,
}

impl Clip {
    /// Starts a clip.
    pub fn new(format: FilmFormat) -> Self {
        Self { film: GifFilm::new(Vec::new(), format), captions: Captions::new(format.size) }
    }

    /// Adds a frame `[height, width, 3]` with these lines of text in its corner.
    ///
    /// # Errors
    /// Fails if the picture is too large for a GIF.
    pub fn push(&mut self, rgb: &[u8], caption: &[String]) -> Result<()> {
        let mut frame = rgb.to_vec();
        self.captions.draw(&mut frame, caption);
        self.film.push(&frame)
    }

    /// Returns the file.
    ///
    /// # Errors
    /// Fails if the picture is too large for a GIF.
    pub fn finish(self) -> Result<Vec<u8>> {
        self.film.finish()
    }
}

/// Writes a picture `[height, width, 3]` as PNG.
///
/// # Errors
/// Fails if the name does not end in .png, or if the file cannot be written.
pub fn write_png(output: OutputFile, [width, height]: [u32; 2], rgb: &[u8]) -> Result<()> {
    let named = output.path().extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
    ensure!(named, "{}: the name of a picture must end in .png", output.path().display());
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    encoder.write_header()?.write_image_data(rgb)?;
    output.finish(&bytes)
}
