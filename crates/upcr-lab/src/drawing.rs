//! Pictures that are readable in print and by the colour-blind, as SVG and as PNG.

use std::error::Error as StdError;
use std::sync::Once;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, RGBColor, register_font};
use upcr::{Error, Result};

/// Colours that the colour-blind can tell apart (Okabe and Ito), dark enough for white paper.
pub const COLORS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];
/// Letters of axes and legends, in units; captions are larger.
pub const LETTERS: u32 = 13;
/// Letters of captions.
pub const CAPTION: u32 = 18;
/// PNG pixels a unit of the picture.
const PIXELS: u32 = 2;

/// What drawing ends with.
pub type Drawn = std::result::Result<(), Box<dyn StdError>>;

/// Something that can be drawn on any backend.
pub trait Picture {
    /// Width and height.
    fn size(&self) -> (u32, u32);

    /// Draws everything, with lengths times `unit`.
    ///
    /// # Errors
    /// Where the backend fails.
    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, unit: u32) -> Drawn
    where
        B::ErrorType: 'static;
}

/// The picture as SVG.
///
/// # Errors
/// Where it cannot be drawn.
pub fn svg(picture: &impl Picture) -> Result<String> {
    prepare_fonts();
    let mut text = String::new();
    let area = SVGBackend::with_string(&mut text, picture.size()).into_drawing_area();
    drawn(picture, &area, 1)?;
    drop(area);
    Ok(text)
}

/// The picture as PNG, in twice its size.
///
/// # Errors
/// Where it cannot be drawn.
pub fn png(picture: &impl Picture) -> Result<Vec<u8>> {
    prepare_fonts();
    let (width, height) = picture.size();
    let (width, height) = (width * PIXELS, height * PIXELS);
    let mut pixels = vec![255; (width * height * 3) as usize];
    let area = BitMapBackend::with_buffer(&mut pixels, (width, height)).into_drawing_area();
    drawn(picture, &area, PIXELS)?;
    drop(area);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    let write = || {
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&pixels)?;
        writer.finish()
    };
    write().map_err(|e| failed(&e))?;
    Ok(bytes)
}

/// A font of so many units.
pub fn font(size: u32, unit: u32) -> (&'static str, u32) {
    ("sans-serif", size * unit)
}

fn drawn<B: DrawingBackend>(picture: &impl Picture, area: &DrawingArea<B, Shift>, unit: u32) -> Result<()>
where
    B::ErrorType: 'static,
{
    let draw = || -> Drawn {
        area.fill(&WHITE)?;
        picture.draw(area, unit)?;
        Ok(area.present()?)
    };
    draw().map_err(|e| failed(e.as_ref()))
}

fn failed(error: &dyn StdError) -> Error {
    Error::InvalidSetting { name: "plot", reason: error.to_string() }
}

/// Letters come with the program: bitmaps are the same on every machine.
fn prepare_fonts() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // A font that cannot be read makes drawing fail, which is told there.
        let _ = register_font("sans-serif", FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT);
    });
}
