//! Small files of every kind, for the fuzzer to start from.

use std::io::Cursor;

use rand::Rng;
use upcr::io::{Encoding, WriteOptions, write_cloud_to};
use upcr::net::{GraphKind, Invariant, NetworkConfig, RotationKind};
use upcr::{PointCloud, Rigid};

use super::common::seeded;
use super::weights::{Precision, WeightsFile};

/// Files for a target, by name.
pub fn seeds(target: &str) -> Vec<(String, Vec<u8>)> {
    let text = |name: &str, text: &str| (name.to_owned(), text.as_bytes().to_vec());
    match target {
        "ply" => ply(),
        "pcd" => pcd(),
        "las" => las().into(),
        "laz" => laz(),
        "e57" => e57(),
        "xyz" => vec![
            named("rich", written("xyz", &rich(5), Encoding::Binary)),
            text("bare", "\u{feff}# a comment\n1,2,3\n\n// another\n4; 5 ;6\r\n7\t8   9 intensity\n"),
            text("header", "\"x\",\"y\",z,nx,ny,nz,r,g,b\n1,2,3,0,0,1,255,0,7\n"),
            text("unnamed", "1 2 3 0.6 0.8 0 200 100 0\n-1e3 nan inf 0 0 0 1 2 3\n"),
        ],
        "npy" => vec![
            named("f8", written("npy", &rich(3), Encoding::Binary)),
            named("f4", npy("{'descr': '>f4', 'fortran_order': True, 'shape': (2, 4), }", 32)),
            named("i2", npy("{\"shape\": (2, 3), \"fortran_order\": False, \"descr\": \"<i2\"}", 12)),
        ],
        "bin" => vec![named("rich", written("bin", &rich(4), Encoding::Binary))],
        "off" => vec![
            text("mesh", "OFF\n4 1 0\n0 0 0\n1 0 0 # a corner\n1 1 0\n\n0 1 0\n4 0 1 2 3 255 0 0\n"),
            text("glued", "COFF3 1 0\n0 0 0 1 1 1\n1 0 0 1 1 1\n1 1 0 1 1 1\n3 0 1 2\n"),
            text("points", "OFF\n2 0 0\n1 2 3\n4 5 6\n"),
        ],
        "obj" => vec![
            text(
                "mesh",
                "# a square\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0\nvn 0 0 1\nvt 0 0\nf 1 2/1 3//1\nv 0 1 0\nf -4/1/1 -2 -1\n",
            ),
            text("points", "v 1 2 3\nv 4 5 6\n"),
        ],
        "stl" => vec![
            text(
                "ascii",
                "solid thing\n facet normal 0 0 1\n  outer loop\n   vertex 0 0 0\n   vertex 1 0 0\n   vertex 0 1 0\n\
                endloop\nendfacet\nendsolid thing\n",
            ),
            named("binary", stl()),
        ],
        "png" => vec![named("depth", depth_image())],
        "transform" => vec![
            text("rows", "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n"),
            text("brackets", "# pose\n[[0, -1, 0, 5e6],\n [1, 0, 0, -6],\n [0, 0, 1, 7]]\n"),
            named("turned", turned()),
        ],
        "weights" => networks(),
        "register" => tasks(),
        other => panic!("no target {other}"),
    }
}

fn named(name: &str, bytes: Vec<u8>) -> (String, Vec<u8>) {
    (name.to_owned(), bytes)
}

/// A cloud with normals, colours and a viewpoint.
fn rich(n: u8) -> PointCloud {
    let points = (0..n).map(|i| [f64::from(i) * 0.25 - 3.0, -f64::from(i), 0.5 * f64::from(i % 7)]).collect();
    let normals = (0..n).map(|i| if i % 2 == 0 { [0.0, 0.6, -0.8] } else { [1.0, 0.0, 0.0] }).collect();
    let colors = (0..n).map(|i| [i, 255 - i, 200]).collect();
    PointCloud { points, normals: Some(normals), colors: Some(colors), viewpoint: Some([1.5, -2.0, 0.125]) }
}

/// One without these, whose coordinates need `f64`.
fn bare(n: u8) -> PointCloud {
    PointCloud::from_points(rich(n).points.iter().map(|p| p.map(|v| v * 0.1 + 4e6)).collect())
}

fn written(extension: &str, cloud: &PointCloud, encoding: Encoding) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    write_cloud_to(format!("cloud.{extension}"), &mut file, cloud, &WriteOptions { encoding }).unwrap();
    file.into_inner()
}

fn ply() -> Vec<(String, Vec<u8>)> {
    let mut big = b"ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement camera 1\nproperty float f\n\
        property list uchar short notes\nobj_info none\nelement vertex 2\nproperty uchar blue\nproperty short z\n\
        property double x\nproperty list uchar int extra\nproperty uchar red\nproperty float y\nproperty uchar green\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        .to_vec();
    big.extend(1.5f32.to_be_bytes());
    big.extend([2, 0, 1, 0, 2]);
    for extra in [0u8, 2] {
        big.push(30);
        big.extend((-3i16).to_be_bytes());
        big.extend(1.25f64.to_be_bytes());
        big.push(extra);
        big.extend(vec![9; 4 * usize::from(extra)]);
        big.push(10);
        big.extend((-2.5f32).to_be_bytes());
        big.push(20);
    }
    big.extend([4, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1]);
    let mesh = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
        element face 1\nproperty list uchar uint vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    vec![
        named("binary", written("ply", &rich(3), Encoding::Binary)),
        named("ascii", written("ply", &rich(3), Encoding::Ascii)),
        named("double", written("ply", &bare(3), Encoding::Binary)),
        named("mesh", mesh.into()),
        named("big_endian", big),
    ]
}

fn pcd() -> Vec<(String, Vec<u8>)> {
    let fields = "VERSION .7\nFIELDS a x y z rgb _\nSIZE 2 4 8 2 4 1\nTYPE U F F I U U\nCOUNT 2 1 1 1 1 3\nWIDTH 3\n\
        HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n7 8 1 2 3 66051 0 0 0\n7 8 nan nan 0 0 0 0 0\n\
        7 8 4 5 -6 0 0 0 0\n";
    vec![
        named("binary", written("pcd", &rich(3), Encoding::Binary)),
        named("ascii", written("pcd", &rich(3), Encoding::Ascii)),
        named("compressed", written("pcd", &rich(20), Encoding::Compressed)),
        named("double", written("pcd", &bare(3), Encoding::Compressed)),
        named("fields", fields.into()),
    ]
}

/// Where a LAS header has what.
const POINTS_AT: usize = 96;
const RECORDS: usize = 100;
const POINT_FORMAT: usize = 104;
const RECORD_LENGTH: usize = 105;
const COUNT: usize = 107;
const HEADER: usize = 227;

fn las() -> [(String, Vec<u8>); 3] {
    let colored = written("las", &rich(3), Encoding::Binary);
    // As version 1.4, whose count has 64 bits.
    let mut newer = colored.clone();
    newer[25] = 4;
    newer[94..96].copy_from_slice(&375u16.to_le_bytes());
    newer.splice(HEADER..HEADER, [0; 148]);
    newer[COUNT..COUNT + 4].fill(0);
    newer[247..255].copy_from_slice(&3u64.to_le_bytes());
    newer[POINTS_AT..POINTS_AT + 4].copy_from_slice(&375u32.to_le_bytes());
    [
        named("colored", colored),
        named("bare", written("las", &bare(3), Encoding::Binary)),
        named("version_1_4", newer),
    ]
}

fn laz() -> Vec<(String, Vec<u8>)> {
    let mut files = vec![
        named("colored", written("laz", &rich(9), Encoding::Binary)),
        named("bare", written("laz", &bare(9), Encoding::Binary)),
    ];
    // Every point format, with bytes of its own beside the standard's, and chunks of a fixed and of any size.
    for format in 0..=10u8 {
        files.push(named(&format!("format_{format}"), compressed(format, format % 3, format % 2 == 1)));
    }
    files
}

/// A few compressed records, all of whose fields change.
fn compressed(point_format: u8, extra: u8, variable: bool) -> Vec<u8> {
    let vlr = laz::LazVlrBuilder::default().with_point_format(point_format, extra.into()).unwrap();
    let vlr = if variable { vlr.with_variable_chunk_size() } else { vlr.with_fixed_chunk_size(4) }.build();
    let length = vlr.items_size() as usize;
    // Small steps, since the coder takes no others of time.
    let record = |i: u8| (0..length).map(|at| if at % 4 == 0 { 7 * i + 3 } else { 0 }).collect::<Vec<u8>>();
    let cut = if variable { 4 } else { 6 };
    let chunks = [0..cut, cut..6].into_iter().filter(|chunk| !chunk.is_empty());
    let chunks = chunks.map(|chunk| chunk.flat_map(record).collect());
    laz_file(vlr, point_format, chunks)
}

/// A file of chunks of records, as the compression described by `vlr` cuts them, or as they are where it leaves that open.
pub fn laz_file(vlr: laz::LazVlr, point_format: u8, chunks: impl Iterator<Item = Vec<u8>>) -> Vec<u8> {
    use laz::LazVlr;

    let mut description = Vec::new();
    vlr.write_to(&mut description).unwrap();
    let length = vlr.items_size() as u16;
    let mut file = written("las", &bare(1), Encoding::Binary);
    file.truncate(HEADER);
    let points_at = HEADER + 54 + description.len();
    file[POINTS_AT..POINTS_AT + 4].copy_from_slice(&(points_at as u32).to_le_bytes());
    file[RECORDS..RECORDS + 4].copy_from_slice(&1u32.to_le_bytes());
    file[POINT_FORMAT] = point_format | 0x80;
    file[RECORD_LENGTH..RECORD_LENGTH + 2].copy_from_slice(&length.to_le_bytes());
    let mut head = [0; 54];
    head[2..2 + LazVlr::USER_ID.len()].copy_from_slice(LazVlr::USER_ID.as_bytes());
    head[18..20].copy_from_slice(&LazVlr::RECORD_ID.to_le_bytes());
    head[20..22].copy_from_slice(&(description.len() as u16).to_le_bytes());
    file.extend(head);
    file.extend(&description);

    let variable = vlr.uses_variable_size_chunks();
    let mut out = Cursor::new(file);
    out.set_position(points_at as u64);
    let mut compressor = laz::LasZipCompressor::new(out, vlr).unwrap();
    let mut count = 0;
    for (i, chunk) in chunks.enumerate() {
        if variable && i > 0 {
            compressor.finish_current_chunk().unwrap();
        }
        compressor.compress_many(&chunk).unwrap();
        count += chunk.len() / usize::from(length);
    }
    compressor.done().unwrap();
    let mut file = compressor.into_inner().into_inner();
    file[COUNT..COUNT + 4].copy_from_slice(&(count as u32).to_le_bytes());
    file
}

fn e57() -> Vec<(String, Vec<u8>)> {
    use e57::{Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform, Translation};

    // Angles and ranges in integers, colours in floats, and some points that are none.
    let mut file = Cursor::new(Vec::new());
    let mut writer = e57::E57Writer::new(&mut file, "file").unwrap();
    let scaled = |max| RecordDataType::ScaledInteger { min: -5, max, scale: 0.01, offset: 1.0 };
    let unit = RecordDataType::Single { min: Some(0.0), max: Some(1.0) };
    let kinds = [
        (RecordName::SphericalRange, scaled(1000)),
        (RecordName::SphericalAzimuth, scaled(9)),
        (RecordName::SphericalElevation, RecordDataType::F64),
        (RecordName::SphericalInvalidState, RecordDataType::Integer { min: 0, max: 2 }),
        (RecordName::ColorRed, unit.clone()),
        (RecordName::ColorGreen, unit.clone()),
        (RecordName::ColorBlue, unit),
    ];
    for scan in 0..2 {
        let prototype = kinds.iter().cloned().map(|(name, data_type)| Record { name, data_type }).collect();
        let mut scan = writer.add_pointcloud(&format!("scan {scan}"), prototype).unwrap();
        let half = std::f64::consts::FRAC_1_SQRT_2;
        scan.set_transform(Some(Transform {
            rotation: Quaternion { w: half, x: 0.0, y: 0.0, z: half },
            translation: Translation { x: 10.0, y: 0.0, z: 1.0 },
        }));
        for i in 0..3i64 {
            let angles =
                [RecordValue::ScaledInteger(i), RecordValue::ScaledInteger(5 - i), RecordValue::Double(0.1)];
            let color = [0.0, 0.5, 1.0].map(RecordValue::Single);
            scan.add_point([&angles[..], &[RecordValue::Integer(i % 2)], &color].concat()).unwrap();
        }
        scan.finalize().unwrap();
    }
    writer.finalize().unwrap();
    drop(writer);
    vec![
        named("cartesian", written("e57", &rich(3), Encoding::Binary)),
        named("spherical", file.into_inner()),
    ]
}

fn npy(dict: &str, bytes: u8) -> Vec<u8> {
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((dict.len() as u16).to_le_bytes());
    file.extend(dict.as_bytes());
    file.extend(0..bytes);
    file
}

fn stl() -> Vec<u8> {
    let mut file = b"solid binary".to_vec();
    file.resize(80, b' ');
    file.extend(1u32.to_le_bytes());
    for v in [0.0f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0] {
        file.extend(v.to_le_bytes());
    }
    file.extend([0, 0]);
    file
}

fn depth_image() -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, 4, 3);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let pixels: Vec<u8> = (0..24).collect();
    encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
    file
}

fn turned() -> Vec<u8> {
    let pose = Rigid::exp(&nalgebra::Vector6::new(0.3, -1.2, 2.0, 4_391_234.567, -3e-9, 12.0));
    pose.to_rows().map(|row| row.map(|v| v.to_string()).join(" ")).join("\n").into_bytes()
}

/// The smallest networks of each kind.
fn networks() -> Vec<(String, Vec<u8>)> {
    let base = || NetworkConfig { k: 2, widths: vec![1], head: vec![], ..NetworkConfig::default() };
    let file = |name: &str, config: NetworkConfig, precision| {
        named(name, WeightsFile::random(&config, 7).bytes(precision))
    };
    let mut files = vec![
        file("static", base(), Precision::Single),
        file("deep", NetworkConfig { widths: vec![2, 1], head: vec![2], ..base() }, Precision::BrainFloat),
        file(
            "dynamic",
            NetworkConfig { graph: GraphKind::Dynamic, widths: vec![2, 1], ..base() },
            Precision::Single,
        ),
        file("one_branch", NetworkConfig { invariant: Invariant::None, ..base() }, Precision::Single),
    ];
    for (name, rotation) in [
        ("quaternion", RotationKind::Quaternion),
        ("six_d", RotationKind::SixD),
        ("matrix", RotationKind::Matrix),
    ] {
        files.push(file(name, NetworkConfig { rotation, ..base() }, Precision::BrainFloat));
    }
    files
}

/// Tasks for each method, in the order in which `register` takes bytes: settings, a cloud, how the other follows from it.
fn tasks() -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    for method in 0..7u8 {
        let mut rng = seeded(method.into());
        // Refinement, kernel, feature, no locks; no scale, no first guess, no overlap; a seed.
        let mut task = vec![method, method % 4, method % 5, method % 3, 0, 0, 0, 0, 1, 0];
        // A height over a square of 8 by 8 steps, of unit scale, about the origin.
        let points = 64u8;
        task.extend([points, 5, 6, 0]);
        for i in 0..points {
            let height = (40.0 * f64::from(i / 8).sin() + 30.0 * (0.9 * f64::from(i % 8)).cos() + 80.0) as u8;
            task.extend([height; 3]);
        }
        // All different; the other cloud is this one, moved, and disturbed.
        task.extend([1, 3]);
        task.extend((0..6).map(|_| rng.random_range(0..12u8)));
        task.extend((0..points).flat_map(|_| [0, 1, 255]));
        files.push(named(&format!("method_{method}"), task));
    }
    files
}
