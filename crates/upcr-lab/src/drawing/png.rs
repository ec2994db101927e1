//! Pictures as PNG, on light pages, with letters of our own: the same pixels on every machine.

use std::error::Error as StdError;

use ab_glyph::{Font, FontRef, PxScale, ScaleFont};
use ab_glyph_rasterizer::{Rasterizer, point};
use upcr::{Error, Result};

use super::{Anchor, Color, DASH, Letters, Picture, Point, Shape, Sheet};

/// Pixels a unit.
const PIXELS: f64 = 2.0;
/// The letters at hand are light: they are drawn so often, so many units apart, for text and for titles.
const WEIGHTS: (usize, usize, f64) = (2, 6, 0.2);
/// Handles of the curve that is nearly a quarter of a circle, as a share of its radius.
const QUARTER: f64 = 0.5523;

/// The picture as PNG, in twice its size.
///
/// # Errors
/// Where it cannot be written.
pub fn png(picture: &impl Picture) -> Result<Vec<u8>> {
    let font = FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT).map_err(|e| failed(&e))?;
    let (width, height) = picture.size();
    let mut paper = Paper::new(width, height);
    for shape in Sheet::of(picture).0 {
        paper.put(&shape, &font);
    }
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, paper.width as u32, paper.height as u32);
    encoder.set_color(png::ColorType::Rgb);
    let write = || {
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&paper.pixels)?;
        writer.finish()
    };
    write().map_err(|e| failed(&e))?;
    Ok(bytes)
}

fn failed(error: &dyn StdError) -> Error {
    Error::InvalidSetting { name: "plot", reason: error.to_string() }
}

struct Paper {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

/// Outlines in pixels, whose covered shares of pixels are summed: all of them run in one sense.
struct Outline {
    /// The first column and row.
    from: (i32, i32),
    rasterizer: Rasterizer,
}

impl Paper {
    fn new(width: u32, height: u32) -> Self {
        let (width, height) = (width as usize * PIXELS as usize, height as usize * PIXELS as usize);
        Self { width, height, pixels: vec![255; width * height * 3] }
    }

    fn put(&mut self, shape: &Shape, font: &FontRef) {
        match shape {
            Shape::Line { points, width, dashed, color } => {
                let pieces = if *dashed { dashes(points) } else { vec![points.clone()] };
                let mut outline = Outline::around(points, *width);
                for piece in &pieces {
                    outline.stroke(piece, width / 2.0);
                }
                self.fill(&outline, *color);
            }
            Shape::Area { points, color } => {
                let mut outline = Outline::around(points, 0.0);
                outline.polygon(points);
                self.fill(&outline, *color);
            }
            Shape::Rectangle { corner, size, round, color } => {
                let mut outline = Outline::around(&[*corner, (corner.0 + size.0, corner.1 + size.1)], 0.0);
                outline.rounded(*corner, *size, *round);
                self.fill(&outline, *color);
            }
            Shape::Circle { center, radius, color } => {
                let mut outline = Outline::around(&[*center], *radius);
                outline.circle(*center, *radius);
                self.fill(&outline, *color);
            }
            Shape::Text { at, text, letters, anchor } => self.write(*at, text, *letters, *anchor, font),
        }
    }

    fn fill(&mut self, outline: &Outline, color: Color) {
        let (left, top) = outline.from;
        outline
            .rasterizer
            .for_each_pixel_2d(|x, y, share| self.mix(left + x as i32, top + y as i32, share, color));
    }

    fn mix(&mut self, x: i32, y: i32, share: f32, color: Color) {
        let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y)) else { return };
        if x >= self.width || y >= self.height || share <= 0.0 {
            return;
        }
        let [_, rgb @ ..] = color.tones().light.to_be_bytes();
        let pixel = &mut self.pixels[(y * self.width + x) * 3..][..3];
        for (old, new) in pixel.iter_mut().zip(rgb) {
            let (from, to) = (f32::from(*old), f32::from(new));
            *old = (from + (to - from) * share.min(1.0)).round() as u8;
        }
    }

    fn write(&mut self, (x, y): Point, text: &str, letters: Letters, anchor: Anchor, font: &FontRef) {
        let em = letters.size * PIXELS;
        let height = f64::from(font.height_unscaled() / font.units_per_em().unwrap_or(1000.0));
        let scaled = font.as_scaled(PxScale::from((em * height) as f32));
        let mut glyphs = Vec::new();
        let mut length = 0.0;
        for letter in text.chars() {
            let id = scaled.glyph_id(letter);
            length += glyphs.last().map_or(0.0, |&(last, _)| scaled.kern(last, id));
            glyphs.push((id, length));
            length += scaled.h_advance(id);
        }
        let start = match anchor {
            Anchor::Start => 0.0,
            Anchor::Middle => length / 2.0,
            Anchor::End => length,
        };
        let (times, strong, apart) = WEIGHTS;
        for time in 0..if letters.strong { strong } else { times } {
            let shift = (time as f64 * apart * PIXELS) as f32;
            for (id, along) in &glyphs {
                let position = point((x * PIXELS) as f32 - start + along + shift, (y * PIXELS) as f32);
                let glyph = id.with_scale_and_position(scaled.scale(), position);
                let Some(outlined) = scaled.outline_glyph(glyph) else { continue };
                let bounds = outlined.px_bounds();
                outlined.draw(|x, y, share| {
                    self.mix(
                        bounds.min.x as i32 + x as i32,
                        bounds.min.y as i32 + y as i32,
                        share,
                        letters.color,
                    );
                });
            }
        }
    }
}

impl Outline {
    /// For what lies within a margin of points.
    fn around(points: &[Point], margin: f64) -> Self {
        let ends = |of: fn(&Point) -> f64| {
            let (low, high) = points
                .iter()
                .map(of)
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
            (((low - margin) * PIXELS).floor() as i32 - 1, ((high + margin) * PIXELS).ceil() as i32 + 1)
        };
        let ((left, right), (top, bottom)) = (ends(|p| p.0), ends(|p| p.1));
        let length = |from: i32, to: i32| usize::try_from(to - from).unwrap_or(0);
        Self { from: (left, top), rasterizer: Rasterizer::new(length(left, right), length(top, bottom)) }
    }

    fn pixel(&self, (x, y): Point) -> ab_glyph_rasterizer::Point {
        let (left, top) = self.from;
        point((x * PIXELS - f64::from(left)) as f32, (y * PIXELS - f64::from(top)) as f32)
    }

    fn polygon(&mut self, points: &[Point]) {
        for (n, &from) in points.iter().enumerate() {
            let to = points[(n + 1) % points.len()];
            self.rasterizer.draw_line(self.pixel(from), self.pixel(to));
        }
    }

    fn curve(&mut self, [from, first, second, to]: [Point; 4]) {
        let [from, first, second, to] = [from, first, second, to].map(|p| self.pixel(p));
        self.rasterizer.draw_cubic(from, first, second, to);
    }

    /// Clockwise, as seen.
    fn rounded(&mut self, (left, top): Point, (width, height): Point, round: f64) {
        let (right, bottom) = (left + width, top + height);
        let (r, h) = (round, round * (1.0 - QUARTER));
        let straight = |outline: &mut Self, from, to| {
            let (from, to) = (outline.pixel(from), outline.pixel(to));
            outline.rasterizer.draw_line(from, to);
        };
        straight(self, (left + r, top), (right - r, top));
        self.curve([(right - r, top), (right - h, top), (right, top + h), (right, top + r)]);
        straight(self, (right, top + r), (right, bottom - r));
        self.curve([(right, bottom - r), (right, bottom - h), (right - h, bottom), (right - r, bottom)]);
        straight(self, (right - r, bottom), (left + r, bottom));
        self.curve([(left + r, bottom), (left + h, bottom), (left, bottom - h), (left, bottom - r)]);
        straight(self, (left, bottom - r), (left, top + r));
        self.curve([(left, top + r), (left, top + h), (left + h, top), (left + r, top)]);
    }

    fn circle(&mut self, (x, y): Point, radius: f64) {
        self.rounded((x - radius, y - radius), (2.0 * radius, 2.0 * radius), radius);
    }

    fn stroke(&mut self, points: &[Point], half: f64) {
        for pair in points.windows(2) {
            let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
            let length = distance(pair[0], pair[1]);
            if length > 0.0 {
                let (dx, dy) = ((y1 - y0) / length * half, (x0 - x1) / length * half);
                self.polygon(&[
                    (x0 + dx, y0 + dy),
                    (x1 + dx, y1 + dy),
                    (x1 - dx, y1 - dy),
                    (x0 - dx, y0 - dy),
                ]);
            }
        }
        for &joint in points.get(1..points.len().saturating_sub(1)).unwrap_or_default() {
            self.circle(joint, half);
        }
    }
}

/// By what is rounded alike on every machine.
fn distance((x0, y0): Point, (x1, y1): Point) -> f64 {
    ((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0)).sqrt()
}

/// A line's dashes.
fn dashes(points: &[Point]) -> Vec<Vec<Point>> {
    let (on, off) = DASH;
    let mut pieces: Vec<Vec<Point>> = points.first().map(|&first| vec![vec![first]]).unwrap_or_default();
    let (mut drawn, mut left) = (true, on);
    for pair in points.windows(2) {
        let (from, to) = (pair[0], pair[1]);
        let length = distance(from, to);
        let at = |along: f64| {
            let share = along / length;
            (from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1))
        };
        let mut along = 0.0;
        while along + left < length {
            along += left;
            if drawn {
                pieces.last_mut().into_iter().for_each(|piece| piece.push(at(along)));
            } else {
                pieces.push(vec![at(along)]);
            }
            drawn = !drawn;
            left = if drawn { on } else { off };
        }
        left -= length - along;
        if drawn {
            pieces.last_mut().into_iter().for_each(|piece| piece.push(to));
        }
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paper(shapes: &[Shape]) -> Paper {
        let font = FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT).unwrap();
        let mut paper = Paper::new(20, 10);
        for shape in shapes {
            paper.put(shape, &font);
        }
        paper
    }

    /// How many pixels' worth of black there is on white.
    fn ink(shape: Shape) -> f64 {
        let paper = paper(&[shape]);
        let [_, r, ..] = Color::Text.tones().light.to_be_bytes();
        paper.pixels.iter().step_by(3).map(|&v| f64::from(255 - v) / f64::from(255 - r)).sum()
    }

    #[test]
    fn shapes_cover_their_areas() {
        let (color, pixels) = (Color::Text, PIXELS * PIXELS);
        let corner = (1.25, 2.5);
        let close = |found: f64, wanted: f64| {
            assert!((found / (wanted * pixels) - 1.0).abs() < 0.01, "{found} {wanted}");
        };
        close(
            ink(Shape::Circle { center: (7.3, 4.9), radius: 3.2, color }),
            3.2 * 3.2 * std::f64::consts::PI,
        );
        let round = Shape::Rectangle { corner, size: (9.25, 5.75), round: 2.0, color };
        close(ink(round), 9.25 * 5.75 - 4.0 * (4.0 - std::f64::consts::PI));
        close(ink(Shape::Area { points: vec![(1.0, 1.0), (9.5, 2.0), (4.0, 8.0)], color }), 28.25);
        let points = vec![(2.0, 2.0), (14.0, 7.0)];
        close(ink(Shape::Line { points: points.clone(), width: 1.5, dashed: false, color }), 19.5);
        // Of 13 units there are dashes of 5 and 4.
        close(ink(Shape::Line { points, width: 1.5, dashed: true, color }), 13.5);
    }

    #[test]
    fn dashes_go_round_corners() {
        let pieces = dashes(&[(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (4.0, 10.0)]);
        let wanted = [vec![(0.0, 0.0), (4.0, 0.0), (4.0, 1.0)], vec![(4.0, 5.0), (4.0, 10.0)]];
        assert_eq!(pieces, wanted);
    }

    #[test]
    fn what_reaches_beyond_the_paper_is_cut() {
        let far = Shape::Circle { center: (-5.0, 12.0), radius: 9.0, color: Color::Cloud(0) };
        assert!(paper(&[far]).pixels.iter().any(|&v| v != 255));
    }

    #[test]
    fn titles_are_heavier_than_names() {
        let text = |strong| Shape::Text {
            at: (1.0, 8.0),
            text: "Loss".into(),
            letters: Letters { size: 8.0, strong, color: Color::Text },
            anchor: Anchor::Start,
        };
        assert!(ink(text(true)) > 1.2 * ink(text(false)));
    }
}
