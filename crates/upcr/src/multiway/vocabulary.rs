//! Which scans may show the same place: one vector a scan, of what its surface looks like and not of where it stands.
//!
//! The vectors are vectors of locally aggregated descriptors (Jégou et al., CVPR 2010): point features are given to the words
//! of a vocabulary that is learned from the scans at hand, and for each word the features' differences from it are summed.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::{PointCloud, ReadyScan, Result, features::Descriptors, features::MatchedFeature};

/// Scans are looked at more coarsely than they are registered, by this factor: what tells places apart is larger than what holds
/// a pose.
const COARSER: f64 = 3.0;
/// Features of a scan that tell what it looks like.
const LOOKED_AT: usize = 400;
/// Words of the vocabulary, rounds in which it is learned, and features that it is learned from at most.
const WORDS: usize = 64;
const ROUNDS: usize = 12;
const LEARNED_FROM: usize = 40_000;

/// Words that point features are like.
#[derive(Debug, Clone, PartialEq)]
pub struct Vocabulary {
    dim: usize,
    /// `dim` values a word.
    words: Vec<f32>,
}

/// Features as their square roots: histograms are compared by their shape then, and not by their highest bins
/// (Arandjelović and Zisserman, CVPR 2012).
fn rooted(features: &Descriptors) -> Vec<f32> {
    let mut values = Vec::with_capacity(features.values.len());
    for i in 0..features.len() {
        let row = features.row(i);
        let sum: f32 = row.iter().map(|v| v.abs()).sum::<f32>().max(f32::MIN_POSITIVE);
        values.extend(row.iter().map(|v| (v.abs() / sum).sqrt()));
    }
    values
}

fn distance_sq(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
}

fn nearest(words: &[f32], row: &[f32]) -> usize {
    let mut best = (f32::INFINITY, 0);
    for (k, word) in words.chunks_exact(row.len()).enumerate() {
        let d = distance_sq(word, row);
        if d < best.0 {
            best = (d, k);
        }
    }
    best.1
}

/// Features that tell what a scan looks like which is registered at `voxel_size`.
///
/// # Errors
/// As [`ReadyScan::new`].
pub fn looks(cloud: &PointCloud, voxel_size: f64, feature: MatchedFeature) -> Result<Descriptors> {
    let coarse = ReadyScan::new(cloud, COARSER * voxel_size, feature)?;
    let (_, all) = coarse.features();
    let step = all.len().div_ceil(LOOKED_AT).max(1);
    let values = (0..all.len()).step_by(step).flat_map(|i| all.row(i)).copied().collect();
    Ok(Descriptors { dim: all.dim, values })
}

impl Vocabulary {
    /// Learns it from the features of all scans, by k-means from seeded beginnings.
    pub fn learn(scans: &[Descriptors], seed: u64) -> Self {
        let dim = scans.iter().map(|s| s.dim).max().unwrap_or(0);
        let total: usize = scans.iter().map(Descriptors::len).sum();
        let step = total.div_ceil(LEARNED_FROM).max(1);
        let rows: Vec<f32> = scans
            .iter()
            .flat_map(rooted)
            .collect::<Vec<f32>>()
            .chunks_exact(dim.max(1))
            .step_by(step)
            .flatten()
            .copied()
            .collect();
        let count = rows.len() / dim.max(1);
        if count == 0 {
            return Self { dim, words: Vec::new() };
        }
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut words: Vec<f32> = (0..WORDS.min(count))
            .flat_map(|_| {
                let at = rng.random_range(0..count as u64) as usize;
                rows[at * dim..(at + 1) * dim].to_vec()
            })
            .collect();
        for _ in 0..ROUNDS {
            let given: Vec<usize> = rows.par_chunks_exact(dim).map(|row| nearest(&words, row)).collect();
            let mut sums = vec![0.0_f64; words.len()];
            let mut counts = vec![0_usize; words.len() / dim];
            for (row, &k) in rows.chunks_exact(dim).zip(&given) {
                counts[k] += 1;
                sums[k * dim..(k + 1) * dim].iter_mut().zip(row).for_each(|(s, &v)| *s += f64::from(v));
            }
            for (k, &n) in counts.iter().enumerate() {
                for c in k * dim..(k + 1) * dim {
                    // A word that nothing is like begins anew.
                    words[c] = if n > 0 {
                        (sums[c] / n as f64) as f32
                    } else {
                        rows[(k * count / counts.len()) * dim + c - k * dim]
                    };
                }
            }
        }
        Self { dim, words }
    }

    /// The vector of a scan, of length 1; of length 0 where it has no features.
    pub fn describe(&self, features: &Descriptors) -> Vec<f32> {
        let mut vector = vec![0.0_f32; self.words.len()];
        if self.words.is_empty() || features.dim != self.dim {
            return vector;
        }
        for row in rooted(features).chunks_exact(self.dim) {
            let k = nearest(&self.words, row);
            let range = k * self.dim..(k + 1) * self.dim;
            vector[range.clone()]
                .iter_mut()
                .zip(row.iter().zip(&self.words[range]))
                .for_each(|(v, (x, w))| *v += x - w);
        }
        // No word outweighs the others, and no burst of like features its word.
        for word in vector.chunks_exact_mut(self.dim) {
            normalize(word);
        }
        for v in &mut vector {
            *v = v.signum() * v.abs().sqrt();
        }
        normalize(&mut vector);
        vector
    }
}

/// To length 1, where there is any.
pub(super) fn normalize(vector: &mut [f32]) {
    let length = vector.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 {
        for v in vector {
            *v /= length;
        }
    }
}

/// For each vector the others, the most alike first: at most `count`.
pub fn alike(vectors: &[Vec<f32>], count: usize) -> Vec<Vec<(usize, f32)>> {
    let dot = |a: &[f32], b: &[f32]| -> f32 { a.iter().zip(b).map(|(x, y)| x * y).sum() };
    vectors
        .par_iter()
        .enumerate()
        .map(|(i, a)| {
            let mut others: Vec<(usize, f32)> =
                vectors.iter().enumerate().filter(|(j, _)| *j != i).map(|(j, b)| (j, dot(a, b))).collect();
            others.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            others.truncate(count);
            others
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Features of a place: histograms about centres that differ from place to place.
    fn features(place: u64, view: u64) -> Descriptors {
        let mut centers = ChaCha8Rng::seed_from_u64(place);
        let centers: Vec<f32> = (0..40 * 33).map(|_| centers.random::<f32>().powi(4)).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(1000 * place + view);
        let values = (0..300)
            .flat_map(|_| {
                let k = rng.random_range(0..40u64) as usize;
                (0..33).map(|c| centers[33 * k + c] + 0.05 * rng.random::<f32>()).collect::<Vec<_>>()
            })
            .collect();
        Descriptors { dim: 33, values }
    }

    #[test]
    fn views_of_a_place_are_alike() {
        let scans: Vec<Descriptors> = (0..20).map(|i| features(i / 4, i % 4)).collect();
        let vocabulary = Vocabulary::learn(&scans, 7);
        assert_eq!(vocabulary, Vocabulary::learn(&scans, 7));
        let vectors: Vec<Vec<f32>> = scans.iter().map(|s| vocabulary.describe(s)).collect();
        for (i, others) in alike(&vectors, 3).iter().enumerate() {
            let same = others.iter().filter(|(j, _)| j / 4 == i / 4).count();
            assert!(others[0].0 / 4 == i / 4 && same >= 2, "{i}: {others:?}");
        }
    }

    #[test]
    fn nothing_is_like_nothing() {
        let empty = Descriptors { dim: 33, values: Vec::new() };
        let vocabulary = Vocabulary::learn(&[empty.clone(), empty.clone()], 0);
        assert!(vocabulary.describe(&empty).is_empty());
        assert_eq!(alike(&[Vec::new(), Vec::new()], 5), [[(1, 0.0)], [(0, 0.0)]]);
        assert!(Vocabulary::learn(&[], 0).describe(&features(0, 0)).is_empty());
    }
}
