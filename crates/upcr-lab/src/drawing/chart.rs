//! What plots are put together of: axes, their panels, marks, keys.

use super::style::{ROUND, RULE};
use super::{Anchor, Color, NAME, Point, QUIET, Sheet, TITLE};

/// From a panel's border to its axes' ends, in units.
const INSET: f64 = 10.0;
/// Height of a line of text, in units.
const LINE: f64 = 20.0;
/// Radius of marks, in units.
const MARK: f64 = 5.0;
/// How many values an axis names, about.
const TICKS: f64 = 5.0;

/// A range of values along a side of a panel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    from: f64,
    to: f64,
    logarithmic: bool,
}

/// A panel, and how values come onto it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chart {
    /// Its upper left corner.
    pub corner: Point,
    /// Its width and height.
    pub size: Point,
    /// Values from left to right.
    pub x: Axis,
    /// Values from the bottom up.
    pub y: Axis,
}

impl Axis {
    /// Of equal steps.
    pub fn linear(from: f64, to: f64) -> Self {
        Self { from, to, logarithmic: false }
    }

    /// Of equal ratios; both ends are positive.
    pub fn logarithmic(from: f64, to: f64) -> Self {
        Self { from, to, logarithmic: true }
    }

    /// Where a value is, from 0 to 1; what is beyond an end is at it.
    fn share(self, value: f64) -> f64 {
        let of = |v: f64| if self.logarithmic { v.max(f64::MIN_POSITIVE).ln() } else { v };
        ((of(value) - of(self.from)) / (of(self.to) - of(self.from))).clamp(0.0, 1.0)
    }

    /// Round values on it, a handful.
    pub fn ticks(self) -> Vec<f64> {
        let within = |values: Vec<f64>| -> Vec<f64> {
            values.into_iter().filter(|&v| v >= self.from && v <= self.to).collect()
        };
        if self.logarithmic {
            let decades = self.from.log10().floor() as i32..=self.to.log10().ceil() as i32;
            for digits in [&[1.0][..], &[1.0, 3.0], &[1.0, 2.0, 5.0]] {
                let values = decades.clone().flat_map(|n| digits.iter().map(move |d| d * power(n)));
                let ticks = within(values.collect());
                if ticks.len() >= 3 {
                    return ticks;
                }
            }
        }
        let rough = (self.to - self.from) / TICKS;
        let ten = power(rough.log10().floor() as i32);
        let step =
            [1.0, 2.0, 5.0, 10.0].map(|d| d * ten).into_iter().find(|&s| s >= 0.95 * rough).unwrap_or(rough);
        let first = (self.from / step).ceil() as i64;
        let last = (self.to / step * (1.0 + 1e-12)).floor() as i64;
        // 0.3 is 3/10 and not three times 0.1.
        (first..=last)
            .map(|n| if step < 1.0 { n as f64 / (1.0 / step).round() } else { n as f64 * step })
            .collect()
    }
}

impl Chart {
    /// Where a pair of values is.
    pub fn at(&self, x: f64, y: f64) -> Point {
        let ((left, top), (width, height)) = (self.corner, self.size);
        let x = left + INSET + self.x.share(x) * (width - 2.0 * INSET);
        let y = top + INSET + (1.0 - self.y.share(y)) * (height - 2.0 * INSET);
        (x, y)
    }

    /// The panel, empty.
    pub fn panel(&self, sheet: &mut Sheet) {
        sheet.rectangle(self.corner, self.size, ROUND, Color::Canvas);
    }

    /// Rules at some heights, and what they stand for beside them.
    pub fn levels(&self, sheet: &mut Sheet, ticks: &[f64]) {
        for &tick in ticks {
            let (_, y) = self.at(self.x.from, tick);
            sheet.rule((self.corner.0, y), (self.corner.0 + self.size.0, y));
            sheet.text((self.corner.0 - 8.0, y), short(tick), QUIET, Anchor::End);
        }
    }

    /// What stands for what from left to right, below.
    pub fn below(&self, sheet: &mut Sheet, ticks: &[f64], name: &str) {
        let bottom = self.corner.1 + self.size.1;
        for &tick in ticks {
            let (x, _) = self.at(tick, self.y.from);
            sheet.text((x, bottom + 14.0), short(tick), QUIET, Anchor::Middle);
        }
        sheet.text((self.corner.0 + INSET, bottom + 14.0 + LINE), name, QUIET, Anchor::Start);
    }

    /// Says at the left end that what is there may be less.
    pub fn lowest(&self, sheet: &mut Sheet, value: f64) {
        let (x, _) = self.at(self.x.from, self.y.from);
        let bottom = self.corner.1 + self.size.1;
        sheet.text((x, bottom + 14.0), format!("≤ {}", short(value)), QUIET, Anchor::Middle);
    }

    /// Rules at some places from left to right.
    pub fn columns(&self, sheet: &mut Sheet, ticks: &[f64]) {
        for &tick in ticks {
            let (x, _) = self.at(tick, self.y.from);
            sheet.rule((x, self.corner.1), (x, self.corner.1 + self.size.1));
        }
    }
}

/// What a picture is of, and a remark below it.
pub fn title(sheet: &mut Sheet, (x, y): Point, text: &str, remark: &str) {
    sheet.text((x, y + LINE / 2.0), text, TITLE, Anchor::Start);
    sheet.text((x, y + 1.5 * LINE), remark, QUIET, Anchor::Start);
}

/// A name, and the index of its mark and whether that is hollow.
pub type Entry = (String, usize, bool);

/// Height of a key with so many entries.
pub fn key_height(entries: usize) -> f64 {
    LINE * entries as f64 + 12.0
}

/// What marks stand for, in a box of the reports' kind.
pub fn key(sheet: &mut Sheet, (x, y): Point, width: f64, entries: &[Entry]) {
    let height = key_height(entries.len());
    sheet.rectangle((x, y), (width, height), ROUND, Color::Line);
    let inside = (width - 2.0 * RULE, height - 2.0 * RULE);
    sheet.rectangle((x + RULE, y + RULE), inside, ROUND - RULE, Color::Page);
    for (n, (name, index, hollow)) in entries.iter().enumerate() {
        let at = y + 6.0 + LINE * (n as f64 + 0.5);
        mark(sheet, (x + 15.0, at), *index, *hollow);
        sheet.text((x + 28.0, at), name.as_str(), NAME, Anchor::Start);
    }
}

/// A mark whose form tells what its colour does: circle, square, triangle, diamond, upturned triangle, bar.
pub fn mark(sheet: &mut Sheet, at: Point, index: usize, hollow: bool) {
    // A margin tells marks apart that lie upon each other.
    form(sheet, at, index, MARK + 1.0, Color::Canvas);
    form(sheet, at, index, MARK, Color::Cloud(index));
    if hollow {
        form(sheet, at, index, MARK - 1.75, Color::Page);
    }
}

fn form(sheet: &mut Sheet, (x, y): Point, index: usize, radius: f64, color: Color) {
    let r = radius;
    let corners: &[Point] = match index % 6 {
        0 => return sheet.circle((x, y), r, color),
        1 => &[(-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)],
        2 => &[(0.0, -1.15), (1.1, 0.85), (-1.1, 0.85)],
        3 => &[(0.0, -1.25), (1.25, 0.0), (0.0, 1.25), (-1.25, 0.0)],
        4 => &[(0.0, 1.15), (-1.1, -0.85), (1.1, -0.85)],
        _ => &[(-1.2, -0.6), (1.2, -0.6), (1.2, 0.6), (-1.2, 0.6)],
    };
    sheet.area(corners.iter().map(|(dx, dy)| (x + r * dx, y + r * dy)).collect(), color);
}

/// Heights near those wanted, each a line of text from the next, and none below the lowest allowed.
pub fn set_apart(wanted: &[f64], lowest: f64) -> Vec<f64> {
    let mut order: Vec<usize> = (0..wanted.len()).collect();
    order.sort_by(|&a, &b| wanted[a].total_cmp(&wanted[b]));
    let mut heights = wanted.to_vec();
    for pair in order.windows(2) {
        heights[pair[1]] = heights[pair[1]].max(heights[pair[0]] + LINE);
    }
    let mut limit = lowest;
    for &n in order.iter().rev() {
        heights[n] = heights[n].min(limit);
        limit = heights[n] - LINE;
    }
    heights
}

/// A number without needless digits.
pub fn short(value: f64) -> String {
    if value != 0.0 && !(1e-4..1e6).contains(&value.abs()) {
        return format!("{value:e}");
    }
    let text = format!("{}", (value * 1e6).round() / 1e6);
    let digits = text.find('.').unwrap_or(text.len());
    if digits < 4 {
        return text;
    }
    format!("{},{}", &text[..digits - 3], &text[digits - 3..])
}

/// A power of ten; 0.01 is 1/100 and not a tenth of a tenth.
fn power(n: i32) -> f64 {
    if n < 0 { 1.0 / 10f64.powi(-n) } else { 10f64.powi(n) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_a_handful() {
        assert_eq!(Axis::linear(0.0, 1.0).ticks(), [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]);
        assert_eq!(Axis::linear(0.0, 32_300.0).ticks(), [0.0, 10_000.0, 20_000.0, 30_000.0]);
        assert_eq!(Axis::linear(0.0, 37.4).ticks(), [0.0, 10.0, 20.0, 30.0]);
        assert_eq!(Axis::logarithmic(0.003, 30.0).ticks(), [0.01, 0.1, 1.0, 10.0]);
        assert_eq!(Axis::logarithmic(0.8, 14.0).ticks(), [1.0, 3.0, 10.0]);
        assert_eq!(Axis::logarithmic(0.007, 0.034).ticks(), [0.01, 0.02, 0.03]);
        assert_eq!(Axis::logarithmic(4.0, 13.0).ticks(), [4.0, 6.0, 8.0, 10.0, 12.0]);
        for exponent in [-9, 0, 9] {
            for (low, high) in [(0.9, 1.1), (1.0, 5.0), (0.2, 900.0)] {
                let (low, high) = (low * power(exponent), high * power(exponent));
                for axis in [Axis::linear(low, high), Axis::logarithmic(low, high)] {
                    assert!((2..12).contains(&axis.ticks().len()), "{axis:?}: {:?}", axis.ticks());
                }
            }
        }
    }

    #[test]
    fn values_are_where_they_belong_and_none_beyond() {
        let size = (220.0, 120.0);
        let (x, y) = (Axis::logarithmic(0.1, 10.0), Axis::linear(0.0, 4.0));
        let chart = Chart { corner: (5.0, 7.0), size, x, y };
        assert_eq!(chart.at(0.1, 0.0), (15.0, 117.0));
        let (x, y) = chart.at(1.0, 1.0);
        assert!((x - 115.0).abs() < 1e-9 && y == 92.0, "{x} {y}");
        assert_eq!(chart.at(0.0, 9.0), (15.0, 17.0));
    }

    #[test]
    fn names_do_not_meet() {
        assert_eq!(set_apart(&[50.0, 10.0, 12.0], 100.0), [50.0, 10.0, 30.0]);
        assert_eq!(set_apart(&[99.0, 98.0, 10.0], 100.0), [100.0, 80.0, 10.0]);
    }

    #[test]
    fn numbers_are_short() {
        for (value, text) in
            [(0.0, "0"), (0.3, "0.3"), (1500.0, "1,500"), (32_300.0, "32,300"), (1e9, "1e9"), (1e-9, "1e-9")]
        {
            assert_eq!(short(value), text);
        }
    }
}
