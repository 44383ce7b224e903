//! A chart of values by name, with a map of values over two quantities below it.

use anyhow::Result;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::chart::{COLOURS, GRID, Picture, draw_text};
use crate::os::number;

/// A value with its name, its interval and a note.
pub struct NamedBar {
    /// The name, to the left.
    pub name: String,
    /// The value, or `NaN` if it is not known.
    pub value: f64,
    /// The interval in which it lies.
    pub interval: [f64; 2],
    /// The note, to the right.
    pub note: String,
}

/// Bars from 0 to about 1, and below them a map of values over two quantities.
pub struct BarChart {
    /// The title.
    pub title: String,
    /// The bars, from top to bottom.
    pub bars: Vec<NamedBar>,
    /// The names of the columns of the map.
    pub columns: Vec<String>,
    /// The names of the rows of the map.
    pub rows: Vec<String>,
    /// The values of the map, from 0 to about 1, row by row.
    pub cells: Vec<Vec<f64>>,
}

// Lengths in pixels.
const WIDTH: i32 = 800;
const TITLE: i32 = 40;
const ROW: i32 = 24;
const NAMES: i32 = 150;
const NOTES: i32 = 190;
const CELL: i32 = 34;
const GAP: i32 = 24;

/// The value at the right end of the bars' axis.
const MOST: f64 = 1.25;

/// The values at which there is a line.
const LINES: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];

const BAR: RGBColor = COLOURS[0];

impl Picture for BarChart {
    fn size(&self) -> Result<[u32; 2]> {
        let bars = ROW * (1 + self.bars.len() as i32);
        let map = CELL * (1 + self.rows.len() as i32);
        Ok([WIDTH as u32, (TITLE + bars + GAP + map + GAP) as u32])
    }

    fn draw(
        &self,
        area: DrawingArea<impl DrawingBackend<ErrorType: 'static>, Shift>,
    ) -> Result<()> {
        area.fill(&WHITE)?;
        draw_text(
            &area,
            &self.title,
            (WIDTH / 2, TITLE / 2),
            (HPos::Center, 16, BLACK),
        )?;
        let bottom = TITLE + ROW * self.bars.len() as i32;
        for value in LINES {
            area.draw(&PathElement::new(
                [(along(value), TITLE), (along(value), bottom)],
                GRID,
            ))?;
            draw_text(
                &area,
                &value.to_string(),
                (along(value), bottom + ROW / 2),
                (HPos::Center, 12, BLACK),
            )?;
        }
        for (bar, row) in self.bars.iter().zip(0..) {
            let middle = TITLE + ROW * row + ROW / 2;
            draw_text(
                &area,
                &bar.name,
                (NAMES - 8, middle),
                (HPos::Right, 13, BLACK),
            )?;
            draw_text(
                &area,
                &bar.note,
                (WIDTH - NOTES + 8, middle),
                (HPos::Left, 12, BLACK),
            )?;
            let corners = [(along(0.0), middle - 7), (along(bar.value), middle + 7)];
            area.draw(&Rectangle::new(corners, BAR.filled()))?;
            area.draw(&PathElement::new(
                bar.interval.map(|value| (along(value), middle)),
                BLACK,
            ))?;
        }
        self.draw_map(&area, bottom + ROW + GAP)?;
        Ok(area.present()?)
    }
}

/// The place of a value on the bars' axis.
fn along(value: f64) -> i32 {
    NAMES + (f64::from(WIDTH - NAMES - NOTES) * value.clamp(0.0, MOST) / MOST) as i32
}

impl BarChart {
    fn draw_map(
        &self,
        area: &DrawingArea<impl DrawingBackend<ErrorType: 'static>, Shift>,
        top: i32,
    ) -> Result<()> {
        let width = (WIDTH - NAMES - NOTES) / self.columns.len() as i32;
        let left = |column: i32| NAMES + width * column;
        for (name, column) in self.columns.iter().zip(0..) {
            draw_text(
                area,
                name,
                (left(column) + width / 2, top + CELL / 2),
                (HPos::Center, 13, BLACK),
            )?;
        }
        for ((name, cells), row) in self.rows.iter().zip(&self.cells).zip(1..) {
            let upper = top + CELL * row;
            let middle = upper + CELL / 2;
            draw_text(area, name, (NAMES - 8, middle), (HPos::Right, 13, BLACK))?;
            for (&value, column) in cells.iter().zip(0..) {
                let share = if value.is_nan() {
                    0.0
                } else {
                    value.clamp(0.0, 1.0)
                };
                let corners = [
                    (left(column), upper),
                    (left(column + 1) - 2, upper + CELL - 2),
                ];
                area.draw(&Rectangle::new(corners, blended(share).filled()))?;
                let colour = if share > 0.6 { WHITE } else { BLACK };
                draw_text(
                    area,
                    &number(value, 2),
                    (left(column) + width / 2, middle),
                    (HPos::Center, 13, colour),
                )?;
            }
        }
        Ok(())
    }
}

/// The colour for a value from 0 (grey) to 1 (the colour of the bars).
fn blended(share: f64) -> RGBColor {
    let mix = |from: u8, to: u8| (f64::from(from) * (1.0 - share) + f64::from(to) * share) as u8;
    RGBColor(mix(240, BAR.0), mix(240, BAR.1), mix(240, BAR.2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::PictureFile;
    use crate::os::Destination;

    fn svg(chart: &BarChart) -> String {
        let place = tempfile::tempdir().unwrap();
        let to = Destination {
            ending: "svg",
            path: place.path().join("bars.svg"),
        };
        chart.write(PictureFile::create(&to).unwrap()).unwrap();
        crate::os::read_text(&to.path).unwrap()
    }

    #[test]
    fn a_bar_is_as_long_as_its_value_and_unknown_ones_are_drawn_too() {
        let bar = |name: &str, value: f64| NamedBar {
            name: name.into(),
            value,
            interval: [value - 0.1, value + 0.1],
            note: "some".into(),
        };
        let bars = vec![
            bar("whole", 1.0),
            bar("half", 0.5),
            bar("unknown", f64::NAN),
        ];
        let svg = svg(&BarChart {
            title: "title".into(),
            bars,
            columns: vec!["a".into()],
            rows: vec!["b".into()],
            cells: vec![vec![0.5]],
        });
        let colour = format!("fill=\"#{:02X}{:02X}{:02X}\"", BAR.0, BAR.1, BAR.2);
        let width = |line: &str| {
            line.split("width=\"")
                .nth(1)
                .unwrap()
                .split('"')
                .next()
                .unwrap()
                .parse::<f64>()
                .unwrap()
        };
        let widths: Vec<f64> = svg
            .lines()
            .filter(|line| line.starts_with("<rect") && line.contains(&colour))
            .map(width)
            .collect();
        assert_eq!(widths.len(), 3, "{svg}");
        assert!(
            (widths[0] - 2.0 * widths[1]).abs() <= 2.0 && widths[2] <= 1.0,
            "{widths:?}"
        );
        for text in ["whole", "unknown", "0.50", "title"] {
            assert!(svg.contains(text), "{text}");
        }
    }

    #[test]
    fn no_character_that_xml_does_not_allow_is_drawn() {
        let odd = || "a\u{1}\u{ffff}<".to_owned();
        let bars = vec![NamedBar {
            name: odd(),
            value: 1.0,
            interval: [1.0; 2],
            note: odd(),
        }];
        let cells = vec![vec![0.5]];
        let svg = svg(&BarChart {
            title: odd(),
            bars,
            columns: vec![odd()],
            rows: vec![odd()],
            cells,
        });
        assert_eq!(svg.matches("a\u{fffd}\u{fffd}&lt;").count(), 5, "{svg}");
    }
}
