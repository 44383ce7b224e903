//! GIF: one palette for the whole film. Each frame holds only what differs from the previous one.

use std::io::{BufWriter, Write};

use anyhow::Result;
use color_quant::NeuQuant;
use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::format::FilmFormat;

/// The number of colours in the palette. The index after them leaves a pixel unchanged.
const COLOURS: usize = 255;
const TRANSPARENT: u8 = COLOURS as u8;
/// The most bytes of frames kept for choosing the palette, which suits the frames at the start.
const BYTES_FOR_PALETTE: usize = 200 << 20;
/// The most pixels sampled for choosing the palette.
const PIXELS_FOR_PALETTE: usize = 400_000;

/// Writes the film. Nothing is written until the palette is known.
///
/// # Errors
/// Fails if the pictures are too large for a GIF, or if the file cannot be written.
pub fn encode(
    file: impl Write,
    format: FilmFormat,
    mut frames: impl Iterator<Item = Vec<u8>>,
) -> Result<()> {
    let [width, height] = format.size.map(|pixels| pixels as usize);
    let most = BYTES_FOR_PALETTE / (3 * width * height);
    let waiting: Vec<_> = frames.by_ref().take(most).collect();
    let mut palette = Palette::new(&waiting);
    let mut encoder = Encoder::new(
        BufWriter::new(file),
        width.try_into()?,
        height.try_into()?,
        &palette.quantizer.color_map_rgb(),
    )?;
    encoder.set_repeat(Repeat::Infinite)?;
    let mut previous = Vec::new();
    for (number, rgb) in (0..).zip(waiting.into_iter().chain(frames)) {
        // Rounds times, not delays, to hundredths of a second, so that the film has the right length at any frame rate.
        let hundredths =
            |frames: u64| (frames * 100 + u64::from(format.fps) / 2) / u64::from(format.fps);
        let delay = (hundredths(number + 1) - hundredths(number)) as u16;
        encoder.write_frame(&Frame {
            delay,
            ..changes(&mut palette, width, &previous, &rgb)
        })?;
        previous = rgb;
    }
    Ok(encoder.into_inner()?.flush()?)
}

/// What differs from the previous frame, if there was one: the smallest rectangle around all changes, or one pixel.
fn changes(palette: &mut Palette, width: usize, previous: &[u8], rgb: &[u8]) -> Frame<'static> {
    let height = rgb.len() / (3 * width);
    let pixel = |x: usize, y: usize| 3 * (y * width + x)..3 * (y * width + x) + 3;
    let changed = |x: usize, y: usize| previous.get(pixel(x, y)) != rgb.get(pixel(x, y));
    let in_row = |y: &usize| (0..width).any(|x| changed(x, *y));
    let top = (0..height).find(in_row).unwrap_or(0);
    let bottom = (top..height).rev().find(in_row).unwrap_or(top);
    let in_column = |x: &usize| (top..=bottom).any(|y| changed(*x, y));
    let left = (0..width).find(in_column).unwrap_or(0);
    let right = (left..width).rev().find(in_column).unwrap_or(left);
    let mut pixels = Vec::new();
    for y in top..=bottom {
        for x in left..=right {
            pixels.push(if changed(x, y) {
                palette.index(&rgb[pixel(x, y)])
            } else {
                TRANSPARENT
            });
        }
    }
    Frame {
        dispose: DisposalMethod::Keep,
        transparent: Some(TRANSPARENT),
        top: top as u16,
        left: left as u16,
        width: (right + 1 - left) as u16,
        height: (bottom + 1 - top) as u16,
        buffer: pixels.into(),
        ..Frame::default()
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
        let sample: Vec<u8> = all
            .step_by(every)
            .flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255])
            .collect();
        Self {
            quantizer: NeuQuant::new(10, COLOURS, &sample),
            known: vec![None; 1 << 18],
        }
    }

    fn index(&mut self, rgb: &[u8]) -> u8 {
        let key = rgb
            .iter()
            .fold(0, |key, &channel| key << 6 | usize::from(channel >> 2));
        *self.known[key].get_or_insert_with(|| {
            // The middle of the colours that share the key.
            let middle = |channel: u8| channel & !3 | 2;
            self.quantizer
                .index_of(&[middle(rgb[0]), middle(rgb[1]), middle(rgb[2]), 255]) as u8
        })
    }
}
