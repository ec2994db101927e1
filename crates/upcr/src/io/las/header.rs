//! The public header of LAS.

use std::io::{Seek, SeekFrom, Write};

use crate::PointCloud;

use super::super::check_finite;
use super::super::input::{Fallible, Input, malformed, unsupported};
use super::super::output::Output;

/// Length of the header up to version 1.2, which every version has, and of version 1.4.
const LENGTH: u16 = 227;
const LENGTH_1_4: usize = 375;

/// Length of the part of a variable length record that comes before its data.
pub(super) const RECORD_HEADER: usize = 54;

/// Length of the records of each point format, and where their colour is.
const POINT_FORMATS: [(u16, Option<usize>); 11] = [
    (20, None),
    (28, None),
    (26, Some(20)),
    (34, Some(28)),
    (57, None),
    (63, Some(28)),
    (30, None),
    (36, Some(30)),
    (38, Some(30)),
    (59, None),
    (67, Some(30)),
];

/// Finest step that coordinates are written in.
const FINEST_DECADE: i32 = 9;

/// What the header says about the points.
#[derive(Debug, Clone)]
pub(super) struct Header {
    pub(super) count: u64,
    pub(super) compressed: bool,
    pub(super) point_format: u8,
    pub(super) record_length: u16,
    /// Where in a record the colour is.
    pub(super) color_at: Option<usize>,
    /// Coordinates are `raw * scale + offset`.
    pub(super) scale: [f64; 3],
    pub(super) offset: [f64; 3],
    /// Where in the file the points start.
    pub(super) points_at: u64,
    /// Data of the variable length record that describes the compression.
    pub(super) laszip: Option<Vec<u8>>,
}

impl Header {
    /// Bytes of a record after those of its point format.
    pub(super) fn extra_bytes(&self) -> u16 {
        self.record_length - POINT_FORMATS[usize::from(self.point_format)].0
    }

    /// For the cloud: steps of the finest power of ten that its extent allows, counted from a whole number.
    pub(super) fn for_cloud(cloud: &PointCloud) -> Fallible<Self> {
        check_finite(cloud, "LAS")?;
        if u32::try_from(cloud.len()).is_err() {
            return unsupported("LAS 1.2 holds at most 2^32 - 1 points");
        }
        let (min, max) = bounds(cloud);
        let (mut scale, mut offset) = ([1.0; 3], [0.0; 3]);
        for axis in 0..3 {
            offset[axis] = min[axis].floor();
            let steps = (f64::from(i32::MAX) / (max[axis] - offset[axis] + 1.0)).log10().floor();
            if !steps.is_finite() {
                return unsupported("the cloud is too large for LAS");
            }
            let decade = (steps as i32).min(FINEST_DECADE);
            // 1 / 10^n is the double nearest to the decimal number, which 10^-n need not be.
            scale[axis] = if decade >= 0 { 1.0 / 10f64.powi(decade) } else { 10f64.powi(-decade) };
        }
        let point_format = if cloud.colors.is_some() { 2 } else { 0 };
        let (record_length, color_at) = POINT_FORMATS[usize::from(point_format)];
        Ok(Self {
            count: cloud.len() as u64,
            compressed: false,
            point_format,
            record_length,
            color_at,
            scale,
            offset,
            points_at: u64::from(LENGTH),
            laszip: None,
        })
    }
}

pub(super) fn read(input: &mut Input) -> Fallible<Header> {
    let head = input.bytes(input.len.min(LENGTH_1_4 as u64))?;
    if !head.starts_with(b"LASF") {
        return malformed("it does not start with `LASF`");
    }
    if head.len() < usize::from(LENGTH) {
        return malformed("the file ends within the header");
    }
    let u16_at = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
    let u32_at = |at: usize| u32::from(u16_at(at)) | u32::from(u16_at(at + 2)) << 16;
    let u64_at = |at: usize| u64::from(u32_at(at)) | u64::from(u32_at(at + 4)) << 32;
    let triple_at = |at: usize| [0, 8, 16].map(|step| f64::from_bits(u64_at(at + step)));

    let (major, minor, header_size) = (head[24], head[25], u16_at(94));
    if major != 1 || minor > 4 {
        return unsupported(format!("LAS version {major}.{minor} is not known"));
    }
    // The two upper bits mark compression.
    let (format, compressed) = (head[104] & 0x3f, head[104] & 0x80 != 0);
    let record_length = u16_at(105);
    let Some(&(least_length, color_at)) = POINT_FORMATS.get(usize::from(format)) else {
        return unsupported(format!("LAS point format {format} is not known"));
    };
    if record_length < least_length {
        return malformed(format!(
            "records of {record_length} bytes are too short for point format {format}"
        ));
    }
    let is_1_4 = minor == 4 && usize::from(header_size) >= LENGTH_1_4;
    let count = match u64::from(u32_at(107)) {
        0 if is_1_4 && head.len() == LENGTH_1_4 => u64_at(247),
        0 if is_1_4 => return malformed("the file ends within the header"),
        count => count,
    };
    let (scale, offset) = (triple_at(131), triple_at(155));
    if !scale.iter().chain(&offset).all(|v| v.is_finite()) {
        return malformed("the scale or the offset of the coordinates is not finite");
    }
    let records = u32_at(100);
    let points_at = u64::from(u32_at(96));
    if points_at > input.len {
        return malformed(format!("the points start at byte {points_at}, after the end of the file"));
    }
    let laszip = if compressed { find_laszip(input, header_size, records)? } else { None };
    Ok(Header {
        count,
        compressed,
        point_format: format,
        record_length,
        color_at,
        scale,
        offset,
        points_at,
        laszip,
    })
}

/// Data of the variable length record that describes the compression, of the `count` there are.
fn find_laszip(input: &mut Input, at: u16, count: u32) -> Fallible<Option<Vec<u8>>> {
    input.stream.seek(SeekFrom::Start(u64::from(at)))?;
    input.check_claim("variable length records", u64::from(count), RECORD_HEADER as u64)?;
    for _ in 0..count {
        let head: [u8; RECORD_HEADER] = input.array()?;
        let length = u64::from(u16::from_le_bytes([head[20], head[21]]));
        let id = u16::from_le_bytes([head[18], head[19]]);
        if head[2..18].starts_with(::laz::LazVlr::USER_ID.as_bytes()) && id == ::laz::LazVlr::RECORD_ID {
            return Ok(Some(input.bytes(length)?));
        }
        input.skip(length)?;
    }
    Ok(None)
}

/// Writes a header of version 1.2 and the variable length records, which come ready made.
pub(super) fn write(out: &mut Output, header: &Header, cloud: &PointCloud, records: &[u8]) -> Fallible<()> {
    let (min, max) = bounds(cloud);
    let count = header.count as u32;
    let mut head = Vec::with_capacity(usize::from(LENGTH));
    head.extend(b"LASF");
    head.resize(24, 0);
    head.extend([1, 2]);
    head.extend(padded::<32>(b"other"));
    head.extend(padded::<32>(b"upcr"));
    // Neither day nor year, so that equal clouds make equal files.
    head.extend([0; 4]);
    head.extend(LENGTH.to_le_bytes());
    head.extend((u32::from(LENGTH) + records.len() as u32).to_le_bytes());
    head.extend(u32::from(!records.is_empty()).to_le_bytes());
    head.push(header.point_format | if header.compressed { 0x80 } else { 0 });
    head.extend(header.record_length.to_le_bytes());
    head.extend(count.to_le_bytes());
    // All are first returns.
    head.extend(count.to_le_bytes());
    head.extend([0; 16]);
    head.extend(header.scale.iter().chain(&header.offset).flat_map(|v| v.to_le_bytes()));
    head.extend(max.iter().zip(&min).flat_map(|(max, min)| [*max, *min]).flat_map(f64::to_le_bytes));
    out.write_all(&head)?;
    out.write_all(records)?;
    Ok(())
}

/// `text`, and zeros up to `N` bytes.
pub(super) fn padded<const N: usize>(text: &[u8]) -> [u8; N] {
    let mut bytes = [0; N];
    bytes.iter_mut().zip(text).for_each(|(byte, &letter)| *byte = letter);
    bytes
}

/// Least and greatest coordinates; zeros for no points.
fn bounds(cloud: &PointCloud) -> ([f64; 3], [f64; 3]) {
    let Some(&first) = cloud.points.first() else { return ([0.0; 3], [0.0; 3]) };
    cloud.points.iter().fold((first, first), |(mut min, mut max), point| {
        for axis in 0..3 {
            min[axis] = min[axis].min(point[axis]);
            max[axis] = max[axis].max(point[axis]);
        }
        (min, max)
    })
}
