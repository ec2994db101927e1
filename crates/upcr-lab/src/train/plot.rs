//! The learning curve as a table and as a picture.

use std::fmt::Write;
use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;
use upcr::Result;

use super::history::Event;
use crate::drawing::{self, CAPTION, COLORS, Drawn, LETTERS, Picture, font};
use crate::files::write_atomically;

const SIZE: (u32, u32) = (960, 420);

/// A name, a colour, and points (step, value).
type Line = (&'static str, RGBColor, Vec<(f64, f64)>);

/// Loss and held-out rotation error over the steps.
struct LearningCurve<'a>(&'a [Event]);

/// Loss and held-out rotation error over the steps, as SVG; empty for a curve without a point.
///
/// # Errors
/// Where the picture cannot be drawn.
pub fn learning_curve(history: &[Event]) -> Result<String> {
    if history.is_empty() {
        return Ok(String::new());
    }
    drawing::svg(&LearningCurve(history))
}

impl Picture for LearningCurve<'_> {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> Drawn
    where
        B::ErrorType: 'static,
    {
        let [learned, held_out, ..] = COLORS;
        let (left, right) = area.split_horizontally(SIZE.0 * unit / 2);
        let at = |value: fn(&Event) -> Option<f64>| -> Vec<(f64, f64)> {
            let points = self.0.iter().filter_map(|e| Some((e.step as f64, value(e)?)));
            points.filter(|(_, y)| y.is_finite() && *y > 0.0).collect()
        };
        panel(
            &left,
            unit,
            "Chamfer loss",
            &[
                ("learned from", learned, at(|e| Some(e.loss))),
                ("held out", held_out, at(|e| e.validation.map(|v| v.loss))),
            ],
        )?;
        panel(
            &right,
            unit,
            "held out: MAE(R), degrees",
            &[("held out", held_out, at(|e| e.validation.map(|v| v.mae_r_deg)))],
        )
    }
}

/// Lines over the steps, the values' axis logarithmic.
fn panel<B: DrawingBackend>(area: &DrawingArea<B, Shift>, unit: u32, title: &str, lines: &[Line]) -> Drawn
where
    B::ErrorType: 'static,
{
    let all = || lines.iter().flat_map(|(_, _, points)| points);
    let last = all().map(|p| p.0).fold(1.0, f64::max);
    let low = all().map(|p| p.1).fold(f64::INFINITY, f64::min);
    let high = all().map(|p| p.1).fold(0.0, f64::max);
    if !(low.is_finite() && high > 0.0) {
        return Ok(());
    }
    let mut chart = ChartBuilder::on(area)
        .caption(title, font(CAPTION, unit))
        .margin(12 * unit)
        .x_label_area_size(36 * unit)
        .y_label_area_size(64 * unit)
        .build_cartesian_2d(0.0..last, (low * 0.8..high * 1.25).log_scale())?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .label_style(font(LETTERS, unit))
        .x_desc("steps")
        .x_labels(6)
        .draw()?;
    for (name, color, points) in lines {
        let color = *color;
        chart
            .draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2 * unit)))?
            .label(*name)
            .legend(move |(x, y)| {
                PathElement::new([(x, y), (x + 18 * unit as i32, y)], color.stroke_width(2 * unit))
            });
    }
    chart
        .configure_series_labels()
        .label_font(font(LETTERS, unit))
        .background_style(WHITE.mix(0.85))
        .border_style(BLACK.mix(0.3))
        .draw()?;
    Ok(())
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
    write_atomically(&folder.join("history.svg"), learning_curve(history)?.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::ValidationErrors;

    #[test]
    fn a_curve_has_its_lines_and_none_has_no_picture() {
        assert_eq!(learning_curve(&[]).unwrap(), "");
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
        let picture = learning_curve(&[event(10), event(20), event(30)]).unwrap();
        assert!(picture.starts_with("<svg"));
        assert!(picture.matches("<polyline").count() >= 3, "{picture}");
        assert!(picture.contains("MAE(R)"));
    }
}
