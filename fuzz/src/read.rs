//! Arbitrary bytes as a file of each kind.

use std::io::Cursor;
use std::path::Path;

use upcr::io::{Encoding, Intrinsics, ReadOptions, WriteOptions};
use upcr::io::{read_cloud_from, read_mesh_from, read_transform_from, write_cloud_to};
use upcr::net::Network;
use upcr::{Error, Method, PointCloud, Settings};

use super::consistent::{assert_consistent, is_proper};

/// Clouds of more points are not written again.
const FEW: usize = 2000;

/// Reads `data` as a cloud and as a mesh of the format that `extension` tells, as a `transform`, or as a network's
/// `weights`, and asserts what holds for whatever is read.
pub fn read(extension: &str, data: &[u8]) {
    match extension {
        "transform" => transform(data),
        "weights" => weights(data),
        "e57" => {
            cloud_and_mesh(extension, data);
            cloud_and_mesh(extension, &sealed(data));
        }
        _ => cloud_and_mesh(extension, data),
    }
}

fn cloud_and_mesh(extension: &str, data: &[u8]) {
    let name = format!("input.{extension}");
    let camera = Intrinsics { fx: 2.0, fy: 3.0, cx: 4.0, cy: 5.0 };
    let options = ReadOptions { mesh_samples: 50, intrinsics: Some(camera), ..ReadOptions::default() };
    match read_cloud_from(&name, Cursor::new(data), &options) {
        Ok(cloud) => {
            assert!(cloud.normals.as_ref().is_none_or(|n| n.len() == cloud.len()));
            assert!(cloud.colors.as_ref().is_none_or(|c| c.len() == cloud.len()));
            if cloud.len() <= FEW {
                round_trip(&name, extension, &cloud);
            }
        }
        Err(error) => assert_explained(&error, &name),
    }
    match read_mesh_from(&name, Cursor::new(data)) {
        Ok(mesh) => {
            assert!(mesh.triangles.iter().flatten().all(|&v| (v as usize) < mesh.vertices.len()));
            let sampled = mesh.sample(5, 1);
            assert!(sampled.is_empty() || sampled.len() == 5);
            assert_eq!(sampled.normals.map_or(0, |n| n.len()), sampled.points.len());
        }
        Err(error) => assert_explained(&error, &name),
    }
}

/// Bytes in memory cannot fail to be read, they can only be no such file; and the error says of what it speaks.
fn assert_explained(error: &Error, name: &str) {
    match error {
        Error::Malformed { path, reason, .. } | Error::Unsupported { path, reason } => {
            assert!(path == Path::new(name) && !reason.is_empty(), "{error}");
        }
        other => panic!("{other:?}"),
    }
}

/// Writes the cloud in each encoding that the format has, and holds what is read again against it.
fn round_trip(name: &str, extension: &str, cloud: &PointCloud) {
    let encodings: &[Encoding] = match extension {
        "ply" => &[Encoding::Binary, Encoding::Ascii],
        "pcd" => &[Encoding::Binary, Encoding::Ascii, Encoding::Compressed],
        "las" | "laz" | "e57" | "xyz" | "npy" | "bin" => &[Encoding::Binary],
        _ => return,
    };
    for &encoding in encodings {
        let mut file = Cursor::new(Vec::new());
        match write_cloud_to(name, &mut file, cloud, &WriteOptions { encoding }) {
            Ok(()) => {
                let again = read_cloud_from(name, Cursor::new(file.get_ref()), &ReadOptions::default());
                let again = again.unwrap_or_else(|e| panic!("{encoding:?}: {e}: {cloud:?}"));
                assert_same(extension, &kept(extension, cloud), &again);
            }
            Err(Error::Unsupported { .. }) => {}
            Err(other) => panic!("{encoding:?}: {other}: {cloud:?}"),
        }
    }
}

/// What the format keeps of a cloud.
fn kept(extension: &str, cloud: &PointCloud) -> PointCloud {
    let bare = PointCloud::from_points(cloud.points.clone());
    match extension {
        "ply" | "xyz" => PointCloud { viewpoint: None, ..cloud.clone() },
        "pcd" => {
            let whole = (0..cloud.len()).filter(|&i| !cloud.points[i].iter().any(|v| v.is_nan()));
            let viewpoint = cloud.viewpoint.filter(|v| *v != [0.0; 3]);
            PointCloud { viewpoint, ..cloud.select(&whole.collect::<Vec<_>>()) }
        }
        "las" | "laz" | "e57" => PointCloud { colors: cloud.colors.clone(), ..bare },
        "bin" => {
            PointCloud::from_points(bare.points.iter().map(|p| p.map(|v| f64::from(v as f32))).collect())
        }
        _ => bare,
    }
}

fn assert_same(extension: &str, expected: &PointCloud, found: &PointCloud) {
    assert_eq!(expected.len(), found.len());
    // LAS counts steps of a power of ten, as fine as 32 bits allow.
    let tolerance = |axis: usize| {
        let values = || expected.points.iter().map(move |p| p[axis]);
        let (min, max) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
        let steps = (max - min + 2.0) / f64::from(i32::MAX) * 10.0;
        if matches!(extension, "las" | "laz") { steps + 1e-15 * min.abs().max(max.abs()) } else { 0.0 }
    };
    let tolerance = [0, 1, 2].map(tolerance);
    for (a, b) in expected.points.iter().zip(&found.points) {
        for axis in 0..3 {
            assert!(same(a[axis], b[axis]) || (a[axis] - b[axis]).abs() <= tolerance[axis], "{a:?} {b:?}");
        }
    }
    let numbers = |cloud: &PointCloud| -> Option<Vec<f64>> {
        Some(cloud.normals.as_ref()?.as_flattened().iter().map(|&v| f64::from(v)).collect())
    };
    match (numbers(expected), numbers(found)) {
        (Some(a), Some(b)) => assert!(a.iter().zip(&b).all(|(&a, &b)| same(a, b)), "{a:?} {b:?}"),
        (a, b) => assert_eq!(a.is_some(), b.is_some()),
    }
    assert_eq!(expected.colors, found.colors);
    match (expected.viewpoint, found.viewpoint) {
        (Some(a), Some(b)) => assert!(a.iter().zip(b).all(|(&a, b)| same(a, b)), "{a:?} {b:?}"),
        (a, b) => assert_eq!(a.is_some(), b.is_some()),
    }
}

/// Equal, or no numbers both.
fn same(a: f64, b: f64) -> bool {
    a == b || (a.is_nan() && b.is_nan())
}

fn transform(data: &[u8]) {
    match read_transform_from("pose", Cursor::new(data)) {
        Ok(pose) => {
            assert!(is_proper(&pose), "{pose:?}");
            let text = pose.to_rows().map(|row| row.map(|v| v.to_string()).join(" ")).join("\n");
            let again = read_transform_from("pose", Cursor::new(&text)).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!(again.translation, pose.translation);
            assert!((again.rotation - pose.rotation).amax() < 1e-12, "{text}");
        }
        Err(error) => assert_explained(&error, "pose"),
    }
}

/// A network of any weights, however odd, gives poses or refuses, and the verdict on them is no other than on poses from
/// elsewhere.
fn weights(data: &[u8]) {
    let network = match Network::from_safetensors(data) {
        Ok(network) => network,
        Err(Error::InvalidWeights { .. } | Error::InvalidSetting { .. }) => return,
        Err(other) => panic!("{other:?}"),
    };
    let point = |i: u16| [i % 5, i * i % 7, i * 3 % 11].map(f64::from);
    let source = PointCloud::from_points((0..60).map(point).collect());
    let target = PointCloud::from_points((10..70).map(point).collect());
    let settings = Settings { method: Method::Upcr, network: Some(network.into()), ..Settings::default() };
    if let Ok(found) = upcr::register(&source, &target, &settings) {
        assert_consistent(&found);
    }
}

/// The bytes as pages of an E57 file: whole ones, each with the checksum of what it holds. No other file is looked into.
pub fn sealed(data: &[u8]) -> Vec<u8> {
    const PAGE: usize = 1024;
    const CHECKSUM: usize = 4;
    let mut file = data.to_vec();
    file.resize(data.len().next_multiple_of(PAGE), 0);
    for page in file.chunks_exact_mut(PAGE) {
        let (content, checksum) = page.split_at_mut(PAGE - CHECKSUM);
        checksum.copy_from_slice(&castagnoli(content).to_be_bytes());
    }
    file
}

/// The cyclic redundancy check of E57, CRC-32C.
fn castagnoli(data: &[u8]) -> u32 {
    !data.iter().fold(!0, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0x82f6_3b78 & (crc & 1).wrapping_neg()))
    })
}
