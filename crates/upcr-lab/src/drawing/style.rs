//! Colours and letters of all pictures: those of the reports, whose style sheet is `web/report/style.css`.

/// A colour, by what it is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Color {
    /// Behind everything.
    Page,
    /// Behind what is measured.
    Canvas,
    /// Titles and names.
    Text,
    /// Axes and remarks.
    QuietText,
    /// Rules and borders.
    Line,
    /// What is there for comparison.
    Quiet,
    /// A series, by its index.
    Cloud(usize),
}

/// A colour on light pages and on dark ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tones {
    /// The colour's name, as the style sheet has it.
    pub name: &'static str,
    /// Red, green and blue on light pages.
    pub light: u32,
    /// Red, green and blue on dark pages.
    pub dark: u32,
}

const fn tones(name: &'static str, light: u32, dark: u32) -> Tones {
    Tones { name, light, dark }
}

/// All that pictures use of the reports' palette.
pub const PALETTE: [Tones; 12] = [
    tones("page", 0x00ff_ffff, 0x0017_1b1f),
    tones("canvas", 0x00f2_f4f5, 0x000e_1114),
    tones("text", 0x001b_2126, 0x00e5_e9ec),
    tones("quiet-text", 0x005a_656e, 0x009a_a6af),
    tones("line", 0x00d9_dee2, 0x002e_363d),
    tones("quiet", 0x00a9_b2b9, 0x004d_5860),
    tones("cloud-0", 0x00cf_5f0c, 0x00f7_a145),
    tones("cloud-1", 0x0011_678f, 0x004f_b0de),
    tones("cloud-2", 0x005f_8a1d, 0x00a3_cc5c),
    tones("cloud-3", 0x007d_55b5, 0x00b9_9bea),
    tones("cloud-4", 0x00b8_447e, 0x00ec_8bbb),
    tones("cloud-5", 0x006b_6357, 0x00b9_ad9c),
];
const CLOUDS: usize = 6;

/// The type that the reader's system has, as in the reports.
pub const FAMILY: &str = "system-ui, sans-serif";
/// Width of a series' line, in units.
pub const STROKE: f64 = 2.0;
/// Width of rules, in units.
pub const RULE: f64 = 1.0;
/// Radius of panels' corners, in units.
pub const ROUND: f64 = 6.0;

/// How text is set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Letters {
    /// Their size, in units.
    pub size: f64,
    /// Whether they are those of a title.
    pub strong: bool,
    /// Their colour.
    pub color: Color,
}

/// Letters of titles.
pub const TITLE: Letters = Letters { size: 16.0, strong: true, color: Color::Text };
/// Letters of names.
pub const NAME: Letters = Letters { size: 12.0, strong: false, color: Color::Text };
/// Letters of axes and remarks.
pub const QUIET: Letters = Letters { size: 12.0, strong: false, color: Color::QuietText };

impl Color {
    /// What it looks like; series beyond the last colour begin again at the first.
    pub fn tones(self) -> Tones {
        PALETTE[match self {
            Self::Page => 0,
            Self::Canvas => 1,
            Self::Text => 2,
            Self::QuietText => 3,
            Self::Line => 4,
            Self::Quiet => 5,
            Self::Cloud(index) => 6 + index % CLOUDS,
        }]
    }
}

impl Letters {
    /// From the middle of a line of text down to its baseline.
    pub fn drop(self) -> f64 {
        0.36 * self.size
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    /// The colours that follow a selector in the reports' style sheet.
    fn declared<'a>(sheet: &'a str, selector: &str) -> BTreeMap<&'a str, u32> {
        let (_, after) = sheet.split_once(selector).unwrap();
        let (block, _) = after.split_once('}').unwrap();
        let colors = block.split(';').filter_map(|line| line.trim().strip_prefix("--")?.split_once(": #"));
        let long = |hex: &str| match hex.len() {
            3 => hex.chars().flat_map(|digit| [digit, digit]).collect(),
            _ => hex.to_owned(),
        };
        colors.map(|(name, hex)| (name, u32::from_str_radix(&long(hex), 16).unwrap())).collect()
    }

    #[test]
    fn colors_and_type_are_those_of_the_reports() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../web/report/style.css");
        let sheet = std::fs::read_to_string(path).unwrap();
        let light = declared(&sheet, ":root {");
        let asked =
            declared(&sheet, "@media (prefers-color-scheme: dark) {\n  :root:not([data-theme=\"light\"]) {");
        let chosen = declared(&sheet, ":root[data-theme=\"dark\"] {");
        assert_eq!(asked, chosen);
        for Tones { name, light: on_light, dark: on_dark } in PALETTE {
            assert_eq!(light.get(name), Some(&on_light), "--{name} on light pages");
            assert_eq!(asked.get(name), Some(&on_dark), "--{name} on dark pages");
        }
        let clouds = light.keys().filter(|name| name.starts_with("cloud-")).count();
        assert_eq!(clouds, CLOUDS);
        assert!((0..CLOUDS).all(|index| Color::Cloud(index).tones().name == format!("cloud-{index}")));
        assert!(sheet.contains(&format!("font: 15px/1.5 {FAMILY};")));
    }
}
