//! E57: all scans of a file in one cloud, each moved by its pose.

use std::io::Seek;

use ::e57::{
    E57Reader, E57Writer, PointCloud as Scan, RawValues, Record, RecordDataType, RecordName, RecordValue,
};
use nalgebra::{Quaternion, UnitQuaternion};

use crate::{PointCloud, Rigid};

use super::input::{Fallible, Fault, Input, malformed};
use super::output::Output;
use super::{Format, ReadOptions, Reader, WriteOptions, check_finite};

pub(super) const FORMAT: Format = Format {
    name: "E57",
    extensions: &["e57"],
    read: Reader::Cloud(read),
    write: Some(write),
    comments: None,
};

/// Attributes of an XML element, and namespaces of all, that are more than any file needs.
const MOST_ATTRIBUTES: usize = 1000;

/// Largest departure of a pose's quaternion from unit length that is taken for rounding.
const UNIT_TOLERANCE: f64 = 1e-3;

impl From<::e57::Error> for Fault {
    fn from(error: ::e57::Error) -> Self {
        // The crate's own words tell no system error from a bad file; both end up in the reason.
        let source = std::error::Error::source(&error).map(|s| format!(": {s}")).unwrap_or_default();
        Self::Malformed(format!("{error}{source}"))
    }
}

/// Points whose coordinates the file calls invalid are dropped. Colours are kept where every scan has them;
/// the viewpoint is the pose of a file's only scan.
fn read(input: &mut Input, _: &ReadOptions) -> Fallible<PointCloud> {
    check_xml(input)?;
    let mut reader = E57Reader::new(&mut input.stream)?;
    // Scans may claim the same bytes: what all of them claim together is held against the file.
    let mut bits_left = u128::from(input.len.saturating_sub(reader.xml().len() as u64)) * 8;
    let scans = reader.pointclouds();
    let mut cloud = PointCloud::default();
    let mut colors = Some(Vec::new());
    for scan in &scans {
        bits_left = check_claim(scan, bits_left)?;
        let pose = pose(scan)?;
        let Layout { position, spherical, invalid, color } = Layout::of(scan)?;
        if color.is_none() {
            colors = None;
        }
        if scan.records == 0 {
            continue;
        }
        cloud.points.reserve(scan.records as usize);
        for values in reader.pointcloud_raw(scan)? {
            let values = values?;
            let at = |field: usize| values[field].to_f64(&scan.prototype[field].data_type);
            if let Some(field) = invalid
                && at(field)? != 0.0
            {
                continue;
            }
            let [x, y, z] = [at(position[0])?, at(position[1])?, at(position[2])?];
            let point = if spherical { from_spherical(x, y, z) } else { [x, y, z] };
            cloud.points.push(pose.map_or(point, |pose| pose.apply(point)));
            if let (Some(colors), Some(channels)) = (&mut colors, &color) {
                let mut rgb = [0; 3];
                for (value, &(field, min, scale)) in rgb.iter_mut().zip(channels) {
                    *value = ((at(field)? - min) * scale).round() as u8;
                }
                colors.push(rgb);
            }
        }
        if let (Some(pose), [_]) = (pose, scans.as_slice()) {
            cloud.viewpoint = Some(pose.translation.into());
        }
    }
    cloud.colors = colors.filter(|_| !scans.is_empty());
    Ok(cloud)
}

/// Which of a scan's fields make a point.
struct Layout {
    /// x, y, z, or range, azimuth, elevation.
    position: [usize; 3],
    spherical: bool,
    /// Not 0 where the coordinates mean nothing.
    invalid: Option<usize>,
    /// Field, least value, and factor to 0–255, of each channel.
    color: Option<[(usize, f64, f64); 3]>,
}

impl Layout {
    fn of(scan: &Scan) -> Fallible<Self> {
        let find = |name: RecordName| scan.prototype.iter().position(|r| r.name == name);
        let triple = |names: [RecordName; 3]| {
            let [a, b, c] = names.map(find);
            Some([a?, b?, c?])
        };
        let cartesian = triple([RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ]);
        let spherical = triple([
            RecordName::SphericalRange,
            RecordName::SphericalAzimuth,
            RecordName::SphericalElevation,
        ]);
        let color = triple([RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue]);
        let color = color.map(|fields| {
            let channel = |k: usize| {
                let (min, max) = color_range(scan, k, &scan.prototype[fields[k]].data_type);
                (fields[k], min, if max > min { 255.0 / (max - min) } else { 0.0 })
            };
            [channel(0), channel(1), channel(2)]
        });
        match (cartesian, spherical) {
            (Some(position), _) => {
                let invalid = find(RecordName::CartesianInvalidState);
                Ok(Self { position, spherical: false, invalid, color })
            }
            (None, Some(position)) => {
                let invalid = find(RecordName::SphericalInvalidState);
                Ok(Self { position, spherical: true, invalid, color })
            }
            (None, None) => malformed("a scan has neither Cartesian nor spherical coordinates"),
        }
    }
}

fn from_spherical(range: f64, azimuth: f64, elevation: f64) -> [f64; 3] {
    let level = range * elevation.cos();
    [level * azimuth.cos(), level * azimuth.sin(), range * elevation.sin()]
}

/// Least and greatest value of colour channel `k`: what the scan says, else what its type can hold.
fn color_range(scan: &Scan, k: usize, kind: &RecordDataType) -> (f64, f64) {
    let number = |value: &Option<RecordValue>| value.as_ref().and_then(|v| v.to_f64(kind).ok());
    let stated = scan.color_limits.as_ref().and_then(|limits| {
        let (min, max) = match k {
            0 => (&limits.red_min, &limits.red_max),
            1 => (&limits.green_min, &limits.green_max),
            _ => (&limits.blue_min, &limits.blue_max),
        };
        Some((number(min)?, number(max)?))
    });
    stated.unwrap_or(match *kind {
        RecordDataType::Integer { min, max } => (min as f64, max as f64),
        RecordDataType::ScaledInteger { min, max, scale, offset } => {
            (min as f64 * scale + offset, max as f64 * scale + offset)
        }
        RecordDataType::Single { min, max } => (f64::from(min.unwrap_or(0.0)), f64::from(max.unwrap_or(1.0))),
        RecordDataType::Double { min, max } => (min.unwrap_or(0.0), max.unwrap_or(1.0)),
    })
}

fn pose(scan: &Scan) -> Fallible<Option<Rigid>> {
    let Some(transform) = &scan.transform else { return Ok(None) };
    let (q, t) = (&transform.rotation, &transform.translation);
    let quaternion = Quaternion::new(q.w, q.x, q.y, q.z);
    let translation = [t.x, t.y, t.z];
    let unit = (quaternion.norm() - 1.0).abs() < UNIT_TOLERANCE;
    if !unit || !translation.iter().all(|v| v.is_finite()) {
        return malformed("a scan's pose is not a rigid motion");
    }
    let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner();
    Ok(Some(Rigid { rotation, translation: translation.into() }))
}

/// Fails where the XML section would take its parser long, which holds each attribute of an element against all others, and
/// hands each namespace down to every element.
fn check_xml(input: &mut Input) -> Fallible<()> {
    if !input.array::<8>().is_ok_and(|start| start == *b"ASTM-E57") {
        return malformed("it does not start with `ASTM-E57`");
    }
    let xml = E57Reader::raw_xml(&mut input.stream)?;
    input.stream.rewind()?;
    // No `<` stands within an element's tag.
    let has_many = |element: &[u8]| element.split(|&byte| byte == b'=').nth(MOST_ATTRIBUTES + 1).is_some();
    if xml.split(|&byte| byte == b'<').any(has_many) {
        return malformed(format!("an XML element has more than {MOST_ATTRIBUTES} attributes"));
    }
    if xml.windows(5).filter(|word| word == b"xmlns").count() > MOST_ATTRIBUTES {
        return malformed(format!("the XML section has more than {MOST_ATTRIBUTES} namespaces"));
    }
    Ok(())
}

/// What the points of a scan leave of `bits_left`; fails where they claim more.
fn check_claim(scan: &Scan, bits_left: u128) -> Fallible<u128> {
    let bits = |kind: &RecordDataType| match *kind {
        RecordDataType::Single { .. } => 32,
        RecordDataType::Double { .. } => 64,
        RecordDataType::Integer { min, max } | RecordDataType::ScaledInteger { min, max, .. } => {
            u128::BITS - (i128::from(max) - i128::from(min)).unsigned_abs().leading_zeros()
        }
    };
    let (records, fields) = (scan.records, scan.prototype.len());
    if records == 0 {
        return Ok(bits_left);
    }
    let bits: u128 = scan.prototype.iter().map(|record| u128::from(bits(&record.data_type))).sum();
    // Without a bit a value, any number of values would fit.
    if bits < fields as u128 {
        return malformed(format!("a scan has points of {bits} bits for {fields} values"));
    }
    match bits_left.checked_sub(u128::from(records) * bits) {
        Some(left) => Ok(left),
        None => malformed(format!("a scan claims {records} points of {bits} bits, more than the file has")),
    }
}

/// One scan without pose, coordinates as `f64`; normals and viewpoint are not kept.
fn write(out: &mut Output, cloud: &PointCloud, _: &WriteOptions) -> Fallible<()> {
    check_finite(cloud, FORMAT.name)?;
    let double = |name| Record { name, data_type: RecordDataType::Double { min: None, max: None } };
    let channel = |name| Record { name, data_type: RecordDataType::Integer { min: 0, max: 255 } };
    let mut prototype =
        vec![double(RecordName::CartesianX), double(RecordName::CartesianY), double(RecordName::CartesianZ)];
    if cloud.colors.is_some() {
        prototype.extend([RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue].map(channel));
    }
    // Equal clouds make equal files, so the identifiers, which only need to differ within a file, are fixed.
    let mut writer = E57Writer::new(out.get_mut(), "upcr file").map_err(write_fault)?;
    let mut scan = writer.add_pointcloud("upcr scan", prototype).map_err(write_fault)?;
    for (i, point) in cloud.points.iter().enumerate() {
        let mut values: RawValues = point.iter().map(|&v| RecordValue::Double(v)).collect();
        if let Some(colors) = &cloud.colors {
            values.extend(colors[i].iter().map(|&v| RecordValue::Integer(i64::from(v))));
        }
        scan.add_point(values).map_err(write_fault)?;
    }
    scan.finalize().map_err(write_fault)?;
    writer.finalize().map_err(write_fault)
}

fn write_fault(error: ::e57::Error) -> Fault {
    Fault::Io(std::io::Error::other(error))
}
