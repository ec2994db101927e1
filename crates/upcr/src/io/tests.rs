//! What every format has to keep, and what every reader has to refuse.

#![allow(clippy::float_cmp)]

use std::io::Cursor;
use std::path::{Path, PathBuf};

use proptest::prelude::*;

use super::*;
use crate::Rigid;

const RICH: [Encoding; 3] = [Encoding::Binary, Encoding::Ascii, Encoding::Compressed];

/// Points with coordinates that `f32` holds, normals, colours and a viewpoint.
fn rich_cloud(n: usize) -> PointCloud {
    let points = (0..n).map(|i| [i as f64 * 0.25 - 3.0, -(i as f64), 0.5 * (i % 7) as f64]).collect();
    let normals = (0..n).map(|i| if i % 2 == 0 { [0.0, 0.6, -0.8] } else { [1.0, 0.0, 0.0] }).collect();
    let colors = (0..n).map(|i| [i as u8, 255 - (i as u8), 200]).collect();
    PointCloud { points, normals: Some(normals), colors: Some(colors), viewpoint: Some([1.5, -2.0, 0.125]) }
}

/// Points far from the origin, which `f32` would round by centimetres.
fn georeferenced_cloud() -> PointCloud {
    let step = |i: usize, k: f64| (i as f64 * k).sin() * 40.0;
    let point =
        |i| [4_391_234.567_891 + step(i, 0.7), 5_512_345.123_456 + step(i, 1.3), 431.25 + step(i, 2.1)];
    PointCloud::from_points((0..500).map(point).collect())
}

fn in_folder(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    (folder, path)
}

fn round_trip(name: &str, cloud: &PointCloud, encoding: Encoding) -> PointCloud {
    let (folder, path) = in_folder(name);
    write_cloud_with(&path, cloud, &WriteOptions { encoding }).unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing but the file is left");
    read_cloud(&path).unwrap()
}

fn format_for(extension: &str) -> &'static Format {
    find_format(Path::new(&format!("a.{extension}"))).unwrap()
}

fn cloud_from(extension: &str, bytes: &[u8]) -> Fallible<PointCloud> {
    let mut input = Input::new(Cursor::new(bytes.to_vec()))?;
    cloud_of(format_for(extension), &mut input, &ReadOptions { mesh_samples: 100, ..Default::default() })
}

fn mesh_from(extension: &str, bytes: &[u8]) -> Fallible<TriangleMesh> {
    mesh_of(format_for(extension), &mut Input::new(Cursor::new(bytes.to_vec()))?)
}

fn written(extension: &str, cloud: &PointCloud, encoding: Encoding) -> Vec<u8> {
    let (_folder, path) = in_folder(&format!("cloud.{extension}"));
    write_cloud_with(&path, cloud, &WriteOptions { encoding }).unwrap();
    std::fs::read(path).unwrap()
}

#[track_caller]
fn assert_malformed<T: std::fmt::Debug>(result: Fallible<T>, word: &str) {
    match result {
        Err(Fault::Malformed(reason)) if reason.contains(word) => {}
        other => panic!("not malformed because of `{word}`: {other:?}"),
    }
}

#[test]
fn ply_keeps_points_normals_and_colors() {
    let cloud = rich_cloud(100);
    for encoding in [Encoding::Binary, Encoding::Ascii] {
        let read = round_trip("cloud.ply", &cloud, encoding);
        assert_eq!(read, PointCloud { viewpoint: None, ..cloud.clone() });
    }
    let (_folder, path) = in_folder("cloud.ply");
    let compressed = WriteOptions { encoding: Encoding::Compressed };
    assert!(matches!(write_cloud_with(&path, &cloud, &compressed), Err(Error::Unsupported { .. })));
}

#[test]
fn pcd_keeps_everything() {
    let cloud = rich_cloud(300);
    for encoding in RICH {
        assert_eq!(round_trip("cloud.pcd", &cloud, encoding), cloud);
        let bare = PointCloud::from_points(cloud.points.clone());
        assert_eq!(round_trip("cloud.pcd", &bare, encoding), bare);
        let colored = PointCloud { colors: cloud.colors.clone(), ..bare };
        assert_eq!(round_trip("cloud.pcd", &colored, encoding), colored);
    }
}

#[test]
fn xyz_keeps_points_normals_and_colors() {
    let cloud = PointCloud { viewpoint: None, ..rich_cloud(100) };
    let bare = PointCloud::from_points(cloud.points.clone());
    for cloud in [
        PointCloud { normals: cloud.normals.clone(), ..bare.clone() },
        PointCloud { colors: cloud.colors.clone(), ..bare.clone() },
        cloud,
        bare,
    ] {
        for name in ["cloud.xyz", "cloud.CSV", "cloud.txt"] {
            assert_eq!(round_trip(name, &cloud, Encoding::Binary), cloud);
        }
    }
}

#[test]
fn las_laz_and_e57_keep_points_and_colors() {
    let cloud = PointCloud { normals: None, viewpoint: None, ..rich_cloud(1000) };
    for name in ["cloud.las", "cloud.laz", "cloud.e57"] {
        let read = round_trip(name, &cloud, Encoding::Binary);
        assert_eq!(read.colors, cloud.colors, "{name}");
        assert_eq!(largest_difference(&read, &cloud), 0.0, "{name}");
    }
}

#[test]
fn npy_and_kitti_keep_points() {
    let cloud = PointCloud::from_points(rich_cloud(100).points);
    for name in ["cloud.npy", "cloud.bin"] {
        assert_eq!(round_trip(name, &cloud, Encoding::Binary), cloud);
    }
}

fn largest_difference(a: &PointCloud, b: &PointCloud) -> f64 {
    assert_eq!(a.len(), b.len());
    let pairs = a.points.iter().flatten().zip(b.points.iter().flatten());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn georeferenced_coordinates_survive() {
    let cloud = georeferenced_cloud();
    for name in ["cloud.ply", "cloud.pcd"] {
        for encoding in RICH.into_iter().filter(|&e| name.ends_with("pcd") || e != Encoding::Compressed) {
            assert_eq!(round_trip(name, &cloud, encoding), cloud, "{name} {encoding:?}");
        }
    }
    for name in ["cloud.xyz", "cloud.npy", "cloud.e57"] {
        assert_eq!(round_trip(name, &cloud, Encoding::Binary), cloud, "{name}");
    }
    for name in ["cloud.las", "cloud.laz"] {
        assert!(largest_difference(&round_trip(name, &cloud, Encoding::Binary), &cloud) < 1e-6, "{name}");
    }
}

#[test]
fn laz_of_several_chunks_keeps_its_order() {
    let points = (0..120_000).map(|i| [f64::from(i), f64::from(i % 100), 0.5]).collect();
    let cloud = PointCloud::from_points(points);
    let read = round_trip("cloud.laz", &cloud, Encoding::Binary);
    assert!(largest_difference(&read, &cloud) < 1e-3);
}

#[test]
fn clouds_without_points_are_kept_where_the_format_can_say_so() {
    for name in ["cloud.ply", "cloud.pcd", "cloud.xyz", "cloud.npy", "cloud.las", "cloud.laz", "cloud.e57"] {
        assert!(round_trip(name, &PointCloud::default(), Encoding::Binary).is_empty(), "{name}");
    }
    for encoding in RICH {
        assert!(round_trip("cloud.pcd", &PointCloud::default(), encoding).is_empty());
    }
    let (folder, path) = in_folder("cloud.bin");
    assert!(matches!(write_cloud(&path, &PointCloud::default()), Err(Error::Unsupported { .. })));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left behind");
}

#[test]
fn what_a_format_cannot_hold_leaves_no_file_and_keeps_the_old_one() {
    let nan = PointCloud::from_points(vec![[f64::NAN; 3]]);
    for name in ["cloud.las", "cloud.laz", "cloud.e57"] {
        let (folder, path) = in_folder(name);
        std::fs::write(&path, "old").unwrap();
        assert!(matches!(write_cloud(&path, &nan), Err(Error::Unsupported { .. })), "{name}");
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
    let (_folder, path) = in_folder("no_such_folder/cloud.ply");
    assert!(matches!(write_cloud(&path, &nan), Err(Error::Io { .. })));
}

#[test]
fn ply_big_endian_with_shuffled_properties_and_lists() {
    let mut file = b"ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement camera 1\nproperty float f\n\
        property list uchar short notes\nobj_info none\nelement vertex 2\nproperty uchar blue\nproperty short z\n\
        property double x\nproperty list uchar int extra\nproperty uchar red\nproperty float y\nproperty uchar green\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        .to_vec();
    file.extend(1.5f32.to_be_bytes());
    file.extend([2, 0, 1, 0, 2]);
    for (x, y, z, extra) in [(1.25f64, -2.5f32, -3i16, 0u8), (4.0, 5.0, 6, 2)] {
        file.push(30);
        file.extend(z.to_be_bytes());
        file.extend(x.to_be_bytes());
        file.push(extra);
        file.extend(vec![9; 4 * usize::from(extra)]);
        file.push(10);
        file.extend(y.to_be_bytes());
        file.push(20);
    }
    file.extend([4, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1]);
    let cloud = cloud_from("ply", &file).unwrap();
    assert_eq!(cloud.points, [[1.25, -2.5, -3.0], [4.0, 5.0, 6.0]]);
    assert_eq!(cloud.colors.unwrap(), [[10, 20, 30]; 2]);
    assert_eq!(mesh_from("ply", &file).unwrap().triangles, [[0, 1, 0], [0, 0, 1]]);
    let last = file.len() - 1;
    file[last] = 7;
    assert_malformed(mesh_from("ply", &file), "names vertex 7");
}

#[test]
fn ply_colors_of_other_types_are_scaled() {
    let file = "ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty uint y\nproperty char z\n\
        property KIND red\nproperty KIND green\nproperty KIND blue\nend_header\n-1 2 3 ";
    let read = |kind: &str, rest: &str| {
        let cloud = cloud_from("ply", (file.replace("KIND", kind) + rest).as_bytes()).unwrap();
        assert_eq!(cloud.points, [[-1.0, 2.0, 3.0]]);
        cloud.colors.unwrap()[0]
    };
    assert_eq!(read("float", "0 0.5 1"), [0, 128, 255]);
    assert_eq!(read("ushort", "0 257 65535"), [0, 1, 255]);
    assert_eq!(read("uchar", "1\n2\n3\n"), [1, 2, 3]);
}

#[test]
fn ply_claims_are_checked() {
    for count in ["2147483648", "9223372036854775807", "18446744073709551615"] {
        for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
            let header = format!(
                "ply\nformat {encoding} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n\
                property float z\nend_header\n1 2 3\n"
            );
            assert_malformed(cloud_from("ply", header.as_bytes()), "claims");
        }
    }
    let list = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
        property float z\nproperty list uint uchar l\nend_header\n000000000000\u{7f}\u{7f}\u{7f}\u{7f}";
    assert_malformed(cloud_from("ply", list.as_bytes()), "too early");
    assert_malformed(cloud_from("ply", b"solid\n"), "`ply`");
    assert_malformed(cloud_from("ply", b"ply\nformat ascii 1.0\nelement vertex 1\n"), "no end");
    let no_z =
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n";
    assert_malformed(cloud_from("ply", no_z), "lack");
}

const PCD: &str = "VERSION .7\nFIELDS a x y z rgb _\nSIZE 2 4 8 2 4 1\nTYPE U F F I U U\nCOUNT 2 1 1 1 1 3\nWIDTH 3\n\
    HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\n";

#[test]
fn pcd_fields_of_all_kinds_and_no_returns() {
    let ascii =
        format!("{PCD}DATA ascii\n7 8 1 2 3 66051 0 0 0\n7 8 nan nan 0 0 0 0 0\n7 8 4 5 -6 0 0 0 0\n");
    let cloud = cloud_from("pcd", ascii.as_bytes()).unwrap();
    assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, -6.0]]);
    assert_eq!(cloud.colors.unwrap(), [[1, 2, 3], [0, 0, 0]]);
    assert_eq!(cloud.viewpoint, None);

    let mut binary = format!("{PCD}DATA binary\n").into_bytes();
    for (x, y, z) in [(1f32, 2f64, 3i16), (f32::NAN, 0.0, 0), (4.0, 5.0, -6)] {
        binary.extend([7, 0, 8, 0]);
        binary.extend(x.to_le_bytes());
        binary.extend(y.to_le_bytes());
        binary.extend(z.to_le_bytes());
        // Read as a float this colour is a NaN.
        binary.extend([3, 2, 0x81, 0xff, 0, 0, 0]);
    }
    let cloud = cloud_from("pcd", &binary).unwrap();
    assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, -6.0]]);
    assert_eq!(cloud.colors.unwrap(), [[0x81, 2, 3]; 2]);
}

#[test]
fn pcd_claims_are_checked() {
    for data in ["ascii", "binary", "binary_compressed"] {
        for count in ["2147483648", "9223372036854775807"] {
            let header = PCD.replace("WIDTH 3", &format!("WIDTH {count}"));
            let header = header.replace("POINTS 3", &format!("POINTS {count}"));
            let file = format!("{header}DATA {data}\n\x10\0\0\0\0\0\0\u{7f}0123456789abcdef");
            assert!(matches!(cloud_from("pcd", file.as_bytes()), Err(Fault::Malformed(_))), "{data} {count}");
        }
    }
    assert_malformed(cloud_from("pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"), "DATA");
    let disagree = PCD.replace("WIDTH 3", "WIDTH 4") + "DATA ascii\n";
    assert_malformed(cloud_from("pcd", disagree.as_bytes()), "agree");
    let truncated = written("pcd", &rich_cloud(50), Encoding::Compressed);
    assert_malformed(cloud_from("pcd", &truncated[..truncated.len() - 3]), "bytes");
}

#[test]
fn xyz_separators_comments_and_headers() {
    let file = "\u{feff}# a comment\n\n1,2,3\n// another\n4; 5 ;6\r\n7\t8   9 intensity\n";
    assert_eq!(
        cloud_from("txt", file.as_bytes()).unwrap().points,
        [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]
    );
    let file = "id,\"X\",Y,Z,R,G,B\n5,1,2,3,10,20,30\n";
    let cloud = cloud_from("csv", file.as_bytes()).unwrap();
    assert_eq!((cloud.points, cloud.colors), (vec![[1.0, 2.0, 3.0]], Some(vec![[10, 20, 30]])));
    // Without names: unit length makes normals, whole numbers make colours, the rest is passed over.
    let cloud = cloud_from("xyz", b"1 2 3 0 0 1\n1 2 3 0.6 0.8 0\n").unwrap();
    assert_eq!(cloud.normals.unwrap()[1], [0.6, 0.8, 0.0]);
    let cloud = cloud_from("xyz", b"1 2 3 0 0 1\n1 2 3 9 8 255\n").unwrap();
    assert_eq!((cloud.normals, cloud.colors), (None, Some(vec![[0, 0, 1], [9, 8, 255]])));
    let cloud = cloud_from("xyz", b"1 2 3 0.5 0 1\n").unwrap();
    assert_eq!((cloud.normals, cloud.colors), (None, None));
}

#[test]
fn xyz_names_the_bad_line() {
    assert_malformed(cloud_from("xyz", b"1 2 3\n\n4 5\n"), "line 3");
    assert_malformed(cloud_from("xyz", b"1 2 3\n4 five 6\n"), "line 2");
    assert_malformed(cloud_from("xyz", b"1 2 3 4 5 6\n4 5 6\n"), "line 2");
    assert_malformed(cloud_from("xyz", b"# nothing\n"), "no points");
}

fn npy(dict: &str, data: &[u8]) -> Vec<u8> {
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((dict.len() as u16).to_le_bytes());
    file.extend(dict.as_bytes());
    file.extend(data);
    file
}

#[test]
fn npy_orders_and_types() {
    let expected = [[1.0, 3.0, 5.0], [2.0, 4.0, 6.0]];
    let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_be_bytes()).collect::<Vec<_>>();
    let dict = "{'descr': '>f4', 'fortran_order': True, 'shape': (2, 4), }\n";
    let file = npy(dict, &floats(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, 0.0]));
    assert_eq!(cloud_from("npy", &file).unwrap().points, expected);
    let dict = "{\"shape\": (2, 3), \"fortran_order\": False, \"descr\": \"<i2\"}";
    let file = npy(dict, &[1, 0, 3, 0, 5, 0, 2, 0, 4, 0, 6, 0]);
    assert_eq!(cloud_from("npy", &file).unwrap().points, expected);
}

#[test]
fn npy_claims_are_checked() {
    for shape in ["(9223372036854775807, 3)", "(2147483648, 3)", "(3, 9223372036854775807)"] {
        for order in ["True", "False"] {
            let dict = format!("{{'descr': '<f8', 'fortran_order': {order}, 'shape': {shape}, }}");
            assert!(matches!(cloud_from("npy", &npy(&dict, &[0; 64])), Err(Fault::Malformed(_))), "{shape}");
        }
    }
    for dict in ["{'descr': '<f8', 'shape': (3,), }", "{'descr': '<c16', 'shape': (1, 3), }"] {
        assert!(matches!(cloud_from("npy", &npy(dict, &[0; 64])), Err(Fault::Unsupported(_))));
    }
    assert_malformed(cloud_from("npy", b"not numpy"), "magic");
}

#[test]
fn kitti_must_be_whole() {
    assert_malformed(cloud_from("bin", &[0; 24]), "multiple of 16");
}

const SQUARE: &str = "4 1 0\n0 0 0\n1 0 0 # a corner\n1 1 0\n\n0 1 0\n4 0 1 2 3 255 0 0\n";

#[test]
fn off_in_its_variants() {
    for start in ["OFF\n", "OFF", "OFF ", "# made by hand\nOFF\n", "COFF\n", "NOFF\n"] {
        let mesh = mesh_from("off", format!("{start}{SQUARE}").as_bytes()).unwrap();
        assert_eq!((mesh.vertices.len(), mesh.triangles), (4, vec![[0, 1, 2], [0, 2, 3]]), "{start}");
    }
    let cloud = cloud_from("off", format!("OFF {SQUARE}").as_bytes()).unwrap();
    assert_eq!((cloud.len(), cloud.normals.unwrap()[0]), (100, [0.0, 0.0, 1.0]));
    let cloud = cloud_from("off", b"OFF\n2 0 0\n1 2 3\n4 5 6\n").unwrap();
    assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
}

#[test]
fn bad_off() {
    assert_malformed(mesh_from("off", b"OFF\n2147483648 0 0\n0 0 0\n"), "claims");
    assert_malformed(mesh_from("off", b"OFF\n1 9223372036854775807 0\n0 0 0\n"), "claims");
    assert_malformed(mesh_from("off", b"OFF\n1 1 0\n0 0 0\n3 0 0 1\n"), "names vertex 1");
    assert_malformed(mesh_from("off", b"OFF\n1 1 0\n0 0 0\n4294967295 0 0 0\n"), "lacks");
    assert_malformed(mesh_from("off", b"OFF\n3 1 0\n0 0 0\n1 2 3\n"), "");
    assert_malformed(mesh_from("off", b"ply\n"), "OFF");
}

#[test]
fn obj_faces_and_indices() {
    let file = "# a square\nmtllib a.mtl\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0\nvn 0 0 1\nvt 0 0\nf 1 2/1 3//1\nv 0 1 0\nf -4/1/1 -2 -1\n";
    let mesh = mesh_from("obj", file.as_bytes()).unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(cloud_from("obj", b"v 1 2 3\n").unwrap().points, [[1.0, 2.0, 3.0]]);
    assert_malformed(mesh_from("obj", b"v 0 0 0\nf 1 1 2\n"), "names vertex 1");
    assert_malformed(mesh_from("obj", b"v 0 0 0\nf 0 1 1\n"), "line 2");
    assert_malformed(mesh_from("obj", b"v 0 0\n"), "line 1");
    assert_malformed(mesh_from("obj", b"nothing here"), "no vertices");
}

#[test]
fn stl_of_both_kinds() {
    let ascii = "solid thing\n facet normal 0 0 1\n  outer loop\n   vertex 0 0 0\n   vertex 1 0 0\n   vertex 0 1 0\n\
        endloop\nendfacet\nendsolid thing\n";
    let expected = TriangleMesh {
        vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        triangles: vec![[0, 1, 2]],
    };
    assert_eq!(mesh_from("stl", ascii.as_bytes()).unwrap(), expected);
    assert_malformed(mesh_from("stl", &ascii.as_bytes()[..ascii.len() - 16]), "endsolid");

    // A binary file that calls itself solid.
    let mut binary = b"solid binary".to_vec();
    binary.resize(80, b' ');
    binary.extend(1u32.to_le_bytes());
    for v in [0.0f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0] {
        binary.extend(v.to_le_bytes());
    }
    binary.extend([0, 0]);
    assert_eq!(mesh_from("stl", &binary).unwrap(), expected);
    binary[..5].copy_from_slice(b"other");
    binary[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    assert_malformed(mesh_from("stl", &binary), "triangles take");
}

fn depth_png(width: u32, height: u32, depth: png::BitDepth, data: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(data).unwrap();
    file
}

#[test]
fn depth_images_become_points_before_the_camera() {
    let pixels: Vec<u8> = [0u16, 2000, 65535, 500].iter().flat_map(|d| d.to_be_bytes()).collect();
    let file = depth_png(2, 2, png::BitDepth::Sixteen, &pixels);
    let intrinsics = Some(Intrinsics { fx: 2.0, fy: 4.0, cx: 0.5, cy: 0.5 });
    let options = ReadOptions { intrinsics, ..Default::default() };
    let mut input = Input::new(Cursor::new(file.clone())).unwrap();
    let cloud = cloud_of(format_for("png"), &mut input, &options).unwrap();
    assert_eq!(cloud.points, [[0.5, -0.25, 2.0], [0.125, 0.0625, 0.5]]);
    assert_eq!(cloud.viewpoint, Some([0.0; 3]));
    assert!(matches!(cloud_from("png", &file), Err(Fault::Unsupported(_))), "no camera for 2×2");
    let grey = depth_png(2, 2, png::BitDepth::Eight, &pixels[..4]);
    assert!(matches!(cloud_from("png", &grey), Err(Fault::Unsupported(_))));
    let kinect = depth_png(640, 480, png::BitDepth::Sixteen, &vec![3; 640 * 480 * 2]);
    assert_eq!(cloud_from("png", &kinect).unwrap().len(), 640 * 480);
    assert_malformed(cloud_from("png", &kinect[..100]), "");
    // The same header, but of 2^31 - 1 by 480 pixels.
    let mut wide = kinect;
    wide[16..20].copy_from_slice(&0x7fff_ffffu32.to_be_bytes());
    assert!(cloud_from("png", &wide).is_err());
}

#[test]
fn las_claims_are_checked() {
    let las = written("las", &rich_cloud(10), Encoding::Binary);
    let laz = written("laz", &rich_cloud(10), Encoding::Binary);
    for (extension, file) in [("las", &las), ("laz", &laz)] {
        for end in [0, 3, 100, 226, 230, file.len() - 1] {
            let result = cloud_from(extension, &file[..end]);
            assert!(matches!(result, Err(Fault::Malformed(_))), "{extension} cut at {end}: {result:?}");
        }
        let mut many = file.clone();
        many[107..111].copy_from_slice(&(1u32 << 31).to_le_bytes());
        assert!(matches!(cloud_from(extension, &many), Err(Fault::Malformed(_))), "{extension}");
        // As version 1.4, with 2^63 points.
        many[25] = 4;
        many[94..96].copy_from_slice(&375u16.to_le_bytes());
        many[107..111].fill(0);
        many.resize(500, 0);
        many[247..255].copy_from_slice(&(1u64 << 63).to_le_bytes());
        assert!(cloud_from(extension, &many).is_err(), "{extension}");
        let mut short = file.clone();
        short[105..107].copy_from_slice(&4u16.to_le_bytes());
        assert_malformed(cloud_from(extension, &short), "records of 4 bytes");
    }
    // Another kind of points than the compression's.
    let mut other = laz;
    other[104] = 0x80;
    assert_malformed(cloud_from("laz", &other), "items");
}

#[test]
fn damaged_laz_is_an_error_or_a_cloud() {
    let file = written("laz", &rich_cloud(300), Encoding::Binary);
    for at in (100..file.len()).step_by(5) {
        let mut damaged = file.clone();
        damaged[at] ^= 0xff;
        let _ = cloud_from("laz", &damaged);
    }
}

#[test]
fn damaged_e57_is_an_error_or_a_cloud() {
    let file = written("e57", &rich_cloud(20), Encoding::Binary);
    for end in [0, 10, 48, 1024, file.len() - 1] {
        assert!(matches!(cloud_from("e57", &file[..end]), Err(Fault::Malformed(_))), "cut at {end}");
    }
    for at in (0..file.len()).step_by(13) {
        let mut damaged = file.clone();
        damaged[at] ^= 0x55;
        let _ = cloud_from("e57", &damaged);
    }
}

#[test]
fn e57_poses_are_applied() {
    use ::e57::{
        E57Writer, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform, Translation,
    };
    let (_folder, path) = in_folder("scans.e57");
    let write = |scans: usize, records_per_scan: usize| {
        let mut writer = E57Writer::from_file(&path, "file").unwrap();
        for k in 0..scans {
            let double = RecordDataType::Double { min: None, max: None };
            let record = |name| Record { name, data_type: double.clone() };
            let mut prototype =
                [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ].map(record).to_vec();
            prototype.push(Record {
                name: RecordName::CartesianInvalidState,
                data_type: RecordDataType::Integer { min: 0, max: 2 },
            });
            let mut scan = writer.add_pointcloud("scan", prototype).unwrap();
            // A quarter turn about z.
            let half = std::f64::consts::FRAC_1_SQRT_2;
            scan.set_transform(Some(Transform {
                rotation: Quaternion { w: half, x: 0.0, y: 0.0, z: half },
                translation: Translation { x: 10.0 * (k + 1) as f64, y: 0.0, z: 1.0 },
            }));
            for i in 0..records_per_scan {
                let values = [1.0, 0.0, 0.0].map(RecordValue::Double).to_vec();
                let invalid = RecordValue::Integer(if i % 2 == 0 { 0 } else { 2 });
                scan.add_point([values, vec![invalid]].concat()).unwrap();
            }
            scan.finalize().unwrap();
        }
        writer.finalize().unwrap();
    };
    write(1, 2);
    let cloud = read_cloud(&path).unwrap();
    assert_eq!(cloud.viewpoint, Some([10.0, 0.0, 1.0]));
    assert_eq!(cloud.len(), 1, "the invalid point is dropped");
    assert!(largest_difference(&cloud, &PointCloud::from_points(vec![[10.0, 1.0, 1.0]])) < 1e-12);
    let elsewhere = ReadOptions { viewpoint: Some([1.0, 2.0, 3.0]), ..ReadOptions::default() };
    let viewpoint = |options: &ReadOptions| read_cloud_with(&path, options).unwrap().viewpoint;
    assert_eq!(viewpoint(&elsewhere), Some([10.0, 0.0, 1.0]), "the file knows better");
    write(2, 1);
    let cloud = read_cloud(&path).unwrap();
    assert_eq!((cloud.len(), cloud.viewpoint), (2, None));
    assert_eq!(viewpoint(&elsewhere), elsewhere.viewpoint);
}

#[test]
fn transforms_survive() {
    let twist = nalgebra::Vector6::new(0.3, -1.2, 2.0, 4_391_234.567, -3e-9, 12.0);
    let transform = Rigid::exp(&twist);
    let (_folder, path) = in_folder("T.txt");
    write_transform(&path, &transform).unwrap();
    let read = read_transform(&path).unwrap();
    assert_eq!(read.translation, transform.translation);
    assert!((read.rotation - transform.rotation).amax() < 1e-15);

    std::fs::write(&path, "# pose\n[[1, 0, 0, 5],\n [0, 1, 0, 6],\n [0, 0, 1, 7],\n [0, 0, 0, 1]]\n")
        .unwrap();
    assert_eq!(read_transform(&path).unwrap(), Rigid::from_translation([5.0, 6.0, 7.0]));
    for bad in ["", "1 0 0", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "1 0 0 x 0 1 0 0 0 0 1 0 0 0 0 1"] {
        std::fs::write(&path, bad).unwrap();
        let error = read_transform(&path).unwrap_err();
        assert!(matches!(&error, Error::Malformed { .. }), "{error}");
    }
}

#[test]
fn errors_name_the_file_and_the_reason() {
    let (folder, path) = in_folder("cloud.ply");
    assert!(matches!(read_cloud(&path), Err(Error::Io { .. })));
    std::fs::write(&path, "").unwrap();
    let error = read_cloud(&path).unwrap_err().to_string();
    assert!(error.contains("cloud.ply") && error.contains("PLY") && error.contains("empty"), "{error}");
    let other = folder.path().join("cloud.doc");
    let error = read_cloud(&other).unwrap_err().to_string();
    assert!(error.contains("cloud.doc") && error.contains("laz"), "{error}");
    std::fs::create_dir(folder.path().join("folder.ply")).unwrap();
    assert!(matches!(read_cloud(folder.path().join("folder.ply")), Err(Error::Io { .. })));
    assert!(matches!(
        write_cloud(folder.path().join("a.stl"), &rich_cloud(1)),
        Err(Error::Unsupported { .. })
    ));
    assert!(matches!(read_mesh(folder.path().join("a.bin")), Err(Error::Io { .. })));
    assert_eq!((format_name("a/b.PLY"), format_name("a/b")), (Some("PLY"), None));
}

/// Starts that lead a reader past its first check.
fn starts(extension: &str) -> Vec<Vec<u8>> {
    let small = rich_cloud(3);
    let mut starts = vec![Vec::new()];
    if format_for(extension).write.is_some() {
        let encodings = match extension {
            "ply" => &RICH[..2],
            "pcd" => &RICH[..],
            _ => &RICH[..1],
        };
        for &encoding in encodings {
            let file = written(extension, &small, encoding);
            starts
                .extend([file.len() / 3, file.len() / 2, 3 * file.len() / 4].map(|end| file[..end].to_vec()));
            starts.push(file);
        }
    }
    match extension {
        "off" => starts.push(b"OFF 3 1 0\n".to_vec()),
        "obj" => starts.push(b"v 1 2 3\nf ".to_vec()),
        "stl" => starts.extend([b"solid\nvertex ".to_vec(), vec![b'x'; 80]]),
        "png" => starts.push(depth_png(2, 2, png::BitDepth::Sixteen, &[1; 8])[..40].to_vec()),
        "npy" => starts.push(npy("{'descr': '<f8', 'fortran_order': True, 'shape': (2, 4), }", &[])),
        _ => {}
    }
    starts
}

#[test]
fn arbitrary_bytes_never_panic() {
    let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig::with_cases(48));
    for (extension, _) in extensions() {
        let starts = starts(extension);
        let bytes = prop::collection::vec(any::<u8>(), 0..200);
        runner
            .run(
                &(prop::sample::select(starts), bytes, any::<prop::sample::Index>()),
                |(mut file, bytes, at)| {
                    // Once after the start, and once over a part of it.
                    let _ = cloud_from(extension, &[&file[..], &bytes].concat());
                    if !file.is_empty() {
                        let at = at.index(file.len());
                        file.iter_mut().skip(at).zip(bytes).for_each(|(old, new)| *old = new);
                    }
                    let _ = cloud_from(extension, &file);
                    let _ = mesh_from(extension, &file);
                    Ok(())
                },
            )
            .unwrap();
    }
}

#[test]
fn memory_gives_what_a_file_gives() {
    let cloud = rich_cloud(50);
    for (extension, writable) in extensions() {
        let name = format!("cloud.{extension}");
        if !writable {
            let file = write_cloud_to(&name, Cursor::new(Vec::new()), &cloud, &WriteOptions::default());
            assert!(matches!(file, Err(Error::Unsupported { path, .. }) if path == Path::new(&name)));
            continue;
        }
        let (_folder, path) = in_folder(&name);
        write_cloud(&path, &cloud).unwrap();
        let mut memory = Cursor::new(Vec::new());
        write_cloud_to(&name, &mut memory, &cloud, &WriteOptions::default()).unwrap();
        let bytes = memory.into_inner();
        assert_eq!(bytes, std::fs::read(&path).unwrap(), "{name}");
        let read = read_cloud_from(&name, Cursor::new(&bytes), &ReadOptions::default()).unwrap();
        assert_eq!(read, read_cloud(&path).unwrap(), "{name}");
    }
    let mesh = read_mesh_from("square.off", Cursor::new(format!("OFF {SQUARE}")));
    assert_eq!(mesh.unwrap().triangles, [[0, 1, 2], [0, 2, 3]]);
    let pose = read_transform_from("T.txt", Cursor::new("1 0 0 5 0 1 0 6 0 0 1 7"));
    assert_eq!(pose.unwrap(), Rigid::from_translation([5.0, 6.0, 7.0]));
}

#[test]
fn memory_that_is_no_file_is_called_by_its_name() {
    let from = |name: &str, bytes: &'static str| {
        read_cloud_from(name, Cursor::new(bytes), &ReadOptions::default()).unwrap_err().to_string()
    };
    assert!(from("input.ply", "").contains("input.ply: not a valid PLY file: the file is empty"));
    assert!(from("input.ply", "solid").contains("input.ply"));
    assert!(from("input.doc", "1 2 3").contains("input.doc"));
    let mesh = read_mesh_from("input.bin", Cursor::new([0; 16])).unwrap_err();
    assert!(matches!(&mesh, Error::Unsupported { path, .. } if path == Path::new("input.bin")), "{mesh}");
    let pose = read_transform_from("pose", Cursor::new("1 0 0")).unwrap_err();
    assert!(matches!(&pose, Error::Malformed { path, .. } if path == Path::new("pose")), "{pose}");
}

#[test]
fn comments_are_what_the_header_says_to_people() {
    let ply = "ply\nformat ascii 1.0\ncomment made by <b>hand</b>\r\nobj_info \tscanner 3\ncommentary\ncomment\n\
               element vertex 1\nproperty float x\nend_header\ncomment no more\n";
    let read = |name, text: &str| read_comments_from(name, Cursor::new(text.as_bytes().to_vec())).unwrap();
    assert_eq!(read("a.ply", ply), ["made by <b>hand</b>", "scanner 3"]);
    assert!(read("a.xyz", "# x y z\n1 2 3\n").is_empty());
    assert!(read_comments_from("a.docx", Cursor::new(ply.as_bytes())).is_err());
}
