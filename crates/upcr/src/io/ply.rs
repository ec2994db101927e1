//! PLY: ascii and binary of both byte orders.

use std::io::Write;

use crate::{PointCloud, TriangleMesh};

use super::columns::{Builder, Columns};
use super::input::{Fallible, Input, Words, malformed, unsupported};
use super::output::Output;
use super::scalar::{ByteOrder, Scalar, fits_f32};
use super::{Encoding, Format, ReadOptions, Reader, WriteOptions};

pub(super) const FORMAT: Format = Format {
    name: "PLY",
    extensions: &["ply"],
    read: Reader::CloudOrMesh(read_cloud, read_mesh),
    write: Some(write),
    comments: Some(read_comments),
};

/// Type of a property.
#[derive(Clone, Copy)]
enum Kind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

struct Property {
    name: String,
    kind: Kind,
}

struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

impl Element {
    /// Names and types, where every property is a scalar.
    fn scalars(&self) -> Option<Vec<(&str, Scalar)>> {
        let scalar = |p: &Property| match p.kind {
            Kind::Scalar(scalar) => Some(scalar),
            Kind::List { .. } => None,
        };
        self.properties.iter().map(|p| Some((p.name.as_str(), scalar(p)?))).collect()
    }

    /// Fewest bytes that a row takes.
    fn least_size(&self, body: &Body) -> u64 {
        let size = |p: &Property| match (body, p.kind) {
            // A digit and a blank.
            (Body::Ascii(_), _) => 2,
            (Body::Binary(_), Kind::Scalar(scalar)) => scalar.size(),
            (Body::Binary(_), Kind::List { count, .. }) => count.size(),
        };
        self.properties.iter().map(size).sum::<usize>() as u64
    }
}

/// How the numbers after the header are stored.
enum Body {
    Ascii(Words),
    Binary(ByteOrder),
}

impl Body {
    fn value(&mut self, input: &mut Input, scalar: Scalar) -> Fallible<f64> {
        match self {
            Self::Ascii(words) => words.number(input),
            Self::Binary(order) => {
                let mut bytes = [0; 8];
                std::io::Read::read_exact(&mut input.stream, &mut bytes[..scalar.size()])?;
                Ok(scalar.decode(&bytes, *order))
            }
        }
    }

    fn list(&mut self, input: &mut Input, count: Scalar, item: Scalar, items: &mut Vec<f64>) -> Fallible<()> {
        let length = self.value(input, count)?;
        if length < 0.0 || length.fract() != 0.0 {
            return malformed(format!("a list of length {length}"));
        }
        items.clear();
        // Grows with what is really there, whatever the length claims.
        for _ in 0..length as u64 {
            items.push(self.value(input, item)?);
        }
        Ok(())
    }
}

fn read_cloud(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    let (elements, mut body) = read_header(input)?;
    for element in &elements {
        if element.name == "vertex" {
            return read_vertices(input, element, &mut body);
        }
        skip(input, element, &mut body)?;
    }
    malformed("there is no `vertex` element")
}

fn read_mesh(input: &mut Input) -> Fallible<TriangleMesh> {
    let (elements, mut body) = read_header(input)?;
    let mut mesh = TriangleMesh::default();
    for element in &elements {
        match element.name.as_str() {
            "vertex" => mesh.vertices = read_vertices(input, element, &mut body)?.points,
            "face" => read_faces(input, element, &mut body, &mut mesh.triangles)?,
            _ => skip(input, element, &mut body)?,
        }
    }
    super::check_indices(&mesh)?;
    Ok(mesh)
}

/// What the header says to people.
fn read_comments(input: &mut Input) -> Fallible<Vec<String>> {
    let mut line = String::new();
    let mut comments = Vec::new();
    while input.line(&mut line)? && line.trim_end() != "end_header" {
        let said = ["comment", "obj_info"].iter().find_map(|word| line.strip_prefix(word));
        comments.extend(said.filter(|text| text.starts_with([' ', '\t'])).map(|text| text.trim().to_owned()));
    }
    Ok(comments)
}

fn read_header(input: &mut Input) -> Fallible<(Vec<Element>, Body)> {
    let mut line = String::new();
    if !input.line(&mut line)? || line.trim_end() != "ply" {
        return malformed("the first line is not `ply`");
    }
    let mut body = None;
    let mut elements: Vec<Element> = Vec::new();
    while input.line(&mut line)? {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => {
                let Some(body) = body else { return malformed("the header has no `format` line") };
                return Ok((elements, body));
            }
            ["comment" | "obj_info", ..] | [] => {}
            ["format", encoding, _] => {
                body = Some(match *encoding {
                    "ascii" => Body::Ascii(Words::default()),
                    "binary_little_endian" => Body::Binary(ByteOrder::Little),
                    "binary_big_endian" => Body::Binary(ByteOrder::Big),
                    other => return input.bad_line(format!("unknown encoding `{other}`")),
                });
            }
            ["element", name, count] => {
                let Ok(count) = count.parse() else {
                    return input.bad_line(format!("`{count}` is not a count"));
                };
                elements.push(Element { name: (*name).into(), count, properties: Vec::new() });
            }
            ["property", kind @ .., name] => {
                let kind = match kind {
                    [scalar] => scalar_named(scalar).map(Kind::Scalar),
                    ["list", count, item] => scalar_named(count)
                        .zip(scalar_named(item))
                        .map(|(count, item)| Kind::List { count, item }),
                    _ => None,
                };
                match (kind, elements.last_mut()) {
                    (Some(kind), Some(element)) => {
                        element.properties.push(Property { name: (*name).into(), kind });
                    }
                    (None, _) => return input.bad_line(format!("unknown property type in `{line}`")),
                    (_, None) => return input.bad_line("a property before any element"),
                }
            }
            _ => return input.bad_line(format!("`{line}` is not a header line")),
        }
    }
    malformed("the header has no end")
}

fn scalar_named(name: &str) -> Option<Scalar> {
    Some(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "int64" => Scalar::I64,
        "uint64" => Scalar::U64,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        _ => return None,
    })
}

fn read_vertices(input: &mut Input, element: &Element, body: &mut Body) -> Fallible<PointCloud> {
    // A list stands in its column as a zero.
    let fields: Vec<(&str, Scalar)> = (element.properties.iter())
        .map(|p| match p.kind {
            Kind::Scalar(scalar) => (p.name.as_str(), scalar),
            Kind::List { .. } => ("", Scalar::U8),
        })
        .collect();
    let Some(columns) = Columns::by_name(&fields) else {
        return malformed("the vertices lack x, y or z");
    };
    check_claim(input, element, body)?;
    let mut cloud = Builder::new(columns, element.count);
    if let (Body::Binary(order), Some(scalars)) = (&body, element.scalars()) {
        let mut stride = 0;
        let offsets: Vec<(usize, Scalar)> = (scalars.iter())
            .map(|&(_, scalar)| {
                stride += scalar.size();
                (stride - scalar.size(), scalar)
            })
            .collect();
        let order = *order;
        input.for_each_record(element.count, stride, |row| {
            cloud.push(|c| offsets[c].1.decode(&row[offsets[c].0..], order));
        })?;
        return Ok(cloud.finish());
    }
    let mut row = vec![0.0; element.properties.len()];
    let mut items = Vec::new();
    for _ in 0..element.count {
        for (value, property) in row.iter_mut().zip(&element.properties) {
            match property.kind {
                Kind::Scalar(scalar) => *value = body.value(input, scalar)?,
                Kind::List { count, item } => body.list(input, count, item, &mut items)?,
            }
        }
        cloud.push(|c| row[c]);
    }
    Ok(cloud.finish())
}

fn read_faces(
    input: &mut Input,
    element: &Element,
    body: &mut Body,
    triangles: &mut Vec<[u32; 3]>,
) -> Fallible<()> {
    check_claim(input, element, body)?;
    if element.properties.is_empty() {
        return Ok(());
    }
    let (mut corners, mut items) = (Vec::new(), Vec::new());
    for _ in 0..element.count {
        for property in &element.properties {
            match property.kind {
                Kind::Scalar(scalar) => {
                    body.value(input, scalar)?;
                }
                Kind::List { count, item } => {
                    body.list(input, count, item, &mut items)?;
                    if matches!(property.name.as_str(), "vertex_indices" | "vertex_index") {
                        corners.clear();
                        // An index below zero or above u32 saturates, and is found out of range later.
                        corners.extend(items.iter().map(|&i| if i < 0.0 { u32::MAX } else { i as u32 }));
                        super::push_fan(&corners, triangles);
                    }
                }
            }
        }
    }
    Ok(())
}

fn skip(input: &mut Input, element: &Element, body: &mut Body) -> Fallible<()> {
    check_claim(input, element, body)?;
    match (&body, element.scalars()) {
        (Body::Binary(_), Some(_)) => input.skip(element.count * element.least_size(body)),
        _ => read_faces(input, element, body, &mut Vec::new()),
    }
}

fn check_claim(input: &mut Input, element: &Element, body: &Body) -> Fallible<()> {
    let what = format!("`{}` rows", element.name);
    match body {
        // The last number needs no blank after it.
        Body::Ascii(_) if element.count == 1 => Ok(()),
        Body::Ascii(_) => input.check_claim(&what, element.count.saturating_sub(1), element.least_size(body)),
        Body::Binary(_) => input.check_claim(&what, element.count, element.least_size(body)),
    }
}

/// Coordinates are written as `float` where that loses nothing, else as `double`. The viewpoint is not kept.
fn write(out: &mut Output, cloud: &PointCloud, options: &WriteOptions) -> Fallible<()> {
    let (ascii, encoding) = match options.encoding {
        Encoding::Ascii => (true, "ascii"),
        Encoding::Binary => (false, "binary_little_endian"),
        Encoding::Compressed => return unsupported("PLY has no compressed encoding"),
    };
    let single = fits_f32(&cloud.points);
    let coordinate = if single { "float" } else { "double" };
    writeln!(out, "ply\nformat {encoding} 1.0\nelement vertex {}", cloud.len())?;
    for name in ["x", "y", "z"] {
        writeln!(out, "property {coordinate} {name}")?;
    }
    if cloud.normals.is_some() {
        writeln!(out, "property float nx\nproperty float ny\nproperty float nz")?;
    }
    if cloud.colors.is_some() {
        writeln!(out, "property uchar red\nproperty uchar green\nproperty uchar blue")?;
    }
    writeln!(out, "end_header")?;
    for (i, p) in cloud.points.iter().enumerate() {
        let normal = cloud.normals.as_ref().map(|n| n[i]);
        let color = cloud.colors.as_ref().map(|c| c[i]);
        if ascii {
            super::xyz::write_row(out, p, normal, color)?;
            continue;
        }
        for &v in p {
            if single { out.write_all(&(v as f32).to_le_bytes()) } else { out.write_all(&v.to_le_bytes()) }?;
        }
        for v in normal.into_iter().flatten() {
            out.write_all(&v.to_le_bytes())?;
        }
        out.write_all(color.as_ref().map_or(&[], |c| c.as_slice()))?;
    }
    Ok(())
}
