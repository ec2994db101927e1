//! OFF meshes, with the keyword's variants (COFF, NOFF, …) whose extra numbers are passed over.

use crate::TriangleMesh;

use super::input::{Fallible, Input, malformed, position, unsupported};
use super::{Format, Reader};

pub(super) const FORMAT: Format =
    Format { name: "OFF", extensions: &["off"], read: Reader::Mesh(read), write: None, comments: None };

fn read(input: &mut Input) -> Fallible<TriangleMesh> {
    let mut line = String::new();
    input.content_line(&mut line)?;
    let Some((prefix, rest)) = line.trim().split_once("OFF") else {
        return malformed("it does not start with `OFF`");
    };
    if !prefix.trim_start_matches("ST").chars().all(|c| matches!(c, 'C' | 'N')) {
        return unsupported(format!("the OFF variant `{prefix}OFF` is not known"));
    }
    // Some files, ModelNet's among them, have the counts glued to the keyword.
    let mut counts = rest.trim().to_owned();
    if counts.starts_with("BINARY") {
        return unsupported("binary OFF files cannot be read");
    }
    if counts.is_empty() {
        input.content_line(&mut counts)?;
    }
    let counts: Option<Vec<u64>> = counts.split_ascii_whitespace().map(|w| w.parse().ok()).collect();
    let Some(&[vertices, faces, ..]) = counts.as_deref() else {
        return input.bad_line("counts of vertices, faces and edges are needed");
    };
    // The shortest line of a vertex is `0 0 0`, of a face `0`, each with its end.
    input.check_claim("vertices", vertices.saturating_sub(1), 6)?;
    input.check_claim("faces", faces.saturating_sub(1), 2)?;

    let mut mesh = TriangleMesh { vertices: Vec::with_capacity(vertices as usize), triangles: Vec::new() };
    for _ in 0..vertices {
        next_line(input, &mut line)?;
        mesh.vertices.push(position(input, line.split_ascii_whitespace())?);
    }
    let mut corners = Vec::new();
    for _ in 0..faces {
        next_line(input, &mut line)?;
        let mut words = line.split_ascii_whitespace().map(str::parse::<u32>);
        let Some(Ok(sides)) = words.next() else {
            return input.bad_line("a face starts with its corner count");
        };
        corners.clear();
        for _ in 0..sides {
            let Some(Ok(corner)) = words.next() else {
                return input
                    .bad_line(format!("a face of {sides} corners lacks some, or they are no indices"));
            };
            corners.push(corner);
        }
        super::push_fan(&corners, &mut mesh.triangles);
    }
    super::check_indices(&mesh)?;
    Ok(mesh)
}

fn next_line(input: &mut Input, line: &mut String) -> Fallible<()> {
    if input.content_line(line)? { Ok(()) } else { malformed("the file ends too early") }
}
