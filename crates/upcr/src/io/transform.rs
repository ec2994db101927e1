//! Rigid motions as text: a 4×4 matrix, row after row.

use std::io::{Read, Seek, Write};
use std::path::Path;

use crate::{Result, Rigid};

use super::input::{Fallible, Input, malformed};
use super::{explain, open, output::write_atomically, take};

const NAME: &str = "transform";

/// Reads a 4×4 row-major matrix, or its upper 3×4 part, as text. Blanks, commas, semicolons and brackets may
/// separate the numbers; `#` starts a comment.
///
/// # Errors
/// [`Error::Io`](crate::Error::Io), or [`Error::Malformed`](crate::Error::Malformed) where the numbers are not
/// a rigid motion.
pub fn read_transform(path: impl AsRef<Path>) -> Result<Rigid> {
    let path = path.as_ref();
    read_transform_from(path, open(path)?)
}

/// Reads a matrix as [`read_transform`] does, from memory or any stream; `name` stands for the path in errors.
///
/// # Errors
/// As [`read_transform`].
pub fn read_transform_from(name: impl AsRef<Path>, stream: impl Read + Seek) -> Result<Rigid> {
    take(name.as_ref(), NAME, stream, parse)
}

/// Writes the 4×4 row-major matrix as text, every number so that it reads back the same.
///
/// # Errors
/// [`Error::Io`](crate::Error::Io).
pub fn write_transform(path: impl AsRef<Path>, transform: &Rigid) -> Result<()> {
    let path = path.as_ref();
    write_atomically(path, |out| {
        for [a, b, c, d] in transform.to_rows() {
            writeln!(out, "{a} {b} {c} {d}")?;
        }
        Ok(())
    })
    .map_err(|fault| explain(path, NAME, fault))
}

fn parse(input: &mut Input) -> Fallible<Rigid> {
    let mut numbers = Vec::with_capacity(16);
    let mut line = String::new();
    while input.content_line(&mut line)? {
        let separator = |c: char| c.is_ascii_whitespace() || matches!(c, ',' | ';' | '[' | ']' | '(' | ')');
        for word in line.split(separator).filter(|w| !w.is_empty()) {
            let Ok(number) = word.parse::<f64>() else {
                return input.bad_line(format!("`{word}` is not a number"));
            };
            numbers.push(number);
        }
        if numbers.len() > 16 {
            break;
        }
    }
    if numbers.len() == 12 {
        numbers.extend([0.0, 0.0, 0.0, 1.0]);
    }
    if numbers.len() != 16 {
        return malformed("16 numbers are needed (4×4), or 12 (3×4)");
    }
    let mut rows = [[0.0; 4]; 4];
    rows.as_flattened_mut().copy_from_slice(&numbers);
    Rigid::from_rows(&rows).or_else(malformed)
}
