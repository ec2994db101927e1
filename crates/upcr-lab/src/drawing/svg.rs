//! Pictures as SVG, which takes the reader's letters, and the reader's choice of light or dark.

use std::fmt::{Display, Formatter, Result, Write};

use super::style::{FAMILY, PALETTE, Tones};
use super::{Anchor, Color, DASH, Picture, Shape, Sheet};

/// The picture as SVG.
pub fn svg(picture: &impl Picture) -> String {
    let (width, height) = picture.size();
    let Sheet(shapes) = Sheet::of(picture);
    // Writing to a string cannot fail.
    let rules = |tone: fn(&Tones) -> u32| {
        PALETTE.iter().fold(String::new(), |mut rules, tones| {
            let _ = write!(rules, ".{}{{color:#{:06x}}}", tones.name, tone(tones));
            rules
        })
    };
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"{FAMILY}\">\n<style>\n{}\n@media (prefers-color-scheme:dark){{\n{}\n}}\n</style>\n",
        rules(|tones| tones.light),
        rules(|tones| tones.dark),
    );
    for shape in shapes {
        let _ = writeln!(text, "{shape}");
    }
    text + "</svg>\n"
}

impl Display for Shape {
    fn fmt(&self, f: &mut Formatter) -> Result {
        match self {
            Self::Line { points, width, dashed, color } => {
                let stroke = "fill=\"none\" stroke=\"currentColor\"";
                write!(
                    f,
                    "<polyline {} {stroke} stroke-width=\"{width}\" stroke-linejoin=\"round\"",
                    Class(*color)
                )?;
                if *dashed {
                    write!(f, " stroke-dasharray=\"{} {}\"", DASH.0, DASH.1)?;
                }
                write!(f, " points=\"{}\"/>", Points(points))
            }
            Self::Area { points, color } => {
                write!(f, "<polygon {} {FILL} points=\"{}\"/>", Class(*color), Points(points))
            }
            Self::Rectangle { corner: (x, y), size: (width, height), round, color } => {
                write!(
                    f,
                    "<rect {} {FILL} x=\"{}\" y=\"{}\" ",
                    Class(*color),
                    Hundredths(*x),
                    Hundredths(*y)
                )?;
                write!(f, "width=\"{}\" height=\"{}\" ", Hundredths(*width), Hundredths(*height))?;
                write!(f, "rx=\"{round}\"/>")
            }
            Self::Circle { center: (x, y), radius, color } => {
                let (x, y) = (Hundredths(*x), Hundredths(*y));
                write!(f, "<circle {} {FILL} cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"/>", Class(*color))
            }
            Self::Text { at: (x, y), text, letters, anchor } => {
                let (x, y) = (Hundredths(*x), Hundredths(*y));
                write!(f, "<text {} {FILL} x=\"{x}\" y=\"{y}\" ", Class(letters.color))?;
                write!(f, "font-size=\"{}\"", letters.size)?;
                if letters.strong {
                    f.write_str(" font-weight=\"600\"")?;
                }
                f.write_str(match anchor {
                    Anchor::Start => "",
                    Anchor::Middle => " text-anchor=\"middle\"",
                    Anchor::End => " text-anchor=\"end\"",
                })?;
                let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
                write!(f, ">{text}</text>")
            }
        }
    }
}

const FILL: &str = "fill=\"currentColor\"";

struct Class(Color);
struct Points<'a>(&'a [(f64, f64)]);
struct Hundredths(f64);

impl Display for Class {
    fn fmt(&self, f: &mut Formatter) -> Result {
        write!(f, "class=\"{}\"", self.0.tones().name)
    }
}

impl Display for Points<'_> {
    fn fmt(&self, f: &mut Formatter) -> Result {
        for (n, (x, y)) in self.0.iter().enumerate() {
            let space = if n == 0 { "" } else { " " };
            write!(f, "{space}{},{}", Hundredths(*x), Hundredths(*y))?;
        }
        Ok(())
    }
}

impl Display for Hundredths {
    fn fmt(&self, f: &mut Formatter) -> Result {
        // Adding zero makes -0 one.
        write!(f, "{}", (self.0 * 100.0).round() / 100.0 + 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{NAME, TITLE};
    use super::*;

    struct Everything;

    impl Picture for Everything {
        fn size(&self) -> (u32, u32) {
            (40, 30)
        }

        fn draw(&self, sheet: &mut Sheet) {
            sheet.line(vec![(-0.001, 1.0), (2.0, 1.0 / 3.0)], 2.0, Color::Cloud(7));
            sheet.dashes(vec![(0.0, 1.0), (2.0, 3.0)], 1.0, Color::Quiet);
            sheet.area(vec![(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], Color::Cloud(2));
            sheet.circle((5.0, 5.0), 2.5, Color::Cloud(0));
            sheet.text((3.0, 10.0), "a < b & c", TITLE, Anchor::Start);
            sheet.text((3.0, 20.0), "d", NAME, Anchor::End);
        }
    }

    #[test]
    fn shapes_have_classes_which_have_a_colour_by_day_and_one_by_night() {
        let svg = svg(&Everything);
        for part in [
            "<polyline class=\"cloud-1\" fill=\"none\" stroke=\"currentColor\" stroke-width=\"2\" stroke-linejoin=\"round\" points=\"0,1 2,0.33\"/>",
            "stroke-dasharray=\"5 4\"",
            "font-size=\"16\" font-weight=\"600\">a &lt; b &amp; c</text>",
            "text-anchor=\"end\">d</text>",
        ] {
            assert!(svg.contains(part), "{part}\n{svg}");
        }
        let (day, night) = svg.split_once("@media (prefers-color-scheme:dark){").unwrap();
        let (night, shapes) = night.split_once("</style>").unwrap();
        assert!(day.contains(".cloud-0{color:#cf5f0c}") && night.contains(".cloud-0{color:#f7a145}"));
        for class in shapes.split("class=\"").skip(1) {
            let rule = format!(".{}{{", class.split_once('"').unwrap().0);
            assert!(day.contains(&rule) && night.contains(&rule), "{rule}");
        }
        assert!(!shapes.contains('#'), "{shapes}");
    }
}
