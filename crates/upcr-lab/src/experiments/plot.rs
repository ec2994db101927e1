//! Results as pictures: a row of marks for each method, or a line over growing disturbance.

use plotters::coord::Shift;
use plotters::element::{Drawable, PointCollection};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters_backend::{BackendCoord, DrawingErrorKind};

use super::description::{Plot, PlotKind};
use super::report::{Spread, heading};
use super::reproduce::Outcome;
use crate::drawing::{CAPTION, COLORS, Drawn, LETTERS, Picture, font, legend};

/// The experiment's picture; `None` where it has none, or nothing above zero was measured.
pub fn picture(outcome: &Outcome) -> Option<impl Picture + '_> {
    let plot = outcome.experiment.plot.as_ref()?;
    Some(Drawing::new(outcome, plot)).filter(|drawing| drawing.range().1 > 0.0)
}

/// A measured value, or one of the paper's.
struct Mark {
    /// Its row or its line, by index.
    method: usize,
    /// Its colour and form, by index.
    setting: usize,
    value: Spread,
    of_paper: bool,
}

struct Drawing<'a> {
    outcome: &'a Outcome,
    plot: &'a Plot,
    methods: Vec<&'a str>,
    settings: Vec<(&'a str, f64)>,
    marks: Vec<Mark>,
}

/// Heights of a row and of all else, and widths, in units.
const ROW: u32 = 26;
const FRAME: u32 = 110;
const WIDTH: u32 = 860;
const LINES_HEIGHT: u32 = 460;
/// Share of the largest value down to which a logarithmic axis reaches.
const SMALLEST: f64 = 2e-4;

impl<'a> Drawing<'a> {
    fn new(outcome: &'a Outcome, plot: &'a Plot) -> Self {
        let experiment = &outcome.experiment;
        let shown = |name: &String| plot.settings.is_empty() || plot.settings.contains(name);
        let settings: Vec<(&str, f64)> = (experiment.settings.iter())
            .filter(|setting| shown(&setting.name))
            .map(|setting| (setting.name.as_str(), setting.outliers))
            .collect();
        let mut drawing = Self { outcome, plot, methods: Vec::new(), settings, marks: Vec::new() };
        for method in &experiment.methods {
            let mut marks = Vec::new();
            for (index, (setting, _)) in drawing.settings.iter().enumerate() {
                let at =
                    |value, of_paper| Mark { method: drawing.methods.len(), setting: index, value, of_paper };
                let ours = outcome.spread(setting, &method.name, &plot.measure);
                let theirs = method.paper.get(*setting).and_then(|values| values.get(&plot.measure));
                marks.extend(ours.map(|value| at(value, false)));
                marks.extend(theirs.map(|&mean| at(Spread { mean, deviation: None }, true)));
            }
            if marks.iter().any(|mark| !mark.of_paper) {
                drawing.methods.push(&method.name);
                drawing.marks.extend(marks);
            }
        }
        drawing
    }

    /// Smallest and largest value, deviations included.
    fn range(&self) -> (f64, f64) {
        let ends = self
            .marks
            .iter()
            .flat_map(|mark| [mark.value.mean - deviation(mark), mark.value.mean + deviation(mark)]);
        let (low, high) = ends.fold((f64::INFINITY, 0.0), |(low, high): (f64, f64), v| {
            (if v > 0.0 { low.min(v) } else { low }, high.max(v))
        });
        (low, high)
    }

    fn dots<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> Drawn
    where
        B::ErrorType: 'static,
    {
        let count = self.methods.len();
        // A method may be right to the last bit: what is below a share of the largest is drawn at it.
        let (low, high) = self.range();
        let low = low.clamp(high * SMALLEST, high);
        let letters = font(LETTERS, unit);
        let mut chart = ChartBuilder::on(area)
            .caption(&self.outcome.experiment.title, font(CAPTION, unit))
            .margin(12 * unit)
            .x_label_area_size(40 * unit)
            .y_label_area_size(230 * unit)
            .build_cartesian_2d((low * 0.7..high * 1.4).log_scale(), -0.5..count as f64 - 0.5)?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .disable_y_axis()
            .label_style(letters)
            .x_desc(heading(&self.plot.measure))
            .x_label_formatter(&|v| format!("{v}"))
            .bold_line_style(BLACK.mix(0.15))
            .light_line_style(BLACK.mix(0.06))
            .y_labels(0)
            .draw()?;
        let row = |method: usize| (count - 1 - method) as f64;
        // Names stand left of the axis, where the mesh has none.
        let style = TextStyle::from(letters.into_font()).pos(Pos::new(HPos::Right, VPos::Center));
        for (index, name) in self.methods.iter().enumerate() {
            let (x, y) = chart.backend_coord(&(low * 0.7, row(index)));
            area.draw(&Text::new((*name).to_owned(), (x - 8 * unit as i32, y), style.clone()))?;
            chart.draw_series([PathElement::new(
                [(low * 0.7, row(index)), (high * 1.4, row(index))],
                BLACK.mix(0.08).stroke_width(unit),
            )])?;
        }
        let sets = self.settings.len() as f64;
        for (index, (setting, _)) in self.settings.iter().enumerate() {
            let color = COLORS[index % COLORS.len()];
            // Settings side by side, the first on top.
            let shift = if sets > 1.0 { 0.22 - 0.44 * index as f64 / (sets - 1.0) } else { 0.0 };
            let at = |mark: &Mark, value: f64| (value.max(low), row(mark.method) + shift);
            let of_setting = |of_paper: bool| {
                self.marks.iter().filter(move |mark| mark.setting == index && mark.of_paper == of_paper)
            };
            chart.draw_series(of_setting(false).map(|mark| {
                let (from, to) = (mark.value.mean - deviation(mark), mark.value.mean + deviation(mark));
                PathElement::new([at(mark, from), at(mark, to)], color.stroke_width(2 * unit))
            }))?;
            for of_paper in [false, true] {
                let marks = of_setting(of_paper)
                    .map(|mark| mark_at(at(mark, mark.value.mean), index, color, of_paper, unit));
                let series = chart.draw_series(marks)?;
                let name = if of_paper { format!("{setting}, paper") } else { (*setting).to_owned() };
                if of_setting(of_paper).next().is_some() {
                    series.label(name).legend(move |(x, y)| {
                        mark_at((x + 8 * unit as i32, y), index, color, of_paper, unit)
                    });
                }
            }
        }
        legend(&mut chart, SeriesLabelPosition::UpperRight, unit)
    }

    fn lines<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> Drawn
    where
        B::ErrorType: 'static,
    {
        let (_, high) = self.range();
        let last = self.settings.iter().map(|(_, x)| *x).fold(0.01, f64::max);
        let letters = font(LETTERS, unit);
        let mut chart = ChartBuilder::on(area)
            .caption(&self.outcome.experiment.title, font(CAPTION, unit))
            .margin(12 * unit)
            .x_label_area_size(40 * unit)
            .y_label_area_size(56 * unit)
            .build_cartesian_2d(0.0..last * 100.0, 0.0..high * 1.1)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .label_style(letters)
            .x_desc("outliers, % of each cloud's points")
            .y_desc(heading(&self.plot.measure))
            .draw()?;
        for (index, name) in self.methods.iter().enumerate() {
            let color = COLORS[index % COLORS.len()];
            let points: Vec<(f64, f64)> = (self.marks.iter())
                .filter(|mark| mark.method == index && !mark.of_paper)
                .map(|mark| (self.settings[mark.setting].1 * 100.0, mark.value.mean))
                .collect();
            chart.draw_series(LineSeries::new(points.clone(), color.stroke_width(2 * unit)))?;
            chart
                .draw_series(points.into_iter().map(|at| mark_at(at, index, color, false, unit)))?
                .label(*name)
                .legend(move |(x, y)| mark_at((x + 8 * unit as i32, y), index, color, false, unit));
        }
        legend(&mut chart, SeriesLabelPosition::UpperLeft, unit)
    }
}

impl Picture for Drawing<'_> {
    fn size(&self) -> (u32, u32) {
        match self.plot.kind {
            PlotKind::Dots => (WIDTH, FRAME + ROW * self.methods.len() as u32),
            PlotKind::Lines => (WIDTH, LINES_HEIGHT),
        }
    }

    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> Drawn
    where
        B::ErrorType: 'static,
    {
        match self.plot.kind {
            PlotKind::Dots => self.dots(area, unit),
            PlotKind::Lines => self.lines(area, unit),
        }
    }
}

fn deviation(mark: &Mark) -> f64 {
    mark.value.deviation.unwrap_or(0.0)
}

/// A mark whose form tells what its colour does: circle, square, triangle, diamond, and these again; hollow for the
/// paper's.
struct Symbol<C> {
    at: C,
    index: usize,
    color: RGBColor,
    hollow: bool,
    unit: u32,
}

fn mark_at<C>(at: C, index: usize, color: RGBColor, hollow: bool, unit: u32) -> Symbol<C> {
    Symbol { at, index, color, hollow, unit }
}

impl<'a, C: 'a> PointCollection<'a, C> for &'a Symbol<C> {
    type Point = &'a C;
    type IntoIter = std::iter::Once<&'a C>;

    fn point_iter(self) -> Self::IntoIter {
        std::iter::once(&self.at)
    }
}

impl<C, B: DrawingBackend> Drawable<B> for Symbol<C> {
    fn draw<I: Iterator<Item = BackendCoord>>(
        &self,
        points: I,
        backend: &mut B,
        _: (u32, u32),
    ) -> std::result::Result<(), DrawingErrorKind<B::ErrorType>> {
        let r = 5 * self.unit as i32;
        let style = self.color.stroke_width(self.unit);
        for (x, y) in points {
            let corners: &[[i32; 2]] = match self.index % 4 {
                0 => {
                    backend.draw_circle((x, y), r as u32, &style, !self.hollow)?;
                    continue;
                }
                1 => &[[-r, -r], [r, -r], [r, r], [-r, r], [-r, -r]],
                2 => &[[0, -r], [r, r], [-r, r], [0, -r]],
                _ => &[[0, -r], [r, 0], [0, r], [-r, 0], [0, -r]],
            };
            let corners = corners.iter().map(|[dx, dy]| (x + dx, y + dy));
            if self.hollow {
                backend.draw_path(corners, &style)?;
            } else {
                backend.fill_polygon(corners, &style)?;
            }
        }
        Ok(())
    }
}
