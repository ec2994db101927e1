//! Our features against those of Open3D and PCL; `golden/README.md` says how theirs were made.

#![allow(clippy::unwrap_used)]

use std::path::Path;

use upcr::features::{Descriptors, Feature, FeatureInput, Fpfh, Pfh, Spfh};
use upcr::neighbors::{KdTree, Neighborhoods};

const RADIUS: f32 = 0.5;

fn rows(file: &str) -> Vec<Vec<f32>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(file);
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| line.split_whitespace().map(|v| v.parse().unwrap()).collect()).collect()
}

fn compute(feature: &dyn Feature, neighborhoods: impl Fn(&KdTree) -> Neighborhoods) -> Descriptors {
    let cloud = rows("cloud.txt");
    let points: Vec<_> = cloud.iter().map(|row| [row[0], row[1], row[2]]).collect();
    let normals: Vec<_> = cloud.iter().map(|row| [row[3], row[4], row[5]]).collect();
    let neighborhoods = neighborhoods(&KdTree::new(&points));
    feature
        .compute(&FeatureInput { points: &points, normals: &normals, neighborhoods: &neighborhoods })
        .unwrap()
}

fn within_radius(tree: &KdTree) -> Neighborhoods {
    tree.radius_graph(RADIUS, usize::MAX)
}

/// Every entry agrees to 1e-3, relative or absolute: no pair of this cloud lies on a bin's edge.
fn assert_agrees(ours: &Descriptors, file: &str) {
    let theirs = rows(file);
    assert_eq!(ours.len(), theirs.len());
    let mut worst = 0.0_f32;
    for (i, theirs) in theirs.iter().enumerate() {
        assert_eq!(ours.dim, theirs.len());
        for (a, b) in ours.row(i).iter().zip(theirs) {
            worst = worst.max((a - b).abs() / b.abs().max(1.0));
        }
    }
    assert!(worst < 1e-3, "{file}: off by {worst}");
}

#[test]
fn fpfh_is_that_of_open3d() {
    assert_agrees(&compute(&Fpfh, within_radius), "open3d_fpfh.txt");
}

/// PCL leaves out the point's own histogram, which the paper and Open3D add.
#[test]
fn fpfh_without_the_own_histogram_is_that_of_pcl() {
    let mut ours = compute(&Fpfh, within_radius);
    let own = compute(&Spfh, within_radius);
    for (value, own) in ours.values.iter_mut().zip(own.values) {
        *value -= own;
    }
    assert_agrees(&ours, "pcl_fpfh.txt");
}

#[test]
fn spfh_is_that_of_pcl() {
    assert_agrees(&compute(&Spfh, within_radius), "pcl_spfh.txt");
}

#[test]
fn pfh_is_that_of_pcl() {
    assert_agrees(&compute(&Pfh, |tree| tree.knn_graph(24)), "pcl_pfh.txt");
}
