//! Pictures in the style of the reports, as SVG and as PNG.

mod chart;
mod png;
mod style;
mod svg;

pub use chart::{Axis, Chart, key, key_height, mark, set_apart, short, title};
pub use png::png;
pub use style::{Color, Letters, NAME, QUIET, STROKE, TITLE};
pub use svg::svg;

use style::{ROUND, RULE};

/// A place, in units from the upper left corner.
pub type Point = (f64, f64);

/// Something that can be drawn.
pub trait Picture {
    /// Width and height, in units.
    fn size(&self) -> (u32, u32);

    /// Puts everything onto the sheet.
    fn draw(&self, sheet: &mut Sheet);
}

/// Which of a text's points is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    /// The left end.
    Start,
    /// The middle.
    Middle,
    /// The right end.
    End,
}

/// Shapes, one upon the other.
#[derive(Debug, Default)]
pub struct Sheet(Vec<Shape>);

#[derive(Debug)]
enum Shape {
    Line {
        points: Vec<Point>,
        width: f64,
        dashed: bool,
        color: Color,
    },
    Area {
        points: Vec<Point>,
        color: Color,
    },
    Rectangle {
        corner: Point,
        size: Point,
        round: f64,
        color: Color,
    },
    Circle {
        center: Point,
        radius: f64,
        color: Color,
    },
    /// Its place is on the baseline.
    Text {
        at: Point,
        text: String,
        letters: Letters,
        anchor: Anchor,
    },
}

/// Lengths of dashes and of the gaps between, in units.
const DASH: (f64, f64) = (5.0, 4.0);

impl Sheet {
    /// What a picture consists of, upon its page.
    fn of(picture: &impl Picture) -> Self {
        let (width, height) = picture.size();
        let mut sheet = Self::default();
        sheet.rectangle((0.0, 0.0), (f64::from(width), f64::from(height)), ROUND, Color::Page);
        picture.draw(&mut sheet);
        sheet
    }

    /// A line through points.
    pub fn line(&mut self, points: Vec<Point>, width: f64, color: Color) {
        self.0.push(Shape::Line { points, width, dashed: false, color });
    }

    /// A dashed line through points.
    pub fn dashes(&mut self, points: Vec<Point>, width: f64, color: Color) {
        self.0.push(Shape::Line { points, width, dashed: true, color });
    }

    /// A thin straight line.
    pub fn rule(&mut self, from: Point, to: Point) {
        self.line(vec![from, to], RULE, Color::Line);
    }

    /// A filled polygon.
    pub fn area(&mut self, points: Vec<Point>, color: Color) {
        self.0.push(Shape::Area { points, color });
    }

    /// A filled rectangle of which the upper left corner is given.
    pub fn rectangle(&mut self, corner: Point, size: Point, round: f64, color: Color) {
        self.0.push(Shape::Rectangle { corner, size, round, color });
    }

    /// A filled circle.
    pub fn circle(&mut self, center: Point, radius: f64, color: Color) {
        self.0.push(Shape::Circle { center, radius, color });
    }

    /// A line of text about the height of a point.
    pub fn text(&mut self, (x, y): Point, text: impl Into<String>, letters: Letters, anchor: Anchor) {
        let at = (x, y + letters.drop());
        self.0.push(Shape::Text { at, text: text.into(), letters, anchor });
    }
}
