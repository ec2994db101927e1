//! Matches between the features of two clouds.

use multiversion::multiversion;
use rayon::prelude::*;

use nalgebra::Vector3;

use crate::{features::Descriptors, prepare::Level, transform::Rigid};

/// Descriptor rows compared at a time: a block of distances stays in cache.
const BLOCK: usize = 32;
/// Features of a cloud that are matched, at most.
const MAX_ROWS: usize = 800;
/// Blocks a parallel task takes.
const BLOCKS_PER_TASK: usize = 8;
/// Columns looked at together.
const LANES: usize = 16;

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

/// Whether three matches span edges of the same length in both clouds, up to the ratio `edge_ratio`, and none
/// shorter than `shortest`.
pub(super) fn are_congruent(triple: [&Match; 3], edge_ratio: f32, shortest: f32) -> bool {
    [(0, 1), (1, 2), (2, 0)].iter().all(|&(a, b)| {
        let length = |p: [f32; 3], q: [f32; 3]| (Vector3::from(p) - Vector3::from(q)).norm();
        let source = length(triple[a].source, triple[b].source);
        let target = length(triple[a].target, triple[b].target);
        source > shortest && source.min(target) >= edge_ratio * source.max(target)
    })
}

/// The match of every distinctive source point.
pub(crate) fn match_levels(source: (&Level, &Descriptors), target: (&Level, &Descriptors)) -> Vec<Match> {
    let ((from, from_rows), (to, to_rows)) = (distinctive(source.1), distinctive(target.1));
    match_features(&from_rows, &to_rows)
        .into_iter()
        .map(|(i, j, ratio, mutual)| (from[i as usize], to[j as usize], ratio, mutual))
        .map(|(i, j, ratio, mutual)| Match {
            source: source.0.points[i],
            target: target.0.points[j],
            source_normal: source.0.normals[i],
            target_normal: target.0.normals[j],
            ratio,
            mutual,
        })
        .collect()
}

/// The rows that differ most from the cloud's mean, [`MAX_ROWS`] at most, and their indices, ascending.
///
/// What most of a scan looks like (walls, floors) tells no place from another; Rusu et al. (IROS 2008) keep the
/// points whose histogram is far from the mean for the same reason.
fn distinctive(all: &Descriptors) -> (Vec<usize>, Descriptors) {
    if all.len() <= MAX_ROWS {
        return ((0..all.len()).collect(), all.clone());
    }
    let mut mean = vec![0.0f64; all.dim];
    for i in 0..all.len() {
        mean.iter_mut().zip(all.row(i)).for_each(|(m, &v)| *m += f64::from(v));
    }
    let mean: Vec<f32> = mean.iter().map(|m| (m / all.len() as f64) as f32).collect();
    let mut ranked: Vec<(f32, usize)> = (0..all.len())
        .map(|i| (all.row(i).iter().zip(&mean).map(|(v, m)| (v - m) * (v - m)).sum(), i))
        .collect();
    ranked.select_nth_unstable_by(MAX_ROWS, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut kept: Vec<usize> = ranked[..MAX_ROWS].iter().map(|r| r.1).collect();
    kept.sort_unstable();
    let values = kept.iter().flat_map(|&i| all.row(i)).copied().collect();
    (kept, Descriptors { dim: all.dim, values })
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

    /// The better of two, the lower index where they are equal.
    fn or(self, other: Self) -> Self {
        let (first, last) =
            match self.distance_sq.total_cmp(&other.distance_sq).then(self.index.cmp(&other.index)) {
                std::cmp::Ordering::Greater => (other, self),
                _ => (self, other),
            };
        Self { second_sq: first.second_sq.min(last.distance_sq), ..first }
    }
}

/// Index pairs (source, target) of nearest features, with ratio and mutuality, in the source's order.
fn match_features(source: &Descriptors, target: &Descriptors) -> Vec<(u32, u32, f32, bool)> {
    if source.is_empty() || target.is_empty() {
        return Vec::new();
    }
    let (forward, backward) = nearest_rows(source, target);
    forward
        .iter()
        .enumerate()
        .map(|(i, best)| {
            let ratio = if best.second_sq > 0.0 { (best.distance_sq / best.second_sq).sqrt() } else { 1.0 };
            (i as u32, best.index, ratio, backward[best.index as usize] == i as u32)
        })
        .collect()
}

/// For every row of `a` its nearest of `b`, and for every row of `b` the index of its nearest of `a`: one matrix
/// product, by blocks of rows of `a`.
fn nearest_rows(a: &Descriptors, b: &Descriptors) -> (Vec<Best>, Vec<u32>) {
    let squares = |d: &Descriptors| -> Vec<f32> {
        (0..d.len()).map(|i| d.row(i).iter().map(|v| v * v).sum()).collect()
    };
    let (a_sq, b_sq) = (squares(a), squares(b));
    let blocks: Vec<(Vec<Best>, Columns)> = (0..a.len().div_ceil(BLOCK * BLOCKS_PER_TASK))
        .into_par_iter()
        .map(|task| {
            let mut products = vec![0.0f32; BLOCK * b.len()];
            let mut columns = Columns { distance_sq: vec![f32::INFINITY; b.len()], index: vec![0; b.len()] };
            let mut rows = Vec::with_capacity(BLOCK * BLOCKS_PER_TASK);
            let start = task * BLOCK * BLOCKS_PER_TASK;
            for first in (start..a.len().min(start + BLOCK * BLOCKS_PER_TASK)).step_by(BLOCK) {
                let count = BLOCK.min(a.len() - first);
                multiply_transposed(
                    &a.values[first * a.dim..(first + count) * a.dim],
                    &b.values,
                    count,
                    b.len(),
                    a.dim,
                    &mut products,
                );
                for i in 0..count {
                    let line = &mut products[i * b.len()..(i + 1) * b.len()];
                    let best = scan_row(line, a_sq[first + i], &b_sq, (first + i) as u32, &mut columns);
                    rows.push(best);
                }
            }
            (rows, columns)
        })
        .collect();
    let mut rows = Vec::with_capacity(a.len());
    let mut columns = Columns { distance_sq: vec![f32::INFINITY; b.len()], index: vec![0; b.len()] };
    for (part, theirs) in blocks {
        rows.extend(part);
        for j in 0..b.len() {
            if theirs.distance_sq[j] < columns.distance_sq[j] {
                columns.distance_sq[j] = theirs.distance_sq[j];
                columns.index[j] = theirs.index[j];
            }
        }
    }
    (rows, columns.index)
}

/// For every column the least distance so far and the row that has it.
struct Columns {
    distance_sq: Vec<f32>,
    index: Vec<u32>,
}

/// Turns a row of products into squared distances, updates the columns and finds the row's best.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn scan_row(line: &mut [f32], a_sq: f32, b_sq: &[f32], row: u32, columns: &mut Columns) -> Best {
    for (d, n) in line.iter_mut().zip(b_sq) {
        *d = (a_sq + n - 2.0 * *d).max(0.0);
    }
    for ((d, best), index) in line.iter().zip(&mut columns.distance_sq).zip(&mut columns.index) {
        let better = *d < *best;
        *best = if better { *d } else { *best };
        *index = if better { row } else { *index };
    }
    // Each lane keeps its own best and second best; they meet at the end.
    let (mut least, mut second, mut at) = ([f32::INFINITY; LANES], [f32::INFINITY; LANES], [0u32; LANES]);
    let (chunks, rest) = line.as_chunks::<LANES>();
    for (c, chunk) in chunks.iter().enumerate() {
        for l in 0..LANES {
            let d = chunk[l];
            let better = d < least[l];
            second[l] = second[l].min(if better { least[l] } else { d });
            least[l] = if better { d } else { least[l] };
            at[l] = if better { c as u32 } else { at[l] };
        }
    }
    let mut best = Best::NONE;
    for l in 0..LANES.min(line.len()) {
        let index = at[l] * LANES as u32 + l as u32;
        best = best.or(Best { index, distance_sq: least[l], second_sq: second[l] });
    }
    for (l, &d) in rest.iter().enumerate() {
        let index = (chunks.len() * LANES + l) as u32;
        best = best.or(Best { index, distance_sq: d, second_sq: f32::INFINITY });
    }
    best
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
