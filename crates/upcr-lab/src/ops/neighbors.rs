//! Neighbours by features.

use multiversion::multiversion;
use rayon::prelude::*;
use upcr::net::Graph;

use super::batch::BatchGraph;
use super::buffer::Buffer;
use super::product::{Matrix, product};

/// The `k` nearest neighbours of every row of `features` `[clouds · count, channels]` among the `count` of its cloud, itself
/// included. Squared distances are ‖a‖² − 2ab + ‖b‖² in single precision; of equal ones the first row's comes first.
pub fn nearest_features(features: &[f32], count: usize, channels: usize, k: usize) -> BatchGraph {
    let k = k.min(count);
    let nearest = |cloud: &[f32]| {
        let rows = Matrix::rows(cloud, channels);
        let mut products = Buffer::new(count * count);
        product([count, channels, count], rows, rows.transposed(), &mut products, false);
        let squares: Vec<f32> =
            cloud.chunks_exact(channels).map(|row| row.iter().map(|v| v * v).sum()).collect();
        let mut neighbors = Vec::with_capacity(count * k);
        let mut keys = vec![0; count];
        for (products, square) in products.chunks_exact(count).zip(&squares) {
            distance_keys(products, *square, &squares, &mut keys);
            smallest(&keys, k, &mut neighbors);
        }
        Graph { k, neighbors }
    };
    let graphs: Vec<Graph> = features.par_chunks(count * channels).with_max_len(1).map(nearest).collect();
    BatchGraph::new(&graphs, k)
}

/// Whole numbers in the order of a row's squared distances.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn distance_keys(products: &[f32], square: f32, squares: &[f32], keys: &mut [i32]) {
    for ((key, product), other) in keys.iter_mut().zip(products).zip(squares) {
        let bits = (square - product * 2.0 + other).to_bits() as i32;
        *key = bits ^ (((bits >> 31) as u32) >> 1) as i32;
    }
}

/// Appends the places of the `k` smallest keys, in order.
fn smallest(keys: &[i32], k: usize, places: &mut Vec<u32>) {
    let first = places.len();
    for (place, &key) in keys.iter().enumerate() {
        let full = places.len() - first == k;
        if full && places.last().is_some_and(|&last| keys[last as usize] <= key) {
            continue;
        }
        if full {
            places.pop();
        }
        let at = first + places[first..].partition_point(|&other| keys[other as usize] <= key);
        places.insert(at, place as u32);
    }
}
