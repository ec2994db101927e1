//! The learning curve as a table and as a picture.

use std::fmt::Write;
use std::path::Path;

use upcr::Result;

use super::history::Event;
use crate::drawing::{
    self, Anchor, Axis, Chart, Color, NAME, Picture, Point, STROKE, Sheet, set_apart, title,
};
use crate::files::write_atomically;

/// Lengths in units: of the picture, of a panel and its surroundings.
const SIZE: (u32, u32) = (876, 380);
const SECOND: f64 = 480.0;
const PANEL: Point = (318.0, 260.0);
const TOP: f64 = 64.0;
const LEFT: f64 = 60.0;

/// A name, its colour, whether it is dashed, and points (step, value).
type Line = (&'static str, Color, bool, Vec<(f64, f64)>);

/// Loss and held-out rotation error over the steps.
struct LearningCurve<'a>(&'a [Event]);

/// Loss and held-out rotation error over the steps, as SVG; empty for a curve without a point.
pub fn learning_curve(history: &[Event]) -> String {
    if history.is_empty() {
        return String::new();
    }
    drawing::svg(&LearningCurve(history))
}

impl Picture for LearningCurve<'_> {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw(&self, sheet: &mut Sheet) {
        let (learned, held_out) = (Color::Cloud(0), Color::Cloud(1));
        let at = |value: fn(&Event) -> Option<f64>| -> Vec<(f64, f64)> {
            let points = self.0.iter().filter_map(|e| Some((e.step as f64, value(e)?)));
            points.filter(|(_, y)| y.is_finite() && *y > 0.0).collect()
        };
        let loss = [
            ("learned from", learned, true, at(|e| Some(e.loss))),
            ("held out", held_out, false, at(|e| e.validation.map(|v| v.loss))),
        ];
        panel(sheet, 0.0, ("Loss", "of pairs learned from and held out"), &loss);
        let error = [("held out", held_out, false, at(|e| e.validation.map(|v| v.mae_r_deg)))];
        panel(sheet, SECOND, ("Rotation error", "MAE(R) of pairs held out, degrees"), &error);
    }
}

/// Lines over the steps, the values' axis logarithmic.
fn panel(sheet: &mut Sheet, left: f64, (name, remark): (&str, &str), lines: &[Line]) {
    let all = || lines.iter().flat_map(|(.., points)| points);
    let last = all().map(|p| p.0).fold(1.0, f64::max);
    let low = all().map(|p| p.1).fold(f64::INFINITY, f64::min);
    let high = all().map(|p| p.1).fold(0.0, f64::max);
    if !(low.is_finite() && high > 0.0) {
        return;
    }
    title(sheet, (left + 16.0, 12.0), name, remark);
    let (x, y) = (Axis::linear(0.0, last), Axis::logarithmic(low * 0.9, high * 1.1));
    let chart = Chart { corner: (left + LEFT, TOP), size: PANEL, x, y };
    chart.panel(sheet);
    chart.levels(sheet, &y.ticks());
    chart.below(sheet, &x.ticks(), "steps");
    let lines: Vec<_> = lines.iter().filter(|(.., points)| !points.is_empty()).collect();
    let ends: Vec<Point> =
        lines.iter().filter_map(|(.., points)| points.last()).map(|&(x, y)| chart.at(x, y)).collect();
    for (_, color, dashed, points) in &lines {
        let points = points.iter().map(|&(x, y)| chart.at(x, y)).collect();
        if *dashed {
            sheet.dashes(points, STROKE, *color);
        } else {
            sheet.line(points, STROKE, *color);
        }
    }
    // Lines are named where they end, and one alone by the title.
    let heights = set_apart(&ends.iter().map(|end| end.1).collect::<Vec<_>>(), TOP + PANEL.1);
    let beside = left + LEFT + PANEL.0 + 8.0;
    for ((&end, y), (name, color, ..)) in ends.iter().zip(heights).zip(&lines) {
        sheet.circle(end, 3.5, *color);
        if lines.len() > 1 {
            sheet.text((beside, y), *name, NAME, Anchor::Start);
        }
    }
}

/// Writes the curve into a run's folder: `history.csv`, and `history.svg` as a picture.
///
/// # Errors
/// Where a file cannot be written.
pub fn write_history(folder: &Path, history: &[Event]) -> Result<()> {
    let mut csv = String::from(
        "step,points,seconds,learning_rate,clouds_per_second,loss,val_loss,val_mae_r_deg,val_mae_t,val_recall\n",
    );
    for e in history {
        let [loss, mae_r, mae_t, recall] =
            e.validation.map_or([f64::NAN; 4], |v| [v.loss, v.mae_r_deg, v.mae_t, v.recall]);
        // Writing to a string cannot fail.
        let _ = writeln!(
            csv,
            "{},{},{:.1},{:e},{:.1},{},{loss},{mae_r},{mae_t},{recall}",
            e.step, e.points, e.seconds, e.learning_rate, e.clouds_per_second, e.loss
        );
    }
    write_atomically(&folder.join("history.csv"), csv.as_bytes())?;
    write_atomically(&folder.join("history.svg"), learning_curve(history).as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::ValidationErrors;

    #[test]
    fn a_curve_has_its_lines_and_none_has_no_picture() {
        assert_eq!(learning_curve(&[]), "");
        let event = |step: u64| Event {
            step,
            steps: 30,
            points: 64,
            loss: 1.0 / step as f64,
            validation: Some(ValidationErrors {
                loss: 1.1 / step as f64,
                mae_r_deg: 20.0 / step as f64,
                mae_t: 0.1,
                recall: 0.5,
            }),
            learning_rate: 1e-3,
            clouds_per_second: 10.0,
            seconds: 1.0,
        };
        let picture = learning_curve(&[event(10), event(20), event(30)]);
        assert!(picture.starts_with("<svg"));
        assert!(picture.matches("<polyline").count() >= 3, "{picture}");
        assert!(picture.contains("MAE(R)"));
    }
}
