//! Reliability as a picture: what was said against what was true, and how often it was said.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::reliability::{BINS, Reliability};
use crate::drawing::{CAPTION, COLORS, Drawn, LETTERS, Picture, font};

/// Width of a panel, heights of its two parts, in units.
const WIDTH: u32 = 330;
const CURVE: u32 = 330;
const COUNTS: u32 = 130;

/// A panel for each set of pairs, side by side.
pub fn picture<'a>(sets: &'a [(&'a str, &'a Reliability)]) -> impl Picture + 'a {
    Panels(sets)
}

struct Panels<'a>(&'a [(&'a str, &'a Reliability)]);

impl Picture for Panels<'_> {
    fn size(&self) -> (u32, u32) {
        (WIDTH * self.0.len().max(1) as u32, CURVE + COUNTS)
    }

    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> Drawn
    where
        B::ErrorType: 'static,
    {
        let panels = area.split_evenly((1, self.0.len().max(1)));
        for (panel, (name, reliability)) in panels.iter().zip(self.0) {
            let (curve, counts) = panel.split_vertically(CURVE * unit);
            draw_curve(&curve, unit, name, reliability)?;
            draw_counts(&counts, unit, reliability)?;
        }
        Ok(())
    }
}

fn draw_curve<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    unit: u32,
    name: &str,
    reliability: &Reliability,
) -> Drawn
where
    B::ErrorType: 'static,
{
    let letters = font(LETTERS, unit);
    let color = COLORS[0];
    let mut chart = ChartBuilder::on(area)
        .caption(name, font(CAPTION, unit))
        .margin(8 * unit)
        .x_label_area_size(18 * unit)
        .y_label_area_size(44 * unit)
        .build_cartesian_2d(0.0..1.0, 0.0..1.0)?;
    chart
        .configure_mesh()
        .label_style(letters)
        .x_labels(6)
        .y_labels(6)
        .y_desc("share right")
        .bold_line_style(BLACK.mix(0.12))
        .light_line_style(TRANSPARENT)
        .draw()?;
    chart.draw_series(LineSeries::new([(0.0, 0.0), (1.0, 1.0)], BLACK.mix(0.4).stroke_width(unit)))?;
    for bin in reliability.bins.iter().filter(|bin| bin.count > 0) {
        let (low, high) = wilson(bin.share_right, bin.count);
        let x = bin.mean_probability;
        chart.draw_series([PathElement::new([(x, low), (x, high)], color.stroke_width(unit * 3 / 2))])?;
        chart.draw_series([Circle::new((x, bin.share_right), 4 * unit, color.filled())])?;
    }
    Ok(())
}

fn draw_counts<B: DrawingBackend>(area: &DrawingArea<B, Shift>, unit: u32, reliability: &Reliability) -> Drawn
where
    B::ErrorType: 'static,
{
    let letters = font(LETTERS, unit);
    let most = reliability.bins.iter().map(|bin| bin.count).max().unwrap_or(0).max(1) as f64;
    let mut chart = ChartBuilder::on(area)
        .margin(8 * unit)
        .x_label_area_size(34 * unit)
        .y_label_area_size(44 * unit)
        .build_cartesian_2d(0.0..1.0, 0.0..most * 1.05)?;
    chart
        .configure_mesh()
        .label_style(letters)
        .disable_mesh()
        .x_labels(6)
        .y_labels(3)
        .x_desc("probability stated")
        .y_desc("pairs")
        .y_label_formatter(&|v| format!("{v:.0}"))
        .draw()?;
    for (k, bin) in reliability.bins.iter().enumerate() {
        let side = |edge: usize| edge as f64 / BINS as f64;
        let bar = [(side(k) + 0.01, 0.0), (side(k + 1) - 0.01, bin.count as f64)];
        chart.draw_series([Rectangle::new(bar, COLORS[5].filled())])?;
    }
    Ok(())
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
        let svg = drawing::svg(&picture(&[("shapes", &reliability), ("rooms", &reliability)])).unwrap();
        assert_eq!(svg.matches("<circle").count(), 4, "{svg}");
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
