//! NPY: an array of n rows and three or more columns, of which the first three are the position.

use std::io::Write;
use std::path::Path;

use crate::{PointCloud, Result};

use super::columns::{Builder, Columns};
use super::input::{Fallible, Input, malformed, unsupported};
use super::output::{Output, write_atomically};
use super::scalar::{ByteOrder, Scalar};
use super::{Format, ReadOptions, Reader, WriteOptions, explain};

pub(super) const FORMAT: Format = Format {
    name: "NPY",
    extensions: &["npy"],
    read: Reader::Cloud(read),
    write: Some(write),
    comments: None,
};

const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// Longest header that is taken for one.
const LONGEST_HEADER: u64 = 1 << 16;

/// What an array is told to be.
struct Header {
    scalar: Scalar,
    order: ByteOrder,
    /// Column after column instead of row after row.
    fortran: bool,
    rows: u64,
    columns: u64,
}

fn read(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    let Header { scalar, order, fortran, rows, columns } = read_header(input)?;
    let size = scalar.size();
    let Some(stride) = columns.checked_mul(size as u64) else {
        return malformed(format!("{columns} columns"));
    };
    if rows > 0 {
        input.check_claim("rows", rows, stride)?;
    }
    if !fortran {
        let mut cloud = Builder::new(Columns::position([0, 1, 2]), rows);
        input.for_each_record(rows, if rows > 0 { stride as usize } else { 1 }, |row| {
            cloud.push(|c| scalar.decode(&row[c * size..], order));
        })?;
        return Ok(cloud.finish());
    }
    let mut points = vec![[0.0; 3]; rows as usize];
    for axis in 0..3 {
        let mut point = points.iter_mut();
        input.for_each_record(rows, size, |value| {
            if let Some(point) = point.next() {
                point[axis] = scalar.decode(value, order);
            }
        })?;
    }
    Ok(PointCloud::from_points(points))
}

fn read_header(input: &mut Input) -> Fallible<Header> {
    if input.array()? != *MAGIC {
        return malformed("it does not start with NumPy's magic bytes");
    }
    let length = match input.array()? {
        [1, _] => u64::from(u16::from_le_bytes(input.array()?)),
        [2 | 3, _] => u64::from(u32::from_le_bytes(input.array()?)),
        [major, minor] => return unsupported(format!("NPY version {major}.{minor} is not known")),
    };
    if length > LONGEST_HEADER {
        return malformed(format!("a header of {length} bytes"));
    }
    let header = input.bytes(length)?;
    let header = String::from_utf8_lossy(&header);
    let Some(descr) = entry(&header, "descr").and_then(|v| v.strip_prefix(['\'', '"'])) else {
        return unsupported("only plain arrays can be read, not structured ones");
    };
    let descr = descr.split(['\'', '"']).next().unwrap_or_default();
    let fortran = entry(&header, "fortran_order").is_some_and(|v| v.starts_with("True"));
    let shape: Option<Vec<u64>> = entry(&header, "shape").and_then(|v| {
        let (inside, _) = v.strip_prefix('(')?.split_once(')')?;
        inside.split(',').map(str::trim).filter(|n| !n.is_empty()).map(|n| n.parse().ok()).collect()
    });
    let Some(shape) = shape else { return malformed("the header tells no shape") };
    let (&[rows, columns], true) = (&shape[..], shape.get(1).is_some_and(|&c| c >= 3)) else {
        return unsupported(format!("an array of shape {shape:?} is not n rows of three or more columns"));
    };
    let mut kind = descr.chars();
    let order = if kind.next() == Some('>') { ByteOrder::Big } else { ByteOrder::Little };
    let letter = kind.next().unwrap_or_default();
    match kind.as_str().parse().ok().and_then(|size| Scalar::from_kind(letter, size)) {
        Some(scalar) => Ok(Header { scalar, order, fortran, rows, columns }),
        None => unsupported(format!("numbers of type `{descr}` cannot be read")),
    }
}

/// What follows `'key':` in the header.
fn entry<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let after = ["'", "\""].iter().find_map(|q| Some(header.split_once(&format!("{q}{key}{q}"))?.1))?;
    Some(after.trim_start().strip_prefix(':')?.trim_start())
}

/// An n by 3 array of `f64`; normals, colours and viewpoint are not kept.
fn write(out: &mut Output, cloud: &PointCloud, _: &WriteOptions) -> Fallible<()> {
    write_header(out, "<f8", [cloud.len(), 3])?;
    for v in cloud.points.iter().flatten() {
        out.write_all(&v.to_le_bytes())?;
    }
    Ok(())
}

/// Writes a rows by columns array of `f32`, such as descriptors, as a NumPy file.
///
/// The file appears whole or not at all.
///
/// # Errors
/// [`Error::Io`](crate::Error::Io), or [`Error::Unsupported`](crate::Error::Unsupported) where the shape is not that of the values.
pub fn write_array(path: impl AsRef<Path>, [rows, columns]: [usize; 2], values: &[f32]) -> Result<()> {
    let path = path.as_ref();
    let write = |out: &mut Output| {
        if rows.checked_mul(columns) != Some(values.len()) {
            return unsupported(format!("{} values are not {rows} rows of {columns}", values.len()));
        }
        write_header(out, "<f4", [rows, columns])?;
        for v in values {
            out.write_all(&v.to_le_bytes())?;
        }
        Ok(())
    };
    write_atomically(path, write).map_err(|fault| explain(path, FORMAT.name, fault))
}

fn write_header(out: &mut Output, dtype: &str, [rows, columns]: [usize; 2]) -> Fallible<()> {
    let dict = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // The data start at a multiple of 64 bytes; magic, version and length take ten, the line's end one.
    let padded = (dict.len() + 11).next_multiple_of(64) - 11;
    out.write_all(MAGIC)?;
    out.write_all(&[1, 0])?;
    out.write_all(&(padded as u16 + 1).to_le_bytes())?;
    writeln!(out, "{dict:padded$}")?;
    Ok(())
}
