//! Text in the corner of a picture, on a darkened background.

use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};

/// The font and layout of captions for pictures of one size.
pub(super) struct Captions {
    font: FontRef<'static>,
    scale: PxScale,
    width: usize,
    height: usize,
}

impl Captions {
    /// Prepares captions for pictures with this width and height in pixels.
    pub(super) fn new([width, height]: [u32; 2]) -> Self {
        let font =
            FontRef::try_from_slice(epaint_default_fonts::HACK_REGULAR).expect("the font is part of the program");
        let scale = PxScale::from((height as f32 / 28.0).max(11.0));
        Self { font, scale, width: width as usize, height: height as usize }
    }

    /// Draws the lines into the top left corner of `rgb` `[height, width, 3]`. Text that does not fit is cut off.
    pub(super) fn draw(&self, rgb: &mut [u8], lines: &[String]) {
        if lines.is_empty() {
            return;
        }
        let font = self.font.as_scaled(self.scale);
        let advance = font.h_advance(font.glyph_id('0'));
        let line_height = (font.height() * 1.15).ceil();
        let margin = (0.6 * font.height()).ceil();
        let longest = lines.iter().map(|line| line.chars().count()).max().unwrap_or(0);
        let box_width = (longest as f32 * advance + 2.0 * margin) as usize;
        let box_height = (lines.len() as f32 * line_height + margin) as usize;
        for y in 0..box_height.min(self.height) {
            let row = &mut rgb[3 * y * self.width..][..3 * box_width.min(self.width)];
            row.iter_mut().for_each(|channel| *channel = (u32::from(*channel) * 2 / 5) as u8);
        }
        for (i, line) in lines.iter().enumerate() {
            let baseline = 0.5 * margin + i as f32 * line_height + font.ascent();
            for (column, letter) in line.chars().enumerate() {
                let place = point(margin + column as f32 * advance, baseline);
                let glyph = font.glyph_id(letter).with_scale_and_position(self.scale, place);
                let Some(outline) = self.font.outline_glyph(glyph) else { continue };
                let corner = outline.px_bounds().min;
                outline.draw(|x, y, cover| {
                    let (x, y) = (corner.x as i64 + i64::from(x), corner.y as i64 + i64::from(y));
                    self.blend(rgb, x, y, cover);
                });
            }
        }
    }

    /// Blends white into a pixel.
    fn blend(&self, rgb: &mut [u8], x: i64, y: i64, cover: f32) {
        let inside = (0..self.width as i64).contains(&x) && (0..self.height as i64).contains(&y);
        if !inside {
            return;
        }
        let at = 3 * (y as usize * self.width + x as usize);
        for channel in &mut rgb[at..at + 3] {
            *channel = (f32::from(*channel) + (255.0 - f32::from(*channel)) * cover.clamp(0.0, 1.0)) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caption_changes_its_corner_only_and_what_does_not_fit_is_cut_off() {
        let captions = Captions::new([320, 240]);
        let mut rgb = vec![100; 320 * 240 * 3];
        captions.draw(&mut rgb, &["goals 3".into(), "error 12°".into()]);
        assert!(rgb.iter().any(|&channel| channel > 200), "text is drawn");
        assert!(rgb[..3].iter().all(|&channel| channel == 40), "on a darkened background");
        assert!(rgb[rgb.len() / 2..].iter().all(|&channel| channel == 100), "the rest is unchanged");
        captions.draw(&mut rgb, &vec!["x".repeat(500); 100]);
    }
}
