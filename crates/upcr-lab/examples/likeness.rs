//! Which description of a scan finds the scans that overlap it: the vocabulary that `upcr merge` uses, the mean of the same
//! features, and the network's representation that no motion changes (Γν).
//!
//! `cargo run --release -p upcr-lab --example likeness -- FOLDER [EVERY [VOXEL_SIZE]]` takes every so-many-th scan of a folder in which poses lie
//! beside scans: `NAME.pose.txt`, or `T_world_007.txt` of `scan_007.ply`. Two scans overlap where the smaller one shares three
//! tenths of its cells with the other.

#![allow(clippy::print_stdout)]

use std::collections::BTreeSet;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use upcr::features::Descriptors;
use upcr::multiway::{MergeSettings, Vocabulary, alike, looks};
use upcr::net::Network;
use upcr::{PointCloud, ReadyScan, Rigid, Settings, io};

/// Edge of the cells in voxels, and the share that overlapping scans have in common.
const CELL_VOXELS: f64 = 4.0;
const OVERLAPPING: f64 = 0.3;
/// Points that the network is shown, as where it learned.
const NETWORK_POINTS: usize = 1024;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args_os().skip(1);
    let folder = args.next().map(PathBuf::from).ok_or("a folder is needed")?;
    let every: usize = args.next().map_or(Ok(1), |text| text.to_string_lossy().parse())?;
    let voxel_size: Option<f64> = args.next().map(|text| text.to_string_lossy().parse()).transpose()?;
    let mut files: Vec<(PathBuf, PathBuf)> =
        folder.read_dir()?.filter_map(|entry| posed(&entry.ok()?.path())).collect();
    files.sort();
    let scans: Vec<(PointCloud, Rigid)> = files
        .iter()
        .step_by(every.max(1))
        .map(|(cloud, pose)| Ok((io::read_cloud(cloud)?, io::read_transform(pose)?)))
        .collect::<upcr::Result<_>>()?;

    let mut sizes: Vec<f64> =
        scans.iter().map(|(cloud, _)| ReadyScan::natural_voxel_size(cloud)).collect::<upcr::Result<_>>()?;
    sizes.sort_by(f64::total_cmp);
    let middle = *sizes.get(sizes.len() / 2).ok_or("there is no scan with a pose in it")?;
    let voxel_size = voxel_size.unwrap_or(middle);
    let overlapping = overlapping(&scans, CELL_VOXELS * voxel_size);
    let neighbors = MergeSettings::default().neighbors;
    println!("{} scans, voxel size {voxel_size:.4}", scans.len());
    println!(
        "| description | numbers | ms a scan | of {neighbors} neighbours overlap | parts that they join |"
    );
    println!("| --- | ---: | ---: | ---: | ---: |");

    let feature = Settings::default().feature;
    let start = Instant::now();
    let features: Vec<Descriptors> =
        scans.iter().map(|(cloud, _)| looks(cloud, voxel_size, feature)).collect::<upcr::Result<_>>()?;
    let described = start.elapsed();
    let vocabulary = Vocabulary::learn(&features, 0);
    let words: Vec<Vec<f32>> = features.iter().map(|f| vocabulary.describe(f)).collect();
    tell("words of FPFH", &words, start.elapsed().as_secs_f64(), &overlapping);

    let start = Instant::now();
    let means: Vec<Vec<f32>> = features.iter().map(mean).collect();
    tell("mean of FPFH", &means, (described + start.elapsed()).as_secs_f64(), &overlapping);

    let network = Network::embedded()?;
    let start = Instant::now();
    let invariant: Vec<Vec<f32>> = scans
        .iter()
        .map(|(cloud, _)| Ok(network.representations(&in_unit_sphere(cloud))?.invariant))
        .collect::<upcr::Result<_>>()?;
    let seconds = start.elapsed().as_secs_f64();
    tell("Γν", &centered(invariant.clone(), false), seconds, &overlapping);
    tell("Γν, whitened", &centered(invariant, true), seconds, &overlapping);
    Ok(())
}

/// The file of a scan, and of its pose.
fn posed(cloud: &Path) -> Option<(PathBuf, PathBuf)> {
    let name = cloud.file_name()?.to_str()?;
    let beside = match name.strip_prefix("scan_") {
        Some(rest) => format!("T_world_{}.txt", rest.strip_suffix(".ply")?),
        None => {
            format!("{}.pose.txt", name.strip_suffix(".ply").or_else(|| name.strip_suffix(".depth.png"))?)
        }
    };
    let pose = cloud.with_file_name(beside);
    pose.is_file().then(|| (cloud.to_owned(), pose))
}

/// For each scan those that overlap it.
fn overlapping(scans: &[(PointCloud, Rigid)], cell: f64) -> Vec<BTreeSet<usize>> {
    let cells: Vec<BTreeSet<[i64; 3]>> = scans
        .iter()
        .map(|(cloud, T_world_scan)| {
            cloud.points.iter().map(|&p| T_world_scan.apply(p).map(|v| (v / cell).floor() as i64)).collect()
        })
        .collect();
    let overlap = |a: usize, b: usize| {
        let shared = cells[a].intersection(&cells[b]).count();
        a != b && shared as f64 >= OVERLAPPING * cells[a].len().min(cells[b].len()) as f64
    };
    (0..scans.len()).map(|a| (0..scans.len()).filter(|&b| overlap(a, b)).collect()).collect()
}

fn mean(features: &Descriptors) -> Vec<f32> {
    let mut mean = vec![0.0; features.dim];
    for i in 0..features.len() {
        for (sum, v) in mean.iter_mut().zip(features.row(i)) {
            *sum += v;
        }
    }
    normalized(mean)
}

fn normalized(mut vector: Vec<f32>) -> Vec<f32> {
    let length = vector.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    for v in &mut vector {
        *v /= length;
    }
    vector
}

/// Less what all have in common, and where `whitened` each number as often its spread.
fn centered(mut vectors: Vec<Vec<f32>>, whitened: bool) -> Vec<Vec<f32>> {
    let n = vectors.len().max(1) as f32;
    for k in 0..vectors.first().map_or(0, Vec::len) {
        let mean = vectors.iter().map(|v| v[k]).sum::<f32>() / n;
        let spread = (vectors.iter().map(|v| (v[k] - mean).powi(2)).sum::<f32>() / n).sqrt();
        let scale = if whitened { 1.0 / spread.max(f32::MIN_POSITIVE) } else { 1.0 };
        for v in &mut vectors {
            v[k] = (v[k] - mean) * scale;
        }
    }
    vectors.into_iter().map(normalized).collect()
}

/// Some of a cloud's points, about their mean, the farthest at 1.
fn in_unit_sphere(cloud: &PointCloud) -> Vec<[f32; 3]> {
    let step = cloud.points.len().div_ceil(NETWORK_POINTS).max(1);
    let points: Vec<[f64; 3]> = cloud.points.iter().step_by(step).copied().collect();
    let n = points.len().max(1) as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| points.iter().map(|p| p[k]).sum::<f64>() / n);
    let off = |p: &[f64; 3]| -> [f64; 3] { std::array::from_fn(|k| p[k] - mean[k]) };
    let length = |p: &[f64; 3]| p.iter().map(|v| v * v).sum::<f64>().sqrt();
    let radius = points.iter().map(|p| length(&off(p))).fold(f64::MIN_POSITIVE, f64::max);
    points.iter().map(|p| off(p).map(|v| (v / radius) as f32)).collect()
}

fn tell(name: &str, vectors: &[Vec<f32>], seconds: f64, overlapping: &[BTreeSet<usize>]) {
    let neighbors = MergeSettings::default().neighbors;
    let mut part: Vec<usize> = (0..vectors.len()).collect();
    let (mut right, mut possible) = (0, 0);
    for (i, others) in alike(vectors, neighbors).iter().enumerate() {
        possible += overlapping[i].len().min(neighbors);
        for (j, _) in others.iter().filter(|(j, _)| overlapping[i].contains(j)) {
            right += 1;
            let [from, into] = [part[i], part[*j]];
            part.iter_mut().filter(|p| **p == from).for_each(|p| *p = into);
        }
    }
    let parts = part.iter().collect::<BTreeSet<_>>().len();
    let numbers = vectors.first().map_or(0, Vec::len);
    let each = 1e3 * seconds / vectors.len().max(1) as f64;
    println!("| {name} | {numbers} | {each:.1} | {right} of {possible} | {parts} |");
}
