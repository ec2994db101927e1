//! Matches between the features of two clouds.

use rayon::prelude::*;

use nalgebra::Vector3;

use crate::{features::Descriptors, prepare::Level, transform::Rigid};

/// Descriptor rows compared at a time: a block of distances stays in cache.
const BLOCK: usize = 64;

/// A source point and the target point whose feature is most like its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Match {
    pub source: [f32; 3],
    pub target: [f32; 3],
    pub source_normal: [f32; 3],
    pub target_normal: [f32; 3],
    /// Distance to the best feature over that to the second best: 0 distinctive, 1 not at all.
    pub ratio: f32,
    /// Each is the other's best.
    pub mutual: bool,
}

impl Match {
    /// Whether `pose` lays the source point within `tolerance` of the target point.
    pub fn agrees_with(&self, pose: &Rigid, tolerance: f32) -> bool {
        let y = pose.rotation * Vector3::from(self.source.map(f64::from)) + pose.translation;
        (y - Vector3::from(self.target.map(f64::from))).norm_squared() <= f64::from(tolerance * tolerance)
    }
}

/// The match of every source point.
pub(crate) fn match_levels(source: (&Level, &Descriptors), target: (&Level, &Descriptors)) -> Vec<Match> {
    match_features(source.1, target.1)
        .into_iter()
        .map(|(i, j, ratio, mutual)| Match {
            source: source.0.points[i as usize],
            target: target.0.points[j as usize],
            source_normal: source.0.normals[i as usize],
            target_normal: target.0.normals[j as usize],
            ratio,
            mutual,
        })
        .collect()
}

/// Nearest row of another set: its index, its squared distance, and that of the second nearest.
#[derive(Debug, Clone, Copy)]
struct Best {
    index: u32,
    distance_sq: f32,
    second_sq: f32,
}

impl Best {
    const NONE: Self = Self { index: 0, distance_sq: f32::INFINITY, second_sq: f32::INFINITY };

    fn offer(&mut self, index: u32, distance_sq: f32) {
        if distance_sq < self.distance_sq {
            self.second_sq = self.distance_sq;
            self.distance_sq = distance_sq;
            self.index = index;
        } else if distance_sq < self.second_sq {
            self.second_sq = distance_sq;
        }
    }
}

/// Index pairs (source, target) of nearest features, with ratio and mutuality, in the source's order.
fn match_features(source: &Descriptors, target: &Descriptors) -> Vec<(u32, u32, f32, bool)> {
    if source.is_empty() || target.is_empty() {
        return Vec::new();
    }
    let (forward, backward) = rayon::join(|| nearest_rows(source, target), || nearest_rows(target, source));
    forward
        .iter()
        .enumerate()
        .map(|(i, best)| {
            let ratio = if best.second_sq > 0.0 { (best.distance_sq / best.second_sq).sqrt() } else { 1.0 };
            (i as u32, best.index, ratio, backward[best.index as usize].index == i as u32)
        })
        .collect()
}

/// For every row of `queries` its nearest of `rows`, by blocks of one matrix product each.
fn nearest_rows(queries: &Descriptors, rows: &Descriptors) -> Vec<Best> {
    let dim = rows.dim;
    let norms: Vec<f32> = (0..rows.len()).map(|j| rows.row(j).iter().map(|v| v * v).sum::<f32>()).collect();
    let blocks: Vec<Vec<Best>> = (0..queries.len().div_ceil(BLOCK))
        .into_par_iter()
        .map_init(
            || vec![0.0f32; BLOCK * rows.len()],
            |products, block| {
                let first = block * BLOCK;
                let count = BLOCK.min(queries.len() - first);
                let a = &queries.values[first * dim..(first + count) * dim];
                multiply_transposed(a, &rows.values, count, rows.len(), dim, products);
                (0..count)
                    .map(|i| {
                        let norm: f32 = queries.row(first + i).iter().map(|v| v * v).sum();
                        let line = &products[i * rows.len()..(i + 1) * rows.len()];
                        let mut best = Best::NONE;
                        for (j, (&product, &n)) in line.iter().zip(&norms).enumerate() {
                            best.offer(j as u32, n - 2.0 * product);
                        }
                        best.distance_sq = (best.distance_sq + norm).max(0.0);
                        best.second_sq = (best.second_sq + norm).max(0.0);
                        best
                    })
                    .collect()
            },
        )
        .collect();
    blocks.concat()
}

/// `c = a bᵀ` for row-major `a` (m × k) and `b` (n × k).
fn multiply_transposed(a: &[f32], b: &[f32], m: usize, n: usize, k: usize, c: &mut [f32]) {
    assert!(a.len() >= m * k && b.len() >= n * k && c.len() >= m * n);
    let stride = k as isize;
    // SAFETY: the slices hold as many values as the shapes and strides reach, as just asserted.
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.as_ptr(),
            stride,
            1,
            b.as_ptr(),
            1,
            stride,
            0.0,
            c.as_mut_ptr(),
            n as isize,
            1,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_nearest_rows_and_says_which_are_mutual() {
        let target = Descriptors { dim: 2, values: vec![0.0, 0.0, 10.0, 0.0, 0.0, 10.0] };
        let source = Descriptors { dim: 2, values: vec![9.0, 0.5, 0.1, 9.0, 8.0, 0.0] };
        let matches = match_features(&source, &target);
        let pairs: Vec<_> = matches.iter().map(|m| (m.0, m.1, m.3)).collect();
        assert_eq!(pairs, [(0, 1, true), (1, 2, true), (2, 1, false)]);
        assert!(matches.iter().all(|m| m.2 > 0.0 && m.2 < 0.5));
    }
}
