//! Public scans with known poses, each source turned by a rotation from all of SO(3); skipped where absent.

#![allow(clippy::unwrap_used)]

mod common;

use std::path::{Path, PathBuf};

use common::{Pair, data};
use upcr::{PointCloud, Settings, io, register};

/// Registers every pair with the defaults and holds the poses against the truth.
#[track_caller]
fn assert_registers(pairs: impl Iterator<Item = Pair>, degrees: f64, centroid: f64) {
    let mut wrong = Vec::new();
    for pair in pairs.map(Pair::turned) {
        let found = register(&pair.source, &pair.target, &Settings::default()).unwrap();
        let error = pair.error(&found.T_target_source);
        let free = &found.free_directions;
        if !error.within(degrees, centroid) || !found.is_trustworthy() || !free.is_empty() {
            wrong
                .push(format!("{}: {error}, probability {:.3}, free {free:?}", pair.name, found.probability));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// A pair of scans whose poses `T_world_scan` stand in files.
fn scans(name: String, source: &Files, target: &Files, read: impl Fn(&Path) -> PointCloud) -> Pair {
    let [T_world_source, T_world_target] = [source, target].map(|f| io::read_transform(&f.pose).unwrap());
    let truth = T_world_target.inverse() * T_world_source;
    Pair { name, source: read(&source.cloud), target: read(&target.cloud), truth }
}

/// Where a scan and its pose in the world stand.
struct Files {
    cloud: PathBuf,
    pose: PathBuf,
}

impl Files {
    fn new(folder: &Path, cloud: &str, pose: &str) -> Self {
        Self { cloud: folder.join(cloud), pose: folder.join(pose) }
    }
}

fn read(path: &Path) -> PointCloud {
    io::read_cloud(path).unwrap()
}

#[test]
fn bunny() {
    let Some(folder) = data("stanford_bunny") else { return };
    let names = [
        ["bun000", "bun045"],
        ["bun000", "bun315"],
        ["bun045", "bun090"],
        ["bun270", "bun315"],
        ["bun180", "bun270"],
        ["bun000", "top3"],
        ["bun000", "chin"],
    ];
    let pairs = names.map(|[a, b]| {
        let file = |n| Files::new(&folder, &format!("{n}.ply"), &format!("{n}.pose.txt"));
        scans(format!("bunny {a} {b}"), &file(a), &file(b), read)
    });
    assert_registers(pairs.into_iter(), 1.0, 0.001);
}

fn fragment(name: &str, side: &str) -> Option<PointCloud> {
    Some(read(&data("3dmatch")?.join(name).join(side)))
}

#[test]
fn fragments_of_rooms() {
    let Some(folder) = data("3dmatch") else { return };
    let pairs = ["redkitchen_0_5", "hotel3_8_15"].into_iter().map(|name| Pair {
        name: name.into(),
        source: read(&folder.join(name).join("source.ply")),
        target: read(&folder.join(name).join("target.ply")),
        truth: io::read_transform(folder.join(name).join("T_target_source.txt")).unwrap(),
    });
    assert_registers(pairs, 3.0, 0.10);
}

#[test]
fn fragments_of_different_rooms_are_not_trusted() {
    for side in ["source.ply", "target.ply"] {
        let (Some(kitchen), Some(hotel)) = (fragment("redkitchen_0_5", side), fragment("hotel3_8_15", side))
        else {
            return;
        };
        let found = register(&kitchen, &hotel, &Settings::default()).unwrap();
        assert!(!found.is_trustworthy(), "{side}: probability {:.3}", found.probability);
    }
}

#[test]
fn driving() {
    let Some(folder) = data("kitti00") else { return };
    let file = |i: usize| Files::new(&folder, &format!("{i:06}.bin"), &format!("{i:06}.pose.txt"));
    let pairs = [[0, 1], [0, 3], [0, 5], [1, 4], [2, 5]]
        .into_iter()
        .map(|[a, b]| scans(format!("kitti {a} {b}"), &file(a), &file(b), read));
    assert_registers(pairs, 0.3, 0.10);
}

#[test]
fn depth_images_of_a_kitchen() {
    let Some(folder) = data("redkitchen") else { return };
    let text = std::fs::read_to_string(folder.join("camera-intrinsics.txt")).unwrap();
    let k: Vec<f64> = text.split_whitespace().map(|v| v.parse().unwrap()).collect();
    let camera = io::Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
    let options = io::ReadOptions { intrinsics: Some(camera), ..io::ReadOptions::default() };
    let read = |path: &Path| io::read_cloud_with(path, &options).unwrap();
    let file =
        |i: usize| Files::new(&folder, &format!("frame-{i:06}.depth.png"), &format!("frame-{i:06}.pose.txt"));
    let frames = [
        [0, 20],
        [100, 120],
        [400, 420],
        [700, 720],
        [0, 40],
        [300, 340],
        [800, 840],
        [0, 60],
        [500, 560],
        [900, 960],
    ];
    let pairs =
        frames.into_iter().map(|[a, b]| scans(format!("redkitchen {a} {b}"), &file(a), &file(b), read));
    assert_registers(pairs, 5.0, 0.11);
}
