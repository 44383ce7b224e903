//! Text in the corner of a picture, on a darkened background.

use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};
use plotters::backend::{BitMapBackend, DrawingBackend};
use plotters::style::{Color, WHITE};

/// Draws the lines into the top left corner of `rgb` `[height, width, 3]`. Text that does not fit is cut off.
pub fn draw(rgb: &mut [u8], size: [u32; 2], lines: &[String]) {
    // All letters of this font have the same width.
    let font = FontRef::try_from_slice(epaint_default_fonts::HACK_REGULAR)
        .expect("the font is part of the program");
    let scale = PxScale::from((size[1] as f32 / 28.0).max(11.0));
    let scaled = font.as_scaled(scale);
    let advance = scaled.h_advance(scaled.glyph_id('0'));
    let spacing = (scaled.height() * 1.15).ceil();

    let margin = (0.6 * scaled.height()).ceil();
    let lengths = lines.iter().map(|line| line.chars().count());
    let longest = lengths.max().unwrap_or(0);
    let across = longest as f32 * advance + 2.0 * margin;
    let down = lines.len() as f32 * spacing + margin;
    let width = size[0] as usize;
    for row in rgb.chunks_exact_mut(3 * width).take(down as usize) {
        for channel in &mut row[..3 * width.min(across as usize)] {
            *channel = (u32::from(*channel) * 2 / 5) as u8;
        }
    }
    let mut picture = BitMapBackend::with_buffer(rgb, size.into());
    for (i, line) in lines.iter().enumerate() {
        let baseline = 0.5 * margin + i as f32 * spacing + scaled.ascent();
        for (column, letter) in line.chars().enumerate() {
            let place = point(margin + column as f32 * advance, baseline);
            let glyph = scaled.glyph_id(letter);
            if let Some(outline) = font.outline_glyph(glyph.with_scale_and_position(scale, place)) {
                let corner = outline.px_bounds().min;
                outline.draw(|x, y, cover| {
                    let x = corner.x as i32 + x as i32;
                    let y = corner.y as i32 + y as i32;
                    let drawn =
                        picture.draw_pixel((x, y), WHITE.mix(cover.into()).to_backend_color());
                    drawn.expect("memory can be written");
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caption_changes_its_corner_only_and_what_does_not_fit_is_cut_off() {
        let size = [320, 240];
        let mut rgb = vec![100; 320 * 240 * 3];
        draw(&mut rgb, size, &["goals 3".into(), "error 12°".into()]);
        assert!(rgb.iter().any(|&channel| channel > 200), "text is drawn");
        assert!(
            rgb[..3].iter().all(|&channel| channel == 40),
            "on a darkened background"
        );
        assert!(
            rgb[rgb.len() / 2..].iter().all(|&channel| channel == 100),
            "the rest is unchanged"
        );
        draw(&mut rgb, size, &vec!["x".repeat(500); 100]);
    }
}
