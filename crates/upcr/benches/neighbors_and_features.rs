//! Neighbour search, normals, sampling and every feature, on points scattered over a bumpy torus.

use std::f32::consts::{PI, TAU};

use divan::{Bencher, black_box};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use upcr::cloud::{farthest_points, local_planes};
use upcr::features::{self, FeatureInput};
use upcr::neighbors::KdTree;

fn main() {
    divan::main();
}

fn bumpy_torus(n: usize) -> Vec<[f32; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut point = || {
        let (u, v) = (rng.random_range(0.0..TAU), rng.random_range(0.0..TAU));
        let r = 0.3 + 0.05 * (5.0 * u).sin();
        [(1.0 + r * v.cos()) * u.cos(), (1.0 + r * v.cos()) * u.sin(), r * v.sin()]
    };
    (0..n).map(|_| point()).collect()
}

/// The radius within which about 100 of `n` points lie.
fn radius_of_hundred(n: usize) -> f32 {
    let area = TAU * TAU * 0.3;
    (100.0 / n as f32 * area / PI).sqrt()
}

#[divan::bench(args = [1024, 20_000, 120_000])]
fn build(bencher: Bencher, n: usize) {
    let points = bumpy_torus(n);
    bencher.bench(|| KdTree::new(black_box(&points)));
}

#[divan::bench(args = [1024, 20_000, 120_000])]
fn nearest(bencher: Bencher, n: usize) {
    let points = bumpy_torus(n);
    let tree = KdTree::new(&points);
    let mut queries = points.iter().map(|p| p.map(|v| v + 0.01)).cycle();
    bencher.bench_local(|| queries.next().map(|q| tree.nearest(q, f32::INFINITY)));
}

#[divan::bench(args = [1024, 4000])]
fn knn_graph_of_24(bencher: Bencher, n: usize) {
    let tree = KdTree::new(&bumpy_torus(n));
    bencher.bench(|| tree.knn_graph(24));
}

#[divan::bench(args = [4000, 20_000])]
fn radius_graph_of_100(bencher: Bencher, n: usize) {
    let tree = KdTree::new(&bumpy_torus(n));
    bencher.bench(|| tree.radius_graph(radius_of_hundred(n), 100));
}

#[divan::bench(args = [1024, 20_000])]
fn normals_of_24(bencher: Bencher, n: usize) {
    let points = bumpy_torus(n);
    let neighborhoods = KdTree::new(&points).knn_graph(24);
    bencher.bench(|| local_planes(&points, &neighborhoods));
}

#[divan::bench(args = [1024])]
fn farthest_of_20_000(bencher: Bencher, count: usize) {
    let points = bumpy_torus(20_000);
    bencher.bench(|| farthest_points(&points, count, 0));
}

/// 1,024 points with 24 neighbours each, the search included.
#[divan::bench(args = features::ALL.iter().map(|f| f.name()))]
fn feature_of_24(bencher: Bencher, name: &str) {
    bench_feature(bencher, name, 1024, |tree| tree.knn_graph(24));
}

/// 4,000 points with about 100 neighbours each, the search included.
#[divan::bench(args = ["spfh", "fpfh"])]
fn feature_of_100(bencher: Bencher, name: &str) {
    bench_feature(bencher, name, 4000, |tree| tree.radius_graph(radius_of_hundred(4000), 100));
}

fn bench_feature(
    bencher: Bencher,
    name: &str,
    n: usize,
    graph: impl Fn(&KdTree) -> upcr::neighbors::Neighborhoods + Sync,
) {
    let points = bumpy_torus(n);
    let planes = local_planes(&points, &graph(&KdTree::new(&points)));
    let normals: Vec<_> = planes.iter().map(|plane| plane.normal).collect();
    let feature = features::by_name(name);
    bencher.bench(|| {
        let neighborhoods = graph(&KdTree::new(&points));
        let input = FeatureInput { points: &points, normals: &normals, neighborhoods: &neighborhoods };
        feature.map(|feature| feature.compute(&input))
    });
}
