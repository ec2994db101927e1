//! LAS 1.0 to 1.4, and LAZ, its compressed form.

mod gps_time;
mod header;
mod laz;

use std::io::{Seek, SeekFrom, Write};

use crate::PointCloud;

use super::input::{Fallible, Input};
use super::output::Output;
use super::{Format, ReadOptions, Reader, WriteOptions};
use header::Header;

pub(super) const FORMAT: Format = Format {
    name: "LAS",
    extensions: &["las"],
    read: Reader::Cloud(read),
    write: Some(write_las),
    comments: None,
};

pub(super) const COMPRESSED: Format = Format {
    name: "LAZ",
    extensions: &["laz"],
    read: Reader::Cloud(read),
    write: Some(write_laz),
    comments: None,
};

/// Records written in one go.
const BATCH: usize = 50_000;

/// First and only return of its pulse.
const SINGLE_RETURN: u8 = 0b0000_1001;

/// Points and colours as they stand in the records; the colours still of 16 bits.
#[derive(Default)]
struct Points {
    points: Vec<[f64; 3]>,
    colors: Vec<[u16; 3]>,
}

impl Points {
    #[inline]
    fn push(&mut self, header: &Header, record: &[u8]) {
        let word = |at: usize| u16::from_le_bytes([record[at], record[at + 1]]);
        let axis = |k: usize| {
            let raw =
                i32::from_le_bytes([record[4 * k], record[4 * k + 1], record[4 * k + 2], record[4 * k + 3]]);
            f64::from(raw) * header.scale[k] + header.offset[k]
        };
        self.points.push([axis(0), axis(1), axis(2)]);
        if let Some(at) = header.color_at {
            self.colors.push([word(at), word(at + 2), word(at + 4)]);
        }
    }

    fn append(&mut self, mut other: Self) {
        self.points.append(&mut other.points);
        self.colors.append(&mut other.colors);
    }
}

/// Colours have 16 bits by the standard; where none exceeds 255 they are taken to have 8, as many files do.
fn read(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    let header = header::read(input)?;
    input.stream.seek(SeekFrom::Start(header.points_at))?;
    let points = if header.count == 0 {
        Points::default()
    } else if header.compressed {
        laz::read(input, &header)?
    } else {
        input.check_claim("points", header.count, u64::from(header.record_length))?;
        let count = header.count as usize;
        let colors = Vec::with_capacity(if header.color_at.is_some() { count } else { 0 });
        let mut points = Points { points: Vec::with_capacity(count), colors };
        input.for_each_record(header.count, usize::from(header.record_length), |record| {
            points.push(&header, record);
        })?;
        points
    };
    let Points { points, colors } = points;
    let eight_bits = colors.iter().flatten().all(|&v| v <= 255);
    let to_byte = |v: u16| if eight_bits { v as u8 } else { (v >> 8) as u8 };
    let colors = header.color_at.map(|_| colors.iter().map(|c| c.map(to_byte)).collect());
    Ok(PointCloud { points, colors, ..PointCloud::default() })
}

fn write_las(out: &mut Output, cloud: &PointCloud, _: &WriteOptions) -> Fallible<()> {
    let header = Header::for_cloud(cloud)?;
    header::write(out, &header, cloud, &[])?;
    for_each_batch(cloud, &header, |batch| Ok(out.write_all(batch)?))
}

fn write_laz(out: &mut Output, cloud: &PointCloud, _: &WriteOptions) -> Fallible<()> {
    let header = Header { compressed: true, ..Header::for_cloud(cloud)? };
    laz::write(out, &header, cloud)
}

/// Hands the cloud's records to `write`, a batch at a time.
fn for_each_batch(
    cloud: &PointCloud,
    header: &Header,
    mut write: impl FnMut(&[u8]) -> Fallible<()>,
) -> Fallible<()> {
    let length = usize::from(header.record_length);
    let mut batch = Vec::with_capacity(cloud.len().min(BATCH) * length);
    for (i, point) in cloud.points.iter().enumerate() {
        let start = batch.len();
        for (axis, v) in point.iter().enumerate() {
            let steps = ((v - header.offset[axis]) / header.scale[axis]).round() as i32;
            batch.extend(steps.to_le_bytes());
        }
        batch.resize(start + length, 0);
        batch[start + 14] = SINGLE_RETURN;
        if let (Some(at), Some(colors)) = (header.color_at, &cloud.colors) {
            for (k, &v) in colors[i].iter().enumerate() {
                let at = start + at + 2 * k;
                batch[at..at + 2].copy_from_slice(&(u16::from(v) * 257).to_le_bytes());
            }
        }
        if batch.len() == BATCH * length {
            write(&batch)?;
            batch.clear();
        }
    }
    if batch.is_empty() { Ok(()) } else { write(&batch) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::{ReadOptions, output::write_atomically};

    /// A cloud written in point format 7, whose compression is in layers.
    fn layered() -> (PointCloud, Vec<u8>) {
        let points = (0..500).map(|i| [f64::from(i) * 0.5, f64::from(i % 13), -f64::from(i % 7)]).collect();
        let colors = (0..500u16).map(|i| [i as u8, 255 - (i as u8), 7]).collect();
        let cloud = PointCloud { colors: Some(colors), ..PointCloud::from_points(points) };
        let base = Header::for_cloud(&cloud).unwrap();
        let header =
            Header { compressed: true, point_format: 7, record_length: 36, color_at: Some(30), ..base };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.laz");
        write_atomically(&path, |out| laz::write(out, &header, &cloud)).unwrap();
        (cloud, std::fs::read(path).unwrap())
    }

    fn read_bytes(bytes: &[u8]) -> Fallible<PointCloud> {
        read(&mut Input::new(std::io::Cursor::new(bytes.to_vec()))?, &ReadOptions::default())
    }

    #[test]
    fn layered_compression_comes_back() {
        let (cloud, file) = layered();
        assert_eq!(read_bytes(&file).unwrap(), cloud);
    }

    #[test]
    fn damaged_layers_are_an_error_or_a_cloud() {
        let (_, file) = layered();
        for at in (100..file.len()).step_by(19) {
            let mut damaged = file.clone();
            damaged[at] ^= 0xff;
            let _ = read_bytes(&damaged);
        }
    }
}
