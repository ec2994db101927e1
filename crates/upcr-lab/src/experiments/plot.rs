//! Results as pictures: a row of marks for each method, or a line over growing disturbance.

use super::description::{Plot, PlotKind};
use super::report::{Spread, heading};
use super::reproduce::Outcome;
use crate::drawing::{
    Anchor, Axis, Chart, Color, NAME, Picture, Point, STROKE, Sheet, key, key_height, mark, set_apart, title,
};

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

/// Lengths in units: from a setting's marks to the next, what a row has beside, the picture's width, the places of
/// panels.
const SETTING: f64 = 7.0;
const ROW: f64 = 12.0;
const WIDTH: f64 = 980.0;
const TOP: f64 = 64.0;
const BOTTOM: f64 = 34.0;
const BELOW: f64 = 20.0;
const NAMES: f64 = 220.0;
const NUMBERS: f64 = 52.0;
const BESIDE: f64 = 190.0;
const LINES: f64 = 380.0;
/// Where the name of the lowest value ends, in units from a panel's left.
const LOWEST: f64 = 60.0;
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

    /// Height of a row.
    fn row(&self) -> f64 {
        ROW + SETTING * self.settings.len().max(2) as f64
    }

    /// Over a logarithmic axis, where values differ tenfold.
    fn dots(&self, sheet: &mut Sheet) {
        // A method may be right to the last bit: what is below a share of the largest is drawn at it.
        let (low, high) = self.range();
        let least = low.clamp(high * SMALLEST, high);
        let x = if high > 10.0 * least {
            Axis::logarithmic(least * 0.9, high * 1.1)
        } else {
            Axis::linear(0.0, high)
        };
        let count = self.methods.len() as f64;
        let height = self.row();
        let size = (WIDTH - NAMES - BESIDE, height * count);
        let chart = Chart { corner: (NAMES, TOP), size, x, y: Axis::linear(0.0, 1.0) };
        chart.panel(sheet);
        chart.columns(sheet, &x.ticks());
        let mut named = x.ticks();
        if low < least {
            // Rounded up, so that it holds.
            let digit = 10f64.powi(least.log10().floor() as i32);
            chart.lowest(sheet, (least / digit).ceil() * digit);
            named.retain(|&tick| chart.at(tick, 0.0).0 > NAMES + LOWEST);
        }
        chart.below(sheet, &named, "");
        let row = |method: usize| TOP + height * (method as f64 + 0.5);
        for (index, name) in self.methods.iter().enumerate() {
            sheet.text((NAMES - 10.0, row(index)), plain(name), NAME, Anchor::End);
            if index > 0 {
                let y = row(index) - height / 2.0;
                sheet.rule((NAMES, y), (NAMES + size.0, y));
            }
        }
        let sets = self.settings.len() as f64;
        // Settings one below the other.
        let shift = |setting: usize| SETTING * (setting as f64 - (sets - 1.0) / 2.0);
        let at = |mark: &Mark, value: f64| (chart.at(value, 0.0).0, row(mark.method) + shift(mark.setting));
        for mark in &self.marks {
            let (from, to) = (mark.value.mean - deviation(mark), mark.value.mean + deviation(mark));
            if to > from {
                sheet.line(vec![at(mark, from), at(mark, to)], STROKE, Color::Cloud(mark.setting));
            }
        }
        for of_paper in [true, false] {
            for m in self.marks.iter().filter(|mark| mark.of_paper == of_paper) {
                mark(sheet, at(m, m.value.mean), m.setting, of_paper);
            }
        }
        self.draw_key(sheet);
    }

    /// What the marks of [`dots`](Self::dots) stand for.
    fn draw_key(&self, sheet: &mut Sheet) {
        let settings = self.settings.iter().enumerate();
        let mut entries: Vec<_> =
            settings.map(|(index, (name, _))| ((*name).to_owned(), index, false)).collect();
        if self.marks.iter().any(|mark| mark.of_paper) {
            entries.push(("hollow: the paper".to_owned(), 0, true));
        }
        key(sheet, (WIDTH - BESIDE + 14.0, TOP), BESIDE - 30.0, &entries);
    }

    fn lines(&self, sheet: &mut Sheet) {
        let (_, high) = self.range();
        let last = self.settings.iter().map(|(_, x)| *x).fold(0.01, f64::max);
        let (x, y) = (Axis::linear(0.0, last * 100.0), Axis::linear(0.0, high));
        let size = (WIDTH - NUMBERS - BESIDE, LINES);
        let chart = Chart { corner: (NUMBERS, TOP), size, x, y };
        chart.panel(sheet);
        chart.levels(sheet, &y.ticks());
        chart.below(sheet, &x.ticks(), "outliers, % of each cloud's points");
        let mut ends = Vec::new();
        for index in 0..self.methods.len() {
            let points: Vec<Point> = (self.marks.iter())
                .filter(|mark| mark.method == index && !mark.of_paper)
                .map(|mark| chart.at(self.settings[mark.setting].1 * 100.0, mark.value.mean))
                .collect();
            ends.push(points.last().map_or(0.0, |end| end.1));
            sheet.line(points.clone(), STROKE, Color::Cloud(index));
            for at in points {
                mark(sheet, at, index, false);
            }
        }
        // Lines are named where they end.
        let beside = NUMBERS + size.0 + 14.0;
        for (index, (name, y)) in self.methods.iter().zip(set_apart(&ends, TOP + LINES)).enumerate() {
            mark(sheet, (beside, y), index, false);
            sheet.text((beside + 13.0, y), plain(name), NAME, Anchor::Start);
        }
    }
}

impl Picture for Drawing<'_> {
    fn size(&self) -> (u32, u32) {
        let panel = match self.plot.kind {
            PlotKind::Dots => {
                let rows = self.row() * self.methods.len() as f64;
                rows.max(key_height(self.settings.len() + 1))
            }
            PlotKind::Lines => LINES + BELOW,
        };
        (WIDTH as u32, (TOP + panel + BOTTOM) as u32)
    }

    fn draw(&self, sheet: &mut Sheet) {
        title(sheet, (16.0, 12.0), &self.outcome.experiment.title, heading(&self.plot.measure));
        match self.plot.kind {
            PlotKind::Dots => self.dots(sheet),
            PlotKind::Lines => self.lines(sheet),
        }
    }
}

/// A name without the marks of code that it has in tables.
fn plain(name: &str) -> String {
    name.replace('`', "")
}

fn deviation(mark: &Mark) -> f64 {
    mark.value.deviation.unwrap_or(0.0)
}
