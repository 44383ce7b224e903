//! A chart with curves in panels, one above the other, and a legend above them: SVG, or PNG with the feature `video`.

use std::iter;

use anyhow::{Context, Result, ensure};
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::element::DashedPathElement;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::os::{Destination, OutputFile};

/// Curves of one quantity.
pub struct Subplot {
    /// What the quantity is.
    pub title: String,
    /// Curves, at the places of their names in the legend.
    pub curves: Vec<Curve>,
    /// Curves without names. They are grey and lie behind the others.
    pub behind: Vec<Curve>,
    /// The word that is shown if no curve has a point.
    pub nothing: &'static str,
}

/// A line through points.
#[derive(Default)]
pub struct Curve {
    /// Points (x, y), in ascending order of x. A single one is drawn as a dot.
    pub points: Vec<[f64; 2]>,
    /// For each point, the lowest and the highest value of a band around it. Empty without a band.
    pub band: Vec<[f64; 2]>,
    /// Whether each point has a dot.
    pub dots: bool,
}

/// Panels with a shared x axis.
pub struct Chart {
    /// The names of the curves, in the order that all panels have them.
    pub legend: Vec<String>,
    /// The label of the x axis.
    pub along: &'static str,
    /// Panels, from top to bottom.
    pub panels: Vec<Subplot>,
    /// Width and height in pixels. By default 800 wide, and as high as the legend plus 260 for each panel.
    pub size: Option<[u32; 2]>,
}

/// The colour of the grid. Opaque, since not every SVG viewer supports opacity.
pub const GRID: RGBColor = RGBColor(225, 225, 225);

/// The colour of curves without names.
const BEHIND: RGBColor = RGBColor(180, 180, 180);

/// Colours of the curves, distinguishable with red-green colour blindness: M. Okabe, K. Ito, "Color universal design" (2008).
pub const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

/// The extent of the y axis below which its labels have an exponent. Others have five decimals.
const SMALL: f64 = 1e-4;

/// Pixels between two dashes.
const GAP: i32 = 3;

/// The colour and dash length (pixels) of each curve in turn. Once all colours are used, they repeat with dashes.
fn styles() -> impl Iterator<Item = (ShapeStyle, i32)> {
    let dashes = iter::once(i32::MAX).chain((1..).map(|round| 5 * round));
    dashes.flat_map(|dash| {
        COLOURS
            .iter()
            .map(move |colour| (colour.stroke_width(2), dash))
    })
}

/// A picture that is drawn in the same way in each format.
pub trait Picture {
    /// Its width and height in pixels.
    ///
    /// # Errors
    /// Fails if the picture is too small for what it shows.
    fn size(&self) -> Result<[u32; 2]>;

    /// Draws it.
    ///
    /// # Errors
    /// Fails if the font cannot be used.
    fn draw(&self, area: DrawingArea<impl DrawingBackend<ErrorType: 'static>, Shift>)
    -> Result<()>;

    /// Writes the picture.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or as [`Picture::size`] does.
    fn write(&self, PictureFile { output, ending }: PictureFile) -> Result<()> {
        // With the feature `video`, text is measured for SVG too, which needs the font. A second call has no effect.
        #[cfg(feature = "video")]
        let _ = plotters::style::register_font(
            "sans-serif",
            FontStyle::Normal,
            epaint_default_fonts::UBUNTU_LIGHT,
        );
        let [width, height] = self.size()?;
        match ending {
            #[cfg(feature = "video")]
            "png" => {
                let mut rgb = vec![0; 3 * width as usize * height as usize];
                let area =
                    BitMapBackend::with_buffer(&mut rgb, (width, height)).into_drawing_area();
                self.draw(area).context("cannot draw the chart")?;
                super::film::write_png(output, [width, height], &rgb)
            }
            _ => {
                let mut text = String::new();
                let area = SVGBackend::with_string(&mut text, (width, height)).into_drawing_area();
                self.draw(area).context("cannot draw the chart")?;
                output.finish(text.as_bytes())
            }
        }
    }
}

/// The file of a picture that is drawn later.
pub struct PictureFile {
    /// The file.
    pub output: OutputFile,
    ending: &'static str,
}

impl PictureFile {
    /// Opens the file.
    ///
    /// # Errors
    /// Fails for a PNG without the feature `video`, or if the file cannot be written to.
    pub fn create(to: &Destination) -> Result<Self> {
        ensure!(
            to.ending != "png" || cfg!(feature = "video"),
            "{}: PNG needs the cargo feature `video`; .svg does not",
            to.path.display()
        );
        Ok(Self {
            output: OutputFile::create(&to.path)?,
            ending: to.ending,
        })
    }
}

/// Draws text in the middle of a line at this height.
pub fn draw_text(
    area: &DrawingArea<impl DrawingBackend<ErrorType: 'static>, Shift>,
    text: &str,
    at: (i32, i32),
    (across, size, colour): (HPos, i32, RGBColor),
) -> Result<()> {
    let style = ("sans-serif", size)
        .into_font()
        .color(&colour)
        .pos(Pos::new(across, VPos::Center));
    Ok(area.draw(&Text::new(printable(text), at, style))?)
}

/// A text without the characters that XML does not allow.
fn printable(text: &str) -> String {
    let forbidden = |c: char| c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}');
    text.replace(forbidden, "\u{fffd}")
}

impl Picture for Chart {
    fn size(&self) -> Result<[u32; 2]> {
        let panels = self.panels.len() as u32;
        let legend = |width| legend_height(&self.legend_rows(width));
        let [width, height] = self
            .size
            .unwrap_or_else(|| [WIDTH, legend(WIDTH) + PANEL * panels]);
        ensure!(
            legend(width) + LEAST_PANEL * panels <= height,
            "{panels} panels and the names of {} curves do not fit into {height} pixels",
            self.legend.len(),
        );
        Ok([width, height])
    }

    fn draw(
        &self,
        area: DrawingArea<impl DrawingBackend<ErrorType: 'static>, Shift>,
    ) -> Result<()> {
        area.fill(&WHITE)?;
        let rows = self.legend_rows(area.dim_in_pixel().0);
        let (top, below) = area.split_vertically(legend_height(&rows));
        for (row, i) in rows.into_iter().zip(0..) {
            let y = (MARGIN + ROW * i + ROW / 2) as i32;
            for (name, (colour, dash), left) in row {
                top.draw(&DashedPathElement::new(
                    [(left, y), (left + LINE, y)],
                    dash,
                    GAP,
                    colour,
                ))?;
                draw_text(
                    &top,
                    name,
                    (left + LINE + MARGIN as i32, y),
                    (HPos::Left, LABEL, BLACK),
                )?;
            }
        }
        let curves = self.panels.iter().flat_map(Subplot::all);
        let x = range(curves.flat_map(Curve::along));
        let count = self.panels.len();
        let parts = below.split_evenly((count, 1));
        for ((panel, part), number) in self.panels.iter().zip(parts).zip(1..) {
            let along = (number == count).then_some(self.along);
            panel.draw(&part, x.clone(), along)?;
        }
        Ok(area.present()?)
    }
}

/// The default width of a chart in pixels.
const WIDTH: u32 = 800;

/// The default height of a panel in pixels.
const PANEL: u32 = 260;

// Lengths in the legend in pixels: the height of a row, the margins, the length of a line, the space after a name.
const ROW: u32 = 20;
const MARGIN: u32 = 6;
const LINE: i32 = 24;
const SPACE: i32 = 20;

/// The smallest height of a panel in pixels.
const LEAST_PANEL: u32 = 100;

/// The radius of a dot in pixels.
const DOT: i32 = 3;

/// The names in one row of a legend, each with its style and the place of its line.
type LegendRow<'a> = Vec<(&'a str, (ShapeStyle, i32), i32)>;

/// The size of the text of labels.
const LABEL: i32 = 13;

impl Chart {
    /// Arranges the names in rows of a chart of this width.
    fn legend_rows(&self, width: u32) -> Vec<LegendRow<'_>> {
        let margin = 2 * MARGIN as i32;
        let mut rows = vec![Vec::new()];
        let mut left = margin;
        for (name, style) in self.legend.iter().zip(styles()) {
            // Without a font, the width of a letter is a guess.
            let text = ("sans-serif", LABEL)
                .into_font()
                .box_size(name)
                .map_or(7 * name.len() as u32, |(width, _)| width);
            let length = LINE + MARGIN as i32 + text as i32 + SPACE;
            if left > margin && left + length - SPACE > width as i32 {
                rows.push(Vec::new());
                left = margin;
            }
            rows.last_mut()
                .expect("there is a row")
                .push((&name[..], style, left));
            left += length;
        }
        rows
    }
}

fn legend_height(rows: &[LegendRow]) -> u32 {
    ROW * rows.len() as u32 + 2 * MARGIN
}

impl Subplot {
    /// All curves, in the order in which they are drawn.
    fn all(&self) -> impl Iterator<Item = &Curve> {
        self.behind.iter().chain(&self.curves)
    }

    /// Draws the panel into `part`, with a label of the x axis if it is the last.
    fn draw(
        &self,
        part: &DrawingArea<impl DrawingBackend<ErrorType: 'static>, Shift>,
        x: std::ops::Range<f64>,
        along: Option<&str>,
    ) -> Result<()> {
        let y = range(self.all().flat_map(Curve::values));
        let extent = y.end - y.start;
        let mut chart = ChartBuilder::on(part)
            .caption(printable(&self.title), ("sans-serif", 17))
            .margin(8)
            .x_label_area_size(if along.is_some() { 46 } else { 24 })
            .y_label_area_size(56)
            .build_cartesian_2d(x, y)?;
        let mut mesh = chart.configure_mesh();
        mesh.max_light_lines(0)
            .bold_line_style(GRID)
            .label_style(("sans-serif", LABEL));
        let small = |value: &f64| {
            if value.abs() < 1e-6 * extent {
                "0".to_owned()
            } else {
                format!("{value:.1e}")
            }
        };
        if extent < SMALL {
            mesh.y_label_formatter(&small);
        }
        if let Some(along) = along {
            mesh.x_desc(along);
        }
        mesh.draw()?;
        let unnamed = iter::repeat_n((BEHIND.stroke_width(2), i32::MAX), self.behind.len());
        for (curve, style) in self.all().zip(unnamed.chain(styles())) {
            curve.draw(&mut chart, style)?;
        }
        if self.all().all(|curve| curve.points.is_empty()) {
            let (width, height) = part.dim_in_pixel();
            draw_text(
                part,
                self.nothing,
                (width as i32 / 2, height as i32 / 2),
                (HPos::Center, 15, BLACK),
            )?;
        }
        Ok(())
    }
}

impl Curve {
    fn along(&self) -> impl Iterator<Item = f64> {
        self.points.iter().map(|[x, _]| *x)
    }

    /// All values, including the band.
    fn values(&self) -> impl Iterator<Item = f64> {
        self.points
            .iter()
            .map(|[_, y]| *y)
            .chain(self.band.iter().flatten().copied())
    }

    fn draw(
        &self,
        chart: &mut ChartContext<
            impl DrawingBackend<ErrorType: 'static>,
            Cartesian2d<RangedCoordf64, RangedCoordf64>,
        >,
        (colour, dash): (ShapeStyle, i32),
    ) -> Result<()> {
        let points = || self.points.iter().map(|&[x, y]| (x, y));
        if !self.band.is_empty() {
            let corners = self.points.iter().zip(&self.band);
            let lower = corners.clone().map(|([x, _], [low, _])| (*x, *low));
            let upper = corners.map(|([x, _], [_, high])| (*x, *high));
            let outline: Vec<_> = lower.chain(upper.rev()).collect();
            // Opaque and below the line, since not every SVG viewer supports opacity.
            let (red, green, blue) = colour.color.rgb();
            let pale = |channel: u8| 255 - (255 - channel) / 4;
            let pale = RGBColor(pale(red), pale(green), pale(blue));
            chart.draw_series([Polygon::new(outline, pale.filled())])?;
        }
        chart.draw_series(DashedLineSeries::new(points(), dash, GAP, colour))?;
        if self.dots || self.points.len() == 1 {
            chart.draw_series(points().map(|point| Circle::new(point, DOT, colour.filled())))?;
        }
        Ok(())
    }
}

/// The range of the values and zero, with a margin at the top. It is never empty.
fn range(values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
    let (low, high) = values.fold((0.0_f64, 0.0_f64), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    if low < high {
        low..high + 0.05 * (high - low)
    } else {
        0.0..1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(title: &str, curves: Vec<Curve>) -> Subplot {
        Subplot {
            title: title.into(),
            curves,
            behind: Vec::new(),
            nothing: "nothing yet",
        }
    }

    fn line(points: &[[f64; 2]]) -> Curve {
        Curve {
            points: points.to_vec(),
            ..Curve::default()
        }
    }

    fn svg(panels: Vec<Subplot>) -> String {
        let curves = panels.iter().map(|panel| panel.curves.len()).max().unwrap();
        let legend = (1..=curves).map(|i| format!("run {i}")).collect();
        let chart = Chart {
            legend,
            along: "steps",
            panels,
            size: None,
        };
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("chart.svg");
        let to = Destination {
            ending: "svg",
            path: path.clone(),
        };
        chart.write(PictureFile::create(&to).unwrap()).unwrap();
        crate::os::read_text(&path).unwrap()
    }

    #[test]
    fn every_curve_is_drawn_in_a_way_of_its_own() {
        let curve = |i| line(&[[0.0, f64::from(i)], [1.0, f64::from(i)]]);
        let svg = svg(vec![panel("a", (1..=8).map(curve).collect())]);
        // The first and the eighth share a colour: two solid lines, one of them in the legend, and the eighth's dashes.
        let lines = |colour: RGBColor| {
            let stroke = format!(
                "stroke=\"#{:02X}{:02X}{:02X}\"",
                colour.0, colour.1, colour.2
            );
            svg.lines()
                .filter(|line| line.starts_with("<polyline") && line.contains(&stroke))
                .count()
        };
        assert_eq!(lines(COLOURS[1]), 2, "{svg}");
        assert!(lines(COLOURS[0]) > 20, "{svg}");
    }

    #[test]
    fn an_axis_of_very_small_values_has_labels_that_differ() {
        for (low, labels) in [
            (0.0, ["0", "5.0e-7", "1.5e-6", "3.0e-6"]),
            (-1.3e-5, ["0", "2.0e-6", "-2.0e-6", "-1.2e-5"]),
        ] {
            let svg = svg(vec![panel("a", vec![line(&[[0.0, low], [1.0, 3e-6]])])]);
            assert!(
                labels
                    .iter()
                    .all(|label| svg.lines().any(|line| line.trim() == *label)),
                "{svg}"
            );
        }
    }

    #[test]
    fn all_panels_have_the_same_axis() {
        let until = |end| vec![line(&[[1.0, 0.5], [end, 0.7]])];
        let svg = svg(vec![panel("a", until(5.0)), panel("b", until(20.0))]);
        assert_eq!(
            svg.lines().filter(|line| line.trim() == "20.0").count(),
            2,
            "{svg}"
        );
    }

    #[test]
    fn the_legend_lies_above_all_panels() {
        let long = |i: usize| line(&[[0.0, 0.0], [1.0, i as f64]]);
        let svg = svg(vec![panel("the panel", (1..=30).map(long).collect())]);
        let height = |text: &str| {
            let lines: Vec<&str> = svg.lines().collect();
            let place = lines
                .iter()
                .position(|line| line.trim() == text)
                .expect(text);
            let tag = lines[..place]
                .iter()
                .rfind(|line| line.starts_with("<text"))
                .unwrap();
            tag.split(" y=\"")
                .nth(1)
                .unwrap()
                .split('"')
                .next()
                .unwrap()
                .parse::<i32>()
                .unwrap()
        };
        assert!(height("run 1") < height("run 30"), "several rows");
        assert!(height("run 30") < height("the panel"), "{svg}");
    }

    #[test]
    fn a_single_point_is_a_dot_a_band_is_a_surface_and_an_empty_panel_says_so() {
        let band = Curve {
            points: vec![[1.0, 0.5], [2.0, 0.5]],
            band: vec![[0.2, 0.9]; 2],
            dots: false,
        };
        let svg = svg(vec![
            panel("dot", vec![line(&[[1.0, 0.5]])]),
            panel("band", vec![band]),
            panel("none", vec![]),
        ]);
        for (part, count) in [("<circle", 1), ("<polygon", 1), ("\nnothing yet", 1)] {
            assert_eq!(svg.matches(part).count(), count, "{part}: {svg}");
        }
    }
}
