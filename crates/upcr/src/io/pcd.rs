//! PCD 0.7: `ascii`, `binary` and `binary_compressed`.

use std::io::Write;

use crate::PointCloud;

use super::columns::{Builder, Color, Columns};
use super::input::{Fallible, Input, Words, malformed, unsupported};
use super::output::Output;
use super::scalar::{ByteOrder, Scalar, fits_f32};
use super::{Encoding, Format, ReadOptions, Reader, WriteOptions, lzf};

pub(super) const FORMAT: Format = Format {
    name: "PCD",
    extensions: &["pcd"],
    read: Reader::Cloud(read),
    write: Some(write),
    comments: None,
};

/// Pose that stands for none: at the origin, not turned.
const NO_VIEWPOINT: [f64; 7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];

struct Field {
    name: String,
    scalar: Scalar,
    count: usize,
    /// First byte within a record.
    offset: usize,
    /// First number within a record.
    column: usize,
}

struct Header {
    fields: Vec<Field>,
    /// Numbers, and bytes, of a record.
    columns: usize,
    stride: usize,
    points: u64,
    viewpoint: Option<[f64; 3]>,
    data: String,
}

/// Points with a NaN coordinate are the format's own mark for "no return" and are dropped.
fn read(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    let header = read_header(input)?;
    let names: Vec<_> = header.fields.iter().map(|f| (f.name.as_str(), f.scalar)).collect();
    let Some(mut columns) = Columns::by_name(&names) else {
        return malformed("there are no fields x, y and z");
    };
    let Header { points, stride, .. } = header;
    if let Some(Color::Packed { float, .. }) = &mut columns.color {
        *float &= header.data == "ascii";
    }
    // A packed colour is taken bit by bit: as a float it may be a NaN, whose bits conversion changes.
    let scalar = |c: usize| match columns.color {
        Some(Color::Packed { column, .. }) if column == c => Scalar::U32,
        _ => header.fields[c].scalar,
    };
    let layout: Vec<_> = (0..header.fields.len()).map(|c| (header.fields[c].offset, scalar(c))).collect();
    let little = ByteOrder::Little;
    let mut cloud = match header.data.as_str() {
        "ascii" => {
            input.check_claim("points", points.saturating_sub(1), 2 * header.columns as u64)?;
            let mut cloud = Builder::new(columns, points);
            let mut words = Words::default();
            let mut row = vec![0.0; header.columns];
            for _ in 0..points {
                for value in &mut row {
                    *value = words.number(input)?;
                }
                push(&mut cloud, &columns, |c| row[header.fields[c].column]);
            }
            cloud
        }
        "binary" => {
            input.check_claim("points", points, stride as u64)?;
            let mut cloud = Builder::new(columns, points);
            input.for_each_record(points, stride, |row| {
                push(&mut cloud, &columns, |c| layout[c].1.decode(&row[layout[c].0..], little));
            })?;
            cloud
        }
        "binary_compressed" => {
            let bytes = read_compressed(input, points, stride)?;
            let mut cloud = Builder::new(columns, points);
            for i in 0..points as usize {
                // Field after field: all of the first, then all of the second.
                let at = |c: usize| {
                    let Field { offset, count, scalar, .. } = header.fields[c];
                    offset * points as usize + i * count * scalar.size()
                };
                push(&mut cloud, &columns, |c| layout[c].1.decode(&bytes[at(c)..], little));
            }
            cloud
        }
        other => return malformed(format!("unknown kind of DATA `{other}`")),
    }
    .finish();
    cloud.viewpoint = header.viewpoint;
    Ok(cloud)
}

fn push(cloud: &mut Builder, columns: &Columns, at: impl Fn(usize) -> f64) {
    if !columns.position.iter().any(|&c| at(c).is_nan()) {
        cloud.push(at);
    }
}

fn read_compressed(input: &mut Input, points: u64, stride: usize) -> Fallible<Vec<u8>> {
    let compressed = u64::from(u32::from_le_bytes(input.array()?));
    let size = u64::from(u32::from_le_bytes(input.array()?));
    if points.checked_mul(stride as u64) != Some(size) {
        return malformed(format!(
            "{points} points of {stride} bytes are not the {size} bytes that are compressed"
        ));
    }
    if size > compressed * lzf::GREATEST_RATIO {
        return malformed(format!("{compressed} compressed bytes cannot hold {size}"));
    }
    lzf::decompress(&input.bytes(compressed)?, size as usize)
}

fn read_header(input: &mut Input) -> Fallible<Header> {
    let mut line = String::new();
    let (mut names, mut sizes, mut kinds, mut counts) = (vec![], vec![], vec![], vec![]);
    let (mut width, mut height, mut points) = (None, 1, None);
    let mut viewpoint = NO_VIEWPOINT.to_vec();
    while input.content_line(&mut line)? {
        let mut words = line.split_ascii_whitespace();
        let keyword = words.next().unwrap_or_default();
        let words: Vec<&str> = words.collect();
        match keyword {
            "VERSION" => {}
            "FIELDS" | "COLUMNS" => names = words.iter().map(|w| (*w).to_owned()).collect(),
            "SIZE" => sizes = numbers::<usize>(input, &words)?,
            "TYPE" => kinds = words.iter().filter_map(|w| w.chars().next()).collect(),
            "COUNT" => counts = numbers::<usize>(input, &words)?,
            "WIDTH" => width = numbers::<u64>(input, &words)?.first().copied(),
            "HEIGHT" => height = numbers::<u64>(input, &words)?.first().copied().unwrap_or(1),
            "POINTS" => points = numbers::<u64>(input, &words)?.first().copied(),
            "VIEWPOINT" => viewpoint = numbers::<f64>(input, &words)?,
            "DATA" => {
                let grid = width.map(|w| w.checked_mul(height));
                let points = match (points, grid) {
                    (Some(points), None) => points,
                    (Some(points), Some(grid)) if grid == Some(points) => points,
                    (None, Some(Some(grid))) => grid,
                    _ => return malformed("WIDTH, HEIGHT and POINTS are missing or do not agree"),
                };
                if counts.is_empty() {
                    counts = vec![1; names.len()];
                }
                let (fields, columns, stride) = layout(names, &sizes, &kinds, &counts)?;
                let viewpoint = match viewpoint[..] {
                    [x, y, z, ..] if viewpoint != NO_VIEWPOINT => Some([x, y, z]),
                    _ => None,
                };
                let data = words.first().copied().unwrap_or_default().to_owned();
                return Ok(Header { fields, columns, stride, points, viewpoint, data });
            }
            _ => return input.bad_line(format!("`{keyword}` is not a header line")),
        }
    }
    malformed("the header has no DATA line")
}

fn numbers<T: std::str::FromStr>(input: &Input, words: &[&str]) -> Fallible<Vec<T>> {
    words
        .iter()
        .map(|w| w.parse().or_else(|_| input.bad_line(format!("`{w}` is not a number that may stand here"))))
        .collect()
}

fn layout(
    names: Vec<String>,
    sizes: &[usize],
    kinds: &[char],
    counts: &[usize],
) -> Fallible<(Vec<Field>, usize, usize)> {
    if [sizes.len(), kinds.len(), counts.len()] != [names.len(); 3] {
        return malformed("FIELDS, SIZE, TYPE and COUNT are not of one length");
    }
    let (mut offset, mut column) = (0usize, 0usize);
    let mut fields = Vec::with_capacity(names.len());
    for (i, name) in names.into_iter().enumerate() {
        let Some(scalar) = Scalar::from_kind(kinds[i], sizes[i]) else {
            return malformed(format!("field `{name}` has no known type: {}{}", kinds[i], sizes[i]));
        };
        // A record of more than this is nobody's, and would overflow what is computed from it.
        let count = counts[i];
        if column.saturating_add(count) > 1 << 20 {
            return malformed(format!("with field `{name}` a point has more than 2^20 values"));
        }
        // Without values a field is not there.
        let name = if count == 0 { String::new() } else { name };
        fields.push(Field { name, scalar, count, offset, column });
        offset += scalar.size() * count;
        column += count;
    }
    Ok((fields, column, offset))
}

fn write(out: &mut Output, cloud: &PointCloud, options: &WriteOptions) -> Fallible<()> {
    let size = if fits_f32(&cloud.points) { 4 } else { 8 };
    let mut fields = vec![("x", size), ("y", size), ("z", size)];
    if cloud.normals.is_some() {
        fields.extend([("normal_x", 4), ("normal_y", 4), ("normal_z", 4)]);
    }
    if cloud.colors.is_some() {
        fields.push(("rgb", 4));
    }
    let row = |value: &dyn Fn(&(&str, usize)) -> String| -> String {
        fields.iter().map(value).collect::<Vec<_>>().join(" ")
    };
    let [x, y, z] = cloud.viewpoint.unwrap_or_default();
    let n = cloud.len();
    writeln!(out, "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7")?;
    writeln!(out, "FIELDS {}", row(&|f| f.0.into()))?;
    writeln!(out, "SIZE {}", row(&|f| f.1.to_string()))?;
    writeln!(out, "TYPE {}\nCOUNT {}", row(&|_| "F".into()), row(&|_| "1".into()))?;
    writeln!(out, "WIDTH {n}\nHEIGHT 1\nVIEWPOINT {x} {y} {z} 1 0 0 0\nPOINTS {n}")?;

    let columns = fields.len();
    match options.encoding {
        Encoding::Ascii => {
            writeln!(out, "DATA ascii")?;
            for i in 0..n {
                for c in 0..columns {
                    let end = if c + 1 == columns { '\n' } else { ' ' };
                    match value(cloud, i, c) {
                        Value::Double(v) => write!(out, "{v}{end}"),
                        Value::Single(v) => write!(out, "{v:e}{end}"),
                    }?;
                }
            }
        }
        Encoding::Binary => {
            writeln!(out, "DATA binary")?;
            for i in 0..n {
                for c in 0..columns {
                    put(out, value(cloud, i, c), fields[c].1)?;
                }
            }
        }
        Encoding::Compressed => {
            writeln!(out, "DATA binary_compressed")?;
            let mut bytes = Vec::with_capacity(n * fields.iter().map(|f| f.1).sum::<usize>());
            for c in 0..columns {
                for i in 0..n {
                    put(&mut bytes, value(cloud, i, c), fields[c].1)?;
                }
            }
            let compressed = lzf::compress(&bytes);
            let (Ok(packed), Ok(plain)) = (u32::try_from(compressed.len()), u32::try_from(bytes.len()))
            else {
                return unsupported("compressed PCD holds at most 4 GiB");
            };
            out.write_all(&packed.to_le_bytes())?;
            out.write_all(&plain.to_le_bytes())?;
            out.write_all(&compressed)?;
        }
    }
    Ok(())
}

#[derive(Clone, Copy)]
enum Value {
    Double(f64),
    Single(f32),
}

/// What stands in column `c` of point `i`: x y z, then normal and packed colour where the cloud has them.
fn value(cloud: &PointCloud, i: usize, c: usize) -> Value {
    match (c, &cloud.normals, &cloud.colors) {
        (0..3, _, _) => Value::Double(cloud.points[i][c]),
        (3..6, Some(normals), _) => Value::Single(normals[i][c - 3]),
        (_, _, Some(colors)) => {
            let [r, g, b] = colors[i];
            Value::Single(f32::from_bits(u32::from_be_bytes([0, r, g, b])))
        }
        _ => Value::Single(0.0),
    }
}

fn put(out: &mut impl Write, value: Value, size: usize) -> std::io::Result<()> {
    match value {
        Value::Double(v) if size == 8 => out.write_all(&v.to_le_bytes()),
        Value::Double(v) => out.write_all(&(v as f32).to_le_bytes()),
        Value::Single(v) => out.write_all(&v.to_le_bytes()),
    }
}
