//! XYZ, CSV, TXT: a point a line, numbers separated by blanks, tabs, commas or semicolons.
//!
//! A first line of names (also after `#` or `//`) tells the columns where it names x, y and z. Without one the
//! first three are the position; columns 4 to 6 and 7 to 9 are normals if all of them have unit length (or
//! are zero), colours if all of them are whole numbers from 0 to 255, and ignored otherwise, as are the rest.

use std::io::{self, Write};

use crate::PointCloud;

use super::columns::{Builder, Color, Columns};
use super::input::{Fallible, Input, malformed};
use super::output::Output;
use super::scalar::Scalar;
use super::{Format, ReadOptions, Reader, WriteOptions};

pub(super) const FORMAT: Format = Format {
    name: "XYZ",
    extensions: &["xyz", "csv", "txt", "xyzn", "xyzrgb", "asc"],
    read: Reader::Cloud(read),
    write: Some(write),
    comments: None,
};

/// How far a normal's squared length may be from 1, for files written with two digits.
const UNIT_TOLERANCE: f32 = 0.05;

fn read(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    let mut line = String::new();
    let mut named = None;
    let mut row: Vec<f64> = Vec::new();
    while input.line(&mut line)? {
        let text = line.trim_start_matches('\u{feff}').trim();
        let comment = text.strip_prefix("//").or_else(|| text.strip_prefix('#'));
        if let Some(names) = comment {
            named = named.or_else(|| by_header(names));
        } else if input.line_number == 1 && split(text).next().is_some_and(|w| w.parse::<f64>().is_err()) {
            named = by_header(text);
        } else if !text.is_empty() {
            parse(input, text, &mut row)?;
            let rows = Rows { row, line };
            return match named {
                Some(columns) => {
                    rows.read(input, Builder::new(columns, 0), columns.last(), Builder::push_row)
                }
                None => read_unnamed(input, rows),
            };
        }
    }
    // A file of nothing but a header is the cloud without points.
    match named {
        Some(columns) => Ok(Builder::new(columns, 0).finish()),
        None => malformed("there are no points and no names of columns"),
    }
}

impl Builder {
    fn push_row(&mut self, row: &[f64]) {
        self.push(|c| row[c]);
    }
}

/// Reads positions and up to two triples, which turn into normals or colours once all are known.
fn read_unnamed(input: &mut Input, rows: Rows) -> Fallible<PointCloud> {
    let triples = rows.row.len().min(9) / 3;
    let state = (Vec::new(), vec![Triples::default(); triples.saturating_sub(1)]);
    let (points, extra) = rows.read_with(input, state, 3 * triples.max(1) - 1, |(points, extra), row| {
        points.push([row[0], row[1], row[2]]);
        for (k, triple) in extra.iter_mut().enumerate() {
            triple.push([row[3 * k + 3] as f32, row[3 * k + 4] as f32, row[3 * k + 5] as f32]);
        }
    })?;
    let mut cloud = PointCloud::from_points(points);
    for triple in extra {
        if triple.are_normals() && cloud.normals.is_none() {
            cloud.normals = Some(triple.values);
        } else if !triple.not_colors && cloud.colors.is_none() {
            cloud.colors = Some(triple.values.iter().map(|t| t.map(|v| v as u8)).collect());
        }
    }
    Ok(cloud)
}

/// Three columns of yet unknown meaning.
#[derive(Clone, Default)]
struct Triples {
    values: Vec<[f32; 3]>,
    some_unit: bool,
    not_normals: bool,
    not_colors: bool,
}

impl Triples {
    fn push(&mut self, t: [f32; 3]) {
        let square: f32 = t.iter().map(|v| v * v).sum();
        let unit = (square - 1.0).abs() < UNIT_TOLERANCE;
        self.some_unit |= unit;
        self.not_normals |= !unit && square != 0.0;
        self.not_colors |= t.iter().any(|v| !(0.0..=255.0).contains(v) || v.fract() != 0.0);
        self.values.push(t);
    }

    fn are_normals(&self) -> bool {
        self.some_unit && !self.not_normals
    }
}

/// The first row, and the rest to come.
struct Rows {
    row: Vec<f64>,
    line: String,
}

impl Rows {
    fn read(
        self,
        input: &mut Input,
        builder: Builder,
        last: usize,
        push: impl Fn(&mut Builder, &[f64]),
    ) -> Fallible<PointCloud> {
        Ok(self.read_with(input, builder, last, push)?.finish())
    }

    /// Hands every row, each of more than `last` numbers, to `push`.
    fn read_with<S>(
        mut self,
        input: &mut Input,
        mut state: S,
        last: usize,
        push: impl Fn(&mut S, &[f64]),
    ) -> Fallible<S> {
        loop {
            if self.row.len() <= last {
                return input.bad_line(format!("{} numbers where {} are needed", self.row.len(), last + 1));
            }
            push(&mut state, &self.row);
            loop {
                if !input.line(&mut self.line)? {
                    return Ok(state);
                }
                let text = self.line.trim();
                if !(text.is_empty() || text.starts_with('#') || text.starts_with("//")) {
                    parse(input, text, &mut self.row)?;
                    break;
                }
            }
        }
    }
}

fn split(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| c.is_ascii_whitespace() || matches!(c, ',' | ';')).filter(|w| !w.is_empty())
}

fn parse(input: &Input, text: &str, row: &mut Vec<f64>) -> Fallible<()> {
    row.clear();
    for word in split(text) {
        match word.parse() {
            Ok(value) => row.push(value),
            // Names and classes may follow the numbers.
            Err(_) if row.len() >= 3 => row.push(f64::NAN),
            Err(_) => return input.bad_line(format!("`{word}` is not a number")),
        }
    }
    if row.len() < 3 {
        return input.bad_line("three coordinates are needed");
    }
    Ok(())
}

fn by_header(names: &str) -> Option<Columns> {
    let fields: Vec<_> = split(names).map(|w| (w.trim_matches('"'), Scalar::U8)).collect();
    let mut columns = Columns::by_name(&fields)?;
    // Packed colours are no text format's.
    columns.color = columns.color.filter(|c| matches!(c, Color::Channels { .. }));
    Some(columns)
}

/// With a comment that names the columns; numbers in the shortest form that reads back the same.
fn write(out: &mut Output, cloud: &PointCloud, _: &WriteOptions) -> Fallible<()> {
    write!(out, "# x y z")?;
    if cloud.normals.is_some() {
        write!(out, " nx ny nz")?;
    }
    if cloud.colors.is_some() {
        write!(out, " red green blue")?;
    }
    writeln!(out)?;
    for (i, p) in cloud.points.iter().enumerate() {
        write_row(out, p, cloud.normals.as_ref().map(|n| n[i]), cloud.colors.as_ref().map(|c| c[i]))?;
    }
    Ok(())
}

/// A line of position, normal and colour.
pub(super) fn write_row(
    out: &mut Output,
    [x, y, z]: &[f64; 3],
    normal: Option<[f32; 3]>,
    color: Option<[u8; 3]>,
) -> io::Result<()> {
    write!(out, "{x} {y} {z}")?;
    if let Some([x, y, z]) = normal {
        write!(out, " {x} {y} {z}")?;
    }
    if let Some([r, g, b]) = color {
        write!(out, " {r} {g} {b}")?;
    }
    writeln!(out)
}
