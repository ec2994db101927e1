//! KITTI's velodyne scans: x, y, z and reflectance of each point as little-endian `f32`.

use std::io::Write;

use crate::PointCloud;

use super::columns::{Builder, Columns};
use super::input::{Fallible, Input, malformed, unsupported};
use super::output::Output;
use super::scalar::{ByteOrder, Scalar};
use super::{Format, ReadOptions, Reader, WriteOptions};

pub(super) const FORMAT: Format = Format {
    name: "KITTI",
    extensions: &["bin"],
    read: Reader::Cloud(read),
    write: Some(write),
    comments: None,
};

/// Bytes of a point.
const STRIDE: u64 = 16;

/// The scanner is at the origin, but the format does not say so, and other programs write moved clouds too:
/// no viewpoint is set.
fn read(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    if !input.len.is_multiple_of(STRIDE) {
        return malformed(format!("its {} bytes are not a multiple of {STRIDE}", input.len));
    }
    let count = input.len / STRIDE;
    let mut cloud = Builder::new(Columns::position([0, 1, 2]), count);
    input.for_each_record(count, STRIDE as usize, |row| {
        cloud.push(|c| Scalar::F32.decode(&row[4 * c..], ByteOrder::Little));
    })?;
    Ok(cloud.finish())
}

/// Coordinates are rounded to `f32`, the reflectance is 0.
fn write(out: &mut Output, cloud: &PointCloud, _: &WriteOptions) -> Fallible<()> {
    if cloud.is_empty() {
        return unsupported("a KITTI file without points would be an empty file");
    }
    for &[x, y, z] in &cloud.points {
        for v in [x as f32, y as f32, z as f32, 0.0] {
            out.write_all(&v.to_le_bytes())?;
        }
    }
    Ok(())
}
