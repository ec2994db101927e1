//! Small files that would take their readers long, or much memory, if these let them.

#![allow(clippy::unwrap_used, clippy::panic)]

mod common;
#[path = "../../../fuzz/src/lib.rs"]
#[allow(dead_code, clippy::duplicate_mod)]
mod fuzz;
#[path = "common/seeds.rs"]
#[allow(dead_code)]
mod seeds;
#[path = "common/weights.rs"]
mod weights;

use std::io::Cursor;

use upcr::io::{Intrinsics, ReadOptions, WriteOptions, read_cloud_from, write_cloud_to};
use upcr::{PointCloud, Result};

fn read(extension: &str, file: &[u8]) -> Result<PointCloud> {
    let camera = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
    let options = ReadOptions { intrinsics: Some(camera), ..ReadOptions::default() };
    read_cloud_from(format!("bomb.{extension}"), Cursor::new(file), &options)
}

#[track_caller]
fn assert_refused(extension: &str, file: &[u8], word: &str) {
    match read(extension, file) {
        Err(error) if error.to_string().contains(word) => {}
        other => panic!("not refused because of `{word}`: {:?}", other.map(|cloud| cloud.len())),
    }
}

/// LAZ of one point over and over.
fn laz(count: usize, in_a_chunk: u32) -> Vec<u8> {
    let vlr = laz::LazVlrBuilder::default().with_point_format(0, 0).unwrap();
    let vlr = vlr.with_fixed_chunk_size(in_a_chunk).build();
    let record = vlr.items_size() as usize;
    seeds::laz_file(vlr, 0, std::iter::once(vec![1; record * count]))
}

#[test]
fn laz_with_a_decoder_for_every_point() {
    assert_eq!(read("laz", &laz(200, 1)).unwrap().len(), 200);
    // They take about a second.
    assert_refused("laz", &laz(1000, 1), "chunks");
}

#[test]
fn laz_of_more_points_than_anybody_measured() {
    let mut file = laz(500_000, 1 << 31);
    assert!(file.len() < 2000);
    assert_eq!(read("laz", &file).unwrap().len(), 500_000);
    file[107..111].copy_from_slice(&(1u32 << 24).to_le_bytes());
    assert_refused("laz", &file, "too many");
}

#[test]
fn a_depth_image_of_one_depth() {
    let image = |side: u32| {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, side, side);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Sixteen);
        encoder.set_compression(png::Compression::High);
        let pixels = vec![1; 2 * (side * side) as usize];
        encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
        file
    };
    let small = image(500);
    assert_eq!(read("png", &small).unwrap().len(), 250_000);
    let large = image(3000);
    assert!(large.len() < 100_000);
    assert_refused("png", &large, "too many");
}

#[test]
fn pcd_with_a_point_of_many_values() {
    let fields = 100;
    let repeated = |word: &str| vec![word; fields].join(" ");
    for (data, points) in [("ascii", 0), ("ascii", 1), ("binary", 1), ("binary_compressed", 1)] {
        let file = format!(
            "FIELDS x y z {}\nSIZE 4 4 4 {}\nTYPE F F F {}\nCOUNT 1 1 1 {}\nPOINTS {points}\nDATA {data}\n1 2 3",
            repeated("f"),
            repeated("8"),
            repeated("F"),
            repeated("1000000")
        );
        assert_refused("pcd", file.as_bytes(), "values");
    }
}

/// An E57 file whose XML section is `xml`.
fn e57(xml: &str) -> Vec<u8> {
    const PAGE: usize = 1024;
    const CONTENT: usize = 1020;
    let mut file = Cursor::new(Vec::new());
    let cloud = PointCloud::from_points(vec![[1.0, 2.0, 3.0]; 5]);
    write_cloud_to("a.e57", &mut file, &cloud, &WriteOptions::default()).unwrap();
    let mut file = file.into_inner();
    let xml_at = file.len() as u64;
    file[24..32].copy_from_slice(&xml_at.to_le_bytes());
    file[32..40].copy_from_slice(&(xml.len() as u64).to_le_bytes());
    for content in xml.as_bytes().chunks(CONTENT) {
        file.extend(content);
        file.resize(file.len().next_multiple_of(PAGE), 0);
    }
    fuzz::read::sealed(&file)
}

#[test]
fn e57_with_many_attributes_or_namespaces() {
    let attributes = (0..50_000).map(|i| format!(" a{i}='>'")).collect::<Vec<_>>().concat();
    assert_refused("e57", &e57(&format!("<e57Root{attributes}/>")), "attributes");
    let namespaces = (0..5000).map(|i| format!("<a xmlns:b{i}='{i}'/>")).collect::<Vec<_>>().concat();
    assert_refused("e57", &e57(&format!("<e57Root>{namespaces}</e57Root>")), "namespaces");
    // A file of its kind, but for what is missing.
    assert_refused("e57", &e57("<e57Root/>"), "E57");
}

/// Scans that are the same bytes, and points that have many values of no bits.
#[test]
fn e57_that_claims_the_same_bytes_again() {
    let record = |name: &str, kind: &str| format!("<{name} type=\"{kind}\"/>");
    let scan = |records: u64, fields: &str| {
        format!(
            "<vectorChild type=\"Structure\"><points type=\"CompressedVector\" fileOffset=\"48\" recordCount=\"{records}\">\
            <prototype type=\"Structure\">{fields}</prototype></points></vectorChild>"
        )
    };
    let root = |scans: &str| {
        format!(
            "<e57Root><formatName type=\"String\">ASTM E57 3D Imaging Data File</formatName><guid type=\"String\">a</guid>\
            <versionMajor type=\"Integer\">1</versionMajor><versionMinor type=\"Integer\">0</versionMinor>\
            <data3D type=\"Vector\">{scans}</data3D></e57Root>"
        )
    };
    let position = ["cartesianX", "cartesianY", "cartesianZ"].map(|name| record(name, "Float")).concat();
    let one = scan(5, &position);
    assert_eq!(read("e57", &e57(&root(&one))).unwrap().len(), 5);
    assert_refused("e57", &e57(&root(&one.repeat(2000))), "claims");
    let constant = "<intensity type=\"Integer\" minimum=\"7\" maximum=\"7\"/>".repeat(200);
    assert_refused("e57", &e57(&root(&scan(5, &format!("{position}{constant}")))), "bits");
}
