//! GIF: one palette for the whole film; each frame holds only what differs from the previous one.

use std::borrow::Cow;
use std::io::{BufWriter, Write};

use anyhow::{Result, anyhow};
use color_quant::NeuQuant;
use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::format::{FilmEncoder, FilmFormat};
use crate::os::OutputFile;

/// The number of colours in the palette; the index after them leaves a pixel unchanged.
const COLOURS: usize = 255;
const TRANSPARENT: u8 = COLOURS as u8;
/// The most bytes of frames kept for choosing the palette, which suits the frames at the start.
const BYTES_FOR_PALETTE: usize = 200 << 20;
/// The most pixels sampled for choosing the palette.
const PIXELS_FOR_PALETTE: usize = 400_000;

/// A GIF being written.
pub(super) struct GifFilm<W: Write> {
    format: FilmFormat,
    stage: Stage<W>,
}

enum Stage<W: Write> {
    /// Frames `[height, width, 3]` that wait for the palette.
    Gathering {
        file: Option<W>,
        frames: Vec<Vec<u8>>,
    },
    Writing(Box<Writing<W>>),
}

struct Writing<W: Write> {
    encoder: Encoder<BufWriter<W>>,
    palette: Palette,
    format: FilmFormat,
    previous: Vec<u8>,
    frames: u64,
}

impl<W: Write> GifFilm<W> {
    /// Creates a film; writes nothing until the palette is known.
    pub(super) fn new(file: W, format: FilmFormat) -> Self {
        Self { format, stage: Stage::Gathering { file: Some(file), frames: Vec::new() } }
    }

    /// Returns the film with a palette. On the first call, chooses the palette and writes the frames that waited for it.
    fn writing(&mut self) -> Result<&mut Writing<W>> {
        if let Stage::Gathering { file, frames } = &mut self.stage {
            let file = file.take().ok_or_else(|| anyhow!("the film could not be started"))?;
            let mut writing = Writing::new(file, self.format, Palette::new(frames))?;
            frames.iter().try_for_each(|rgb| writing.write(rgb))?;
            self.stage = Stage::Writing(Box::new(writing));
        }
        match &mut self.stage {
            Stage::Writing(writing) => Ok(writing),
            Stage::Gathering { .. } => unreachable!("the stage was just changed"),
        }
    }

    /// Adds the next frame `[height, width, 3]`.
    pub(super) fn push(&mut self, rgb: &[u8]) -> Result<()> {
        match &mut self.stage {
            Stage::Gathering { frames, .. } if (frames.len() + 1) * rgb.len() <= BYTES_FOR_PALETTE => {
                frames.push(rgb.to_vec());
                Ok(())
            }
            _ => self.writing()?.write(rgb),
        }
    }

    /// Writes what is left and returns the writer.
    pub(super) fn finish(mut self) -> Result<W> {
        self.writing()?;
        match self.stage {
            Stage::Writing(writing) => {
                let file = writing.encoder.into_inner()?;
                file.into_inner().map_err(|error| anyhow!("{}", error.error()))
            }
            Stage::Gathering { .. } => unreachable!("the stage was just changed"),
        }
    }
}

impl FilmEncoder for GifFilm<OutputFile> {
    fn push(&mut self, rgb: &[u8]) -> Result<()> {
        self.push(rgb)
    }

    fn finish(self: Box<Self>) -> Result<OutputFile> {
        (*self).finish()
    }
}

impl<W: Write> Writing<W> {
    fn new(file: W, format: FilmFormat, palette: Palette) -> Result<Self> {
        let [width, height] = [u16::try_from(format.size[0])?, u16::try_from(format.size[1])?];
        let mut encoder = Encoder::new(BufWriter::new(file), width, height, &palette.colours())?;
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Self { encoder, palette, format, previous: Vec::new(), frames: 0 })
    }

    fn write(&mut self, rgb: &[u8]) -> Result<()> {
        let [width, height] = self.format.size.map(|pixels| pixels as usize);
        let changed = |x: usize, y: usize| {
            let at = 3 * (y * width + x);
            self.previous.get(at..at + 3) != Some(&rgb[at..at + 3])
        };
        // The smallest rectangle around all changes; one pixel if there are none.
        let rows: Vec<usize> = (0..height).filter(|&y| (0..width).any(|x| changed(x, y))).collect();
        let (top, bottom) = (rows.first().copied().unwrap_or(0), rows.last().copied().unwrap_or(0));
        let in_column = |x: &usize| (top..=bottom).any(|y| changed(*x, y));
        let left = (0..width).find(in_column).unwrap_or(0);
        let right = (left..width).rev().find(in_column).unwrap_or(left);
        let mut pixels = Vec::with_capacity((right + 1 - left) * (bottom + 1 - top));
        for y in top..=bottom {
            for x in left..=right {
                let at = 3 * (y * width + x);
                pixels.push(if changed(x, y) { self.palette.index(&rgb[at..at + 3]) } else { TRANSPARENT });
            }
        }
        // Rounds times, not delays, to hundredths of a second, so that the film has the right length at any frame rate.
        let hundredths = |frames: u64| (frames * 100 + u64::from(self.format.fps) / 2) / u64::from(self.format.fps);
        self.encoder.write_frame(&Frame {
            delay: (hundredths(self.frames + 1) - hundredths(self.frames)) as u16,
            dispose: DisposalMethod::Keep,
            transparent: Some(TRANSPARENT),
            top: top as u16,
            left: left as u16,
            width: (right + 1 - left) as u16,
            height: (bottom + 1 - top) as u16,
            buffer: Cow::Owned(pixels),
            ..Frame::default()
        })?;
        self.frames += 1;
        self.previous.clear();
        self.previous.extend_from_slice(rgb);
        Ok(())
    }
}

/// A palette that finds the nearest of its colours for any colour.
struct Palette {
    quantizer: NeuQuant,
    /// Indices that were looked up already, by the upper six bits of red, green and blue.
    known: Vec<Option<u8>>,
}

impl Palette {
    /// Chooses a palette for these frames.
    fn new(frames: &[Vec<u8>]) -> Self {
        let pixels: usize = frames.iter().map(|rgb| rgb.len() / 3).sum();
        let every = pixels.div_ceil(PIXELS_FOR_PALETTE).max(1);
        let all = frames.iter().flat_map(|rgb| rgb.chunks_exact(3));
        let sample: Vec<u8> = all.step_by(every).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255]).collect();
        Self { quantizer: NeuQuant::new(10, COLOURS, &sample), known: vec![None; 1 << 18] }
    }

    fn colours(&self) -> Vec<u8> {
        self.quantizer.color_map_rgb()
    }

    fn index(&mut self, rgb: &[u8]) -> u8 {
        let key = rgb.iter().fold(0, |key, &channel| key << 6 | usize::from(channel >> 2));
        *self.known[key].get_or_insert_with(|| {
            // The middle of the colours that share the key.
            let middle = |channel: u8| channel & !3 | 2;
            self.quantizer.index_of(&[middle(rgb[0]), middle(rgb[1]), middle(rgb[2]), 255]) as u8
        })
    }
}
