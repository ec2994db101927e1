//! Wavefront OBJ: `v` and `f` lines; everything else is passed over.

use crate::TriangleMesh;

use super::input::{Fallible, Input, malformed, position};
use super::{Format, Reader};

pub(super) const FORMAT: Format =
    Format { name: "OBJ", extensions: &["obj"], read: Reader::Mesh(read), write: None, comments: None };

fn read(input: &mut Input) -> Fallible<TriangleMesh> {
    let mut mesh = TriangleMesh::default();
    let mut line = String::new();
    let mut corners = Vec::new();
    while input.content_line(&mut line)? {
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => mesh.vertices.push(position(input, words)?),
            Some("f") => {
                corners.clear();
                for word in words {
                    let Some(corner) = vertex_index(word, mesh.vertices.len()) else {
                        return input.bad_line(format!("`{word}` names no vertex"));
                    };
                    corners.push(corner);
                }
                super::push_fan(&corners, &mut mesh.triangles);
            }
            _ => {}
        }
    }
    if mesh.vertices.is_empty() {
        return malformed("there are no vertices");
    }
    super::check_indices(&mesh)?;
    Ok(mesh)
}

/// Index of the vertex that `v`, `v/vt`, `v//vn` or `v/vt/vn` names: counted from 1, or, negative, back from
/// the last of the `count` vertices so far.
fn vertex_index(corner: &str, count: usize) -> Option<u32> {
    let number: i64 = corner.split('/').next()?.parse().ok()?;
    let index = if number < 0 { number + count as i64 } else { number - 1 };
    u32::try_from(index).ok()
}
