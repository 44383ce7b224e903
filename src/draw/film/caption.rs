//! Text in the corner of a picture, on a darkened background.

use anyhow::Result;
use plotters::prelude::*;
use plotters::style::register_font;

/// The name of the font, whose letters are all of the same width.
const FONT: &str = "monospace";

/// Draws the lines into the top left corner of `rgb` `[height, width, 3]`. Text that does not fit is cut off.
///
/// # Errors
/// Fails if the font cannot be used.
pub(super) fn draw(rgb: &mut [u8], [width, height]: [u32; 2], lines: &[String]) -> Result<()> {
    let _ = register_font(FONT, FontStyle::Normal, epaint_default_fonts::HACK_REGULAR);
    let area = BitMapBackend::with_buffer(rgb, (width, height)).into_drawing_area();
    let size = (f64::from(height) / 28.0).max(11.0);
    let style = (FONT, size).into_font().color(&WHITE);
    let (margin, spacing) = ((0.6 * size).ceil() as i32, (1.15 * size).ceil() as i32);
    let mut longest = 0;
    for line in lines {
        longest = longest.max(style.font.box_size(line)?.0 as i32);
    }
    let corners = [(0, 0), (longest + 2 * margin, lines.len() as i32 * spacing + margin)];
    area.draw(&Rectangle::new(corners, BLACK.mix(0.6).filled()))?;
    for (i, line) in lines.iter().enumerate() {
        area.draw(&Text::new(&line[..], (margin, margin + spacing * i as i32), style.clone()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caption_changes_its_corner_only_and_what_does_not_fit_is_cut_off() {
        let size = [320, 240];
        let mut rgb = vec![100; 320 * 240 * 3];
        draw(&mut rgb, size, &["goals 3".into(), "error 12°".into()]).unwrap();
        assert!(rgb.iter().any(|&channel| channel > 200), "text is drawn");
        assert!(rgb[..3].iter().all(|&channel| channel == 40), "on a darkened background");
        assert!(rgb[rgb.len() / 2..].iter().all(|&channel| channel == 100), "the rest is unchanged");
        draw(&mut rgb, size, &vec!["x".repeat(500); 100]).unwrap();
    }
}
