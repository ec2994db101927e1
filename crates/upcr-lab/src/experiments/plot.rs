//! Results as pictures: a row of marks for each method, or a line over growing disturbance.

use std::error::Error;
use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::element::{Drawable, PointCollection};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters_backend::{BackendCoord, DrawingErrorKind};

use super::description::{Plot, PlotKind};
use super::report::{Spread, heading};
use super::reproduce::Outcome;
use crate::drawing::{CAPTION, COLORS, Drawn, LETTERS, Picture, font};

/// The experiment's picture; `None` where it has none, or nothing above zero was measured.
pub fn picture(outcome: &Outcome) -> Option<impl Picture + '_> {
    let plot = outcome.experiment.plot.as_ref()?;
    Some(Drawing::new(outcome, plot)).filter(|drawing| drawing.range().1 > 0.0)
}

/// What a mark stands for: a name, the mark's index, and whether it is hollow.
type Entry = (String, usize, bool);

/// What drawing marks ends with: what they stand for.
type WithKey = Result<Vec<Entry>, Box<dyn Error>>;

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
const WIDTH: u32 = 980;
const LINES_HEIGHT: u32 = 460;
const KEY: u32 = 170;
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

    /// Over a logarithmic axis, where values differ tenfold.
    fn dots<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> WithKey
    where
        B::ErrorType: 'static,
    {
        // A method may be right to the last bit: what is below a share of the largest is drawn at it.
        let (low, high) = self.range();
        let low = low.clamp(high * SMALLEST, high);
        if high > 10.0 * low {
            self.dots_over(area, unit, (low * 0.7..high * 1.4).log_scale(), low * 0.7..high * 1.4)
        } else {
            self.dots_over(area, unit, 0.0..high * 1.1, 0.0..high * 1.1)
        }
    }

    fn dots_over<B: DrawingBackend, X: AsRangedCoord<Value = f64>>(
        &self,
        area: &DrawingArea<B, Shift>,
        unit: u32,
        axis: X,
        Range { start, end }: Range<f64>,
    ) -> WithKey
    where
        B::ErrorType: 'static,
        X::CoordDescType: ValueFormatter<f64>,
    {
        let count = self.methods.len();
        let letters = font(LETTERS, unit);
        let mut key = Vec::new();
        let mut chart = ChartBuilder::on(area)
            .caption(&self.outcome.experiment.title, font(CAPTION, unit))
            .margin(12 * unit)
            .x_label_area_size(40 * unit)
            .y_label_area_size(230 * unit)
            .build_cartesian_2d(axis, -0.5..count as f64 - 0.5)?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .disable_y_axis()
            .label_style(letters)
            .x_desc(heading(&self.plot.measure))
            .x_label_formatter(&short)
            .bold_line_style(BLACK.mix(0.15))
            .light_line_style(BLACK.mix(0.06))
            .y_labels(0)
            .draw()?;
        let row = |method: usize| (count - 1 - method) as f64;
        // Names stand left of the axis, where the mesh has none.
        let style = TextStyle::from(letters.into_font()).pos(Pos::new(HPos::Right, VPos::Center));
        for (index, name) in self.methods.iter().enumerate() {
            let (x, y) = chart.backend_coord(&(start, row(index)));
            area.draw(&Text::new(plain(name), (x - 8 * unit as i32, y), style.clone()))?;
            chart.draw_series([PathElement::new(
                [(start, row(index)), (end, row(index))],
                BLACK.mix(0.08).stroke_width(unit),
            )])?;
        }
        let sets = self.settings.len() as f64;
        for (index, (setting, _)) in self.settings.iter().enumerate() {
            let color = color(index);
            // Settings side by side, the first on top.
            let shift = if sets > 1.0 { 0.22 - 0.44 * index as f64 / (sets - 1.0) } else { 0.0 };
            let at = |mark: &Mark, value: f64| (value.clamp(start, end), row(mark.method) + shift);
            let of_setting = |of_paper: bool| {
                self.marks.iter().filter(move |mark| mark.setting == index && mark.of_paper == of_paper)
            };
            chart.draw_series(of_setting(false).map(|mark| {
                let (from, to) = (mark.value.mean - deviation(mark), mark.value.mean + deviation(mark));
                PathElement::new([at(mark, from), at(mark, to)], color.stroke_width(2 * unit))
            }))?;
            for of_paper in [false, true] {
                let marks = of_setting(of_paper)
                    .map(|mark| mark_at(at(mark, mark.value.mean), index, of_paper, unit));
                chart.draw_series(marks)?;
                if of_setting(of_paper).next().is_some() {
                    let name = if of_paper { format!("{setting}, paper") } else { (*setting).to_owned() };
                    key.push((name, index, of_paper));
                }
            }
        }
        Ok(key)
    }

    fn lines<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> WithKey
    where
        B::ErrorType: 'static,
    {
        let (_, high) = self.range();
        let last = self.settings.iter().map(|(_, x)| *x).fold(0.01, f64::max);
        let letters = font(LETTERS, unit);
        let mut key = Vec::new();
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
            .x_label_formatter(&short)
            .y_label_formatter(&short)
            .x_desc("outliers, % of each cloud's points")
            .y_desc(heading(&self.plot.measure))
            .draw()?;
        for (index, name) in self.methods.iter().enumerate() {
            let color = color(index);
            let points: Vec<(f64, f64)> = (self.marks.iter())
                .filter(|mark| mark.method == index && !mark.of_paper)
                .map(|mark| (self.settings[mark.setting].1 * 100.0, mark.value.mean))
                .collect();
            chart.draw_series(LineSeries::new(points.clone(), color.stroke_width(2 * unit)))?;
            chart.draw_series(points.into_iter().map(|at| mark_at(at, index, false, unit)))?;
            key.push((plain(name), index, false));
        }
        Ok(key)
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
        let (area, beside) = area.split_horizontally((WIDTH - KEY) * unit);
        let key = match self.plot.kind {
            PlotKind::Dots => self.dots(&area, unit)?,
            PlotKind::Lines => self.lines(&area, unit)?,
        };
        draw_key(&beside, key, unit)
    }
}

/// A name without the marks of code that it has in tables.
fn plain(name: &str) -> String {
    name.replace('`', "")
}

/// A number without needless digits.
#[allow(clippy::trivially_copy_pass_by_ref)] // As plotters asks for it.
fn short(value: &f64) -> String {
    format!("{}", (value * 1e6).round() / 1e6)
}

/// What marks mean, one below the other.
fn draw_key<B: DrawingBackend>(area: &DrawingArea<B, Shift>, key: Vec<Entry>, unit: u32) -> Drawn
where
    B::ErrorType: 'static,
{
    let style = TextStyle::from(font(LETTERS, unit).into_font()).pos(Pos::new(HPos::Left, VPos::Center));
    for (line, (name, index, of_paper)) in key.into_iter().enumerate() {
        let (x, y) = (8 * unit as i32, (52 + 20 * line as i32) * unit as i32);
        area.draw(&mark_at((x, y), index, of_paper, unit))?;
        area.draw(&Text::new(name, (x + 14 * unit as i32, y), style.clone()))?;
    }
    Ok(())
}

fn deviation(mark: &Mark) -> f64 {
    mark.value.deviation.unwrap_or(0.0)
}

/// A mark whose form tells what its colour does: circle, square, triangle, diamond, and these again; hollow for the
/// paper's.
struct Symbol<C> {
    at: C,
    index: usize,
    hollow: bool,
    unit: u32,
}

fn mark_at<C>(at: C, index: usize, hollow: bool, unit: u32) -> Symbol<C> {
    Symbol { at, index, hollow, unit }
}

/// The colour of a setting or a method, by its index.
fn color(index: usize) -> RGBColor {
    COLORS[index % COLORS.len()]
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
        let style = color(self.index).stroke_width(self.unit);
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
