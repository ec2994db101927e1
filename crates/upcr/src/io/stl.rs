//! STL, binary and ascii. Every triangle has its own three vertices, as in the file.

use crate::TriangleMesh;

use super::input::{Fallible, Input, malformed, position};
use super::scalar::{ByteOrder, Scalar};
use super::{Format, Reader};

pub(super) const FORMAT: Format =
    Format { name: "STL", extensions: &["stl"], read: Reader::Mesh(read), write: None, comments: None };

/// Bytes before the first triangle of a binary file, and of a triangle.
const HEADER: u64 = 84;
const TRIANGLE: u64 = 50;

fn read(input: &mut Input) -> Fallible<TriangleMesh> {
    let start = input.bytes(input.len.min(HEADER))?;
    let ascii = start.trim_ascii_start().starts_with(b"solid");
    if let Some(count) = start.get(80..).and_then(|c| c.first_chunk::<4>()) {
        let count = u64::from(u32::from_le_bytes(*count));
        let size = HEADER + count * TRIANGLE;
        // Binary files may start with `solid` too; their length tells them apart.
        if input.len == size || (!ascii && input.len > size) {
            return read_binary(input, count);
        }
        if !ascii {
            return malformed(format!("{count} triangles take {size} bytes, the file has {}", input.len));
        }
    }
    if !ascii {
        return malformed("it is neither binary nor starts with `solid`");
    }
    input.stream.seek_relative(-(start.len() as i64))?;
    read_ascii(input)
}

fn read_binary(input: &mut Input, count: u64) -> Fallible<TriangleMesh> {
    let mut mesh = TriangleMesh { vertices: Vec::with_capacity(3 * count as usize), triangles: Vec::new() };
    input.for_each_record(count, TRIANGLE as usize, |row| {
        // A normal of three floats, then the corners.
        for corner in 1..4 {
            let at = |axis: usize| Scalar::F32.decode(&row[4 * (3 * corner + axis)..], ByteOrder::Little);
            mesh.vertices.push([at(0), at(1), at(2)]);
        }
    })?;
    connect(mesh)
}

fn read_ascii(input: &mut Input) -> Fallible<TriangleMesh> {
    let mut mesh = TriangleMesh::default();
    let mut line = String::new();
    let mut ended = false;
    while input.line(&mut line)? {
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("vertex") => mesh.vertices.push(position(input, words)?),
            Some("endloop") if mesh.vertices.len() % 3 != 0 => {
                return input.bad_line("a facet that is no triangle");
            }
            Some(word) => ended = word == "endsolid",
            None => {}
        }
    }
    if !ended {
        return malformed("the file ends before `endsolid`");
    }
    connect(mesh)
}

/// Makes each three vertices a triangle.
fn connect(mut mesh: TriangleMesh) -> Fallible<TriangleMesh> {
    let Ok(count) = u32::try_from(mesh.vertices.len()) else { return malformed("more vertices than 2^32") };
    mesh.triangles = (0..count / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    Ok(mesh)
}
