//! A chart with curves in panels, one above the other: SVG, or PNG with the feature `video`.

use anyhow::{Result, anyhow, bail};
use plotters::coord::Shift;
use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::OutputFile;

/// Curves of one quantity.
pub struct Subplot {
    /// The name of the quantity.
    pub name: String,
    /// Curves, in legend order.
    pub curves: Vec<Curve>,
}

/// A line through points.
pub struct Curve {
    /// The name in the legend.
    pub name: String,
    /// Points (x, y), in ascending order of x.
    pub points: Vec<[f64; 2]>,
}

/// Panels with a shared x axis.
pub struct Chart {
    /// The label of the x axis.
    pub along: String,
    /// Panels, from top to bottom.
    pub panels: Vec<Subplot>,
    /// Width and height in pixels.
    pub size: [u32; 2],
}

/// The colour of the grid. Opaque, since not every SVG viewer supports opacity.
pub(super) const GRID: RGBColor = RGBColor(225, 225, 225);

/// Colours of the curves, distinguishable with red-green colour blindness: M. Okabe, K. Ito, "Color universal design" (2008).
pub(super) const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

/// Pixels between two dashes.
const GAP: i32 = 3;

/// Returns the colour and dash length (pixels) of each curve in turn. Once all colours are used, they repeat with dashes.
fn styles() -> impl Iterator<Item = (ShapeStyle, i32)> {
    let dashes = std::iter::once(i32::MAX).chain((1..).map(|round| 5 * round));
    dashes.flat_map(|dash| COLOURS.iter().map(move |colour| (colour.stroke_width(2), dash)))
}

/// A picture that is drawn in the same way in each format.
pub trait Picture {
    /// Returns its width and height in pixels.
    fn size(&self) -> [u32; 2];

    /// Draws it.
    ///
    /// # Errors
    /// Fails if the picture is too small for what it shows.
    fn draw<B: DrawingBackend>(&self, area: DrawingArea<B, Shift>) -> Result<()>;

    /// Writes the picture in the format given by the extension of its name.
    ///
    /// # Errors
    /// Fails for any other format than SVG and PNG, if the file cannot be written, or as [`Picture::draw`] does.
    fn write(&self, output: OutputFile) -> Result<()> {
        let [width, height] = self.size();
        #[cfg(feature = "video")]
        {
            // With this feature, text is measured for SVG too, which needs the font. Registering it twice has no effect.
            let _ = plotters::style::register_font("sans-serif", FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT);
        }
        let extension = output.path().extension().and_then(|extension| extension.to_str()).map(str::to_owned);
        match extension.as_deref() {
            Some("svg") => {
                let mut text = String::new();
                self.draw(SVGBackend::with_string(&mut text, (width, height)).into_drawing_area())?;
                output.finish(text.as_bytes())
            }
            #[cfg(feature = "video")]
            Some("png") => {
                let mut rgb = vec![0; 3 * width as usize * height as usize];
                self.draw(BitMapBackend::with_buffer(&mut rgb, (width, height)).into_drawing_area())?;
                super::write_png(output, self.size(), &rgb)
            }
            #[cfg(not(feature = "video"))]
            Some("png") => bail!("{}: PNG needs the cargo feature `video`; .svg does not", output.path().display()),
            _ => bail!("{}: the name of a chart must end in .svg or .png", output.path().display()),
        }
    }
}

impl Picture for Chart {
    fn size(&self) -> [u32; 2] {
        self.size
    }

    fn draw<B: DrawingBackend>(&self, area: DrawingArea<B, Shift>) -> Result<()> {
        let failed = |error: DrawingAreaErrorKind<B::ErrorType>| anyhow!("cannot draw the chart: {error}");
        area.fill(&WHITE).map_err(failed)?;
        let last = self.panels.len() - 1;
        let x = range(self.panels.iter().flat_map(|panel| panel.values(0)));
        for (i, (panel, part)) in self.panels.iter().zip(area.split_evenly((self.panels.len(), 1))).enumerate() {
            let y = range(panel.values(1));
            let mut chart = ChartBuilder::on(&part)
                .caption(&panel.name, ("sans-serif", 17))
                .margin(8)
                .x_label_area_size(if i == last { 46 } else { 24 })
                .y_label_area_size(56)
                .build_cartesian_2d(x.clone(), y)
                .map_err(failed)?;
            let mut mesh = chart.configure_mesh();
            mesh.max_light_lines(0).bold_line_style(GRID).label_style(("sans-serif", 13));
            if i == last {
                mesh.x_desc(&self.along);
            }
            mesh.draw().map_err(failed)?;
            for (curve, (colour, dash)) in panel.curves.iter().zip(styles()) {
                let points = curve.points.iter().map(|&[x, y]| (x, y));
                let line = DashedLineSeries::new(points, dash, GAP, colour);
                let drawn = chart.draw_series(line).map_err(failed)?;
                drawn
                    .label(&curve.name)
                    .legend(move |(x, y)| DashedPathElement::new([(x, y), (x + 24, y)], dash, GAP, colour));
            }
            if i == 0 {
                let mut legend = chart.configure_series_labels();
                legend.position(SeriesLabelPosition::UpperLeft).label_font(("sans-serif", 13));
                legend.background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.2)).draw().map_err(failed)?;
            }
        }
        area.present().map_err(failed)
    }
}

impl Subplot {
    /// Returns the coordinates of the points of all curves along an axis.
    fn values(&self, axis: usize) -> impl Iterator<Item = f64> {
        self.curves.iter().flat_map(|curve| &curve.points).map(move |point| point[axis])
    }
}

/// Returns the range of the values and zero, with a margin at the top; never empty.
fn range(values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
    let (low, high) = values.fold((0.0_f64, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
    if low < high { low..high + 0.05 * (high - low) } else { 0.0..1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_curve_is_drawn_in_a_way_of_its_own() {
        let curve = |i| Curve { name: format!("run {i}"), points: vec![[0.0, f64::from(i)], [1.0, f64::from(i)]] };
        let panel = Subplot { name: "a".into(), curves: (1..=8).map(curve).collect() };
        let chart = Chart { along: "steps".into(), panels: vec![panel], size: [600, 500] };
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("chart.svg");
        chart.write(OutputFile::create(&path).unwrap()).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        // The first and the eighth share a colour: two solid lines, one of them in the legend, and the eighth's dashes.
        let lines = |colour: RGBColor| {
            let stroke = format!("stroke=\"#{:02X}{:02X}{:02X}\"", colour.0, colour.1, colour.2);
            svg.lines().filter(|line| line.starts_with("<polyline") && line.contains(&stroke)).count()
        };
        assert_eq!(lines(COLOURS[1]), 2, "{svg}");
        assert!(lines(COLOURS[0]) > 20, "{svg}");
    }

    #[test]
    fn all_panels_have_the_same_axis() {
        let panel = |name: &str, end| Subplot {
            name: name.into(),
            curves: vec![Curve { name: "run".into(), points: vec![[1.0, 0.5], [end, 0.7]] }],
        };
        let chart = Chart { along: "steps".into(), panels: vec![panel("a", 5.0), panel("b", 20.0)], size: [600, 500] };
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("chart.svg");
        chart.write(OutputFile::create(&path).unwrap()).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        assert_eq!(svg.lines().filter(|line| line.trim() == "20.0").count(), 2, "{svg}");
    }
}
