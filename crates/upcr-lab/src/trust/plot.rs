//! Reliability as a picture: what was said against what was true, and how often it was said.

use super::reliability::{BINS, Reliability};
use crate::drawing::{Anchor, Axis, Chart, Color, Picture, Point, QUIET, STROKE, Sheet, mark, title};

/// Sets that stand beside each other: as many as fit, and of more two.
const BESIDE: usize = 3;
/// Lengths in units: of a set's part of the picture, of its panels and their places.
const SET: (u32, u32) = (330, 462);
const CURVE: Point = (262.0, 262.0);
const COUNTS: Point = (262.0, 60.0);
const LEFT: f64 = 52.0;
const TOP: f64 = 64.0;
const BETWEEN: f64 = 26.0;

/// A panel for each set of pairs.
pub fn picture<'a>(sets: &'a [(&'a str, &'a Reliability)]) -> impl Picture + 'a {
    Panels(sets)
}

struct Panels<'a>(&'a [(&'a str, &'a Reliability)]);

impl Panels<'_> {
    fn columns(&self) -> usize {
        match self.0.len() {
            count @ 0..=BESIDE => count.max(1),
            _ => 2,
        }
    }
}

impl Picture for Panels<'_> {
    fn size(&self) -> (u32, u32) {
        let rows = self.0.len().div_ceil(self.columns()).max(1);
        (SET.0 * self.columns() as u32, SET.1 * rows as u32)
    }

    fn draw(&self, sheet: &mut Sheet) {
        for (n, (name, reliability)) in self.0.iter().enumerate() {
            let place = |index: usize, length: u32| (index as u32 * length) as f64;
            let (x, y) = (place(n % self.columns(), SET.0), place(n / self.columns(), SET.1));
            title(sheet, (x + 16.0, y + 12.0), name, "share of poses that are right");
            draw_curve(sheet, (x + LEFT, y + TOP), reliability);
            draw_counts(sheet, (x + LEFT, y + TOP + CURVE.1 + BETWEEN), reliability);
        }
    }
}

fn draw_curve(sheet: &mut Sheet, corner: Point, reliability: &Reliability) {
    let axis = Axis::linear(0.0, 1.0);
    let chart = Chart { corner, size: CURVE, x: axis, y: axis };
    chart.panel(sheet);
    chart.levels(sheet, &axis.ticks());
    sheet.dashes(vec![chart.at(0.0, 0.0), chart.at(1.0, 1.0)], STROKE / 2.0, Color::QuietText);
    for bin in reliability.bins.iter().filter(|bin| bin.count > 0) {
        let (low, high) = wilson(bin.share_right, bin.count);
        let at = |share: f64| chart.at(bin.mean_probability, share);
        sheet.line(vec![at(low), at(high)], STROKE, Color::Cloud(0));
        mark(sheet, at(bin.share_right), 0, false);
    }
}

fn draw_counts(sheet: &mut Sheet, corner: Point, reliability: &Reliability) {
    let most = reliability.bins.iter().map(|bin| bin.count).max().unwrap_or(0).max(1) as f64;
    let (x, y) = (Axis::linear(0.0, 1.0), Axis::linear(0.0, most));
    let chart = Chart { corner, size: COUNTS, x, y };
    chart.panel(sheet);
    sheet.text((corner.0, corner.1 - BETWEEN / 2.0), "pairs", QUIET, Anchor::Start);
    chart.levels(sheet, &[0.0, most]);
    chart.below(sheet, &x.ticks(), "probability stated");
    for (k, bin) in reliability.bins.iter().enumerate() {
        let side = |edge: usize| edge as f64 / BINS as f64;
        let (left, top) = chart.at(side(k), bin.count as f64);
        let (right, bottom) = chart.at(side(k + 1), 0.0);
        sheet.rectangle((left + 2.0, top), (right - left - 4.0, bottom - top), 0.0, Color::Quiet);
    }
}

/// The 95 % interval of a share (Wilson, 1927).
fn wilson(share: f64, count: usize) -> (f64, f64) {
    let (n, z) = (count as f64, 1.96_f64);
    let middle = (share + z * z / (2.0 * n)) / (1.0 + z * z / n);
    let half = z / (1.0 + z * z / n) * (share * (1.0 - share) / n + z * z / (4.0 * n * n)).sqrt();
    (middle - half, middle + half)
}

#[cfg(test)]
mod tests {
    use upcr::Evidence;

    use super::*;
    use crate::drawing;
    use crate::trust::cases::Kind;
    use crate::trust::observe::Observed;

    #[test]
    fn every_set_has_a_panel_and_every_filled_bin_a_mark() {
        let observed: Vec<Observed> = (0..100)
            .map(|i| Observed {
                kind: Kind::Noisy,
                right: i >= 50,
                probability: if i < 50 { 0.05 } else { 0.95 },
                evidence: Evidence::none(9),
                reasons: Vec::new(),
            })
            .collect();
        let reliability = Reliability::of(&observed);
        let svg = drawing::svg(&picture(&[("shapes", &reliability), ("rooms", &reliability)]));
        // Each with its margin.
        assert_eq!(svg.matches("<circle").count(), 8, "{svg}");
        assert!(svg.contains("shapes") && svg.contains("rooms"));
    }

    #[test]
    fn intervals_hold_the_share_and_stay_within_0_to_1() {
        for (share, count) in [(0.0, 5), (0.3, 10), (1.0, 1)] {
            let (low, high) = wilson(share, count);
            assert!(low >= -1e-12 && low <= share + 1e-12 && share <= high + 1e-12 && high <= 1.0 + 1e-12);
        }
    }
}
