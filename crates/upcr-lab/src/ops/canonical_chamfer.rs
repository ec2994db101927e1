//! The unsupervised loss (equation 7): the Chamfer distance between two clouds in their canonical poses.

use std::array::from_fn;

use multiversion::multiversion;
use rayon::prelude::*;

/// The clouds of the pairs of a batch: a cloud's points row after row, sources first, then targets, in order.
#[derive(Debug, Clone, Default)]
pub struct PairPoints {
    /// Coordinates of all clouds.
    pub points: Vec<[f32; 3]>,
    /// Cloud `c` has the points `offsets[c]..offsets[c + 1]`.
    pub offsets: Vec<usize>,
}

impl PairPoints {
    /// Number of pairs.
    pub fn pairs(&self) -> usize {
        self.offsets.len() / 2
    }

    /// Points of a cloud.
    pub fn cloud(&self, cloud: usize) -> &[[f32; 3]] {
        &self.points[self.offsets[cloud]..self.offsets[cloud + 1]]
    }
}

/// The loss of every pair, and its gradients with respect to the rotations (`[clouds, 9]`, row by row) and the
/// translations (`[clouds, 3]`) that lead from a canonical shape to its cloud: X = R·X_c + t.
pub fn forward(
    rotations: &[f32],
    translations: &[f32],
    clouds: &PairPoints,
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let pairs = clouds.pairs();
    let found: Vec<_> = (0..pairs)
        .into_par_iter()
        .with_max_len(1)
        .map(|pair| {
            let [x, y] = [pair, pairs + pair].map(|cloud| {
                canonical(clouds.cloud(cloud), &rotations[cloud * 9..][..9], &translations[cloud * 3..][..3])
            });
            let (mut grad_x, mut grad_y) = (vec![[0.0; 3]; x.len()], vec![[0.0; 3]; y.len()]);
            let loss = one_way(&x, &y, &mut grad_x, &mut grad_y) + one_way(&y, &x, &mut grad_y, &mut grad_x);
            let gradients = [(pair, grad_x), (pairs + pair, grad_y)].map(|(cloud, gradients)| {
                let (points, t) = (clouds.cloud(cloud), &translations[cloud * 3..][..3]);
                pose_gradients(points, &gradients, &rotations[cloud * 9..][..9], t)
            });
            (loss, gradients)
        })
        .collect();
    let losses = found.iter().map(|(loss, _)| *loss as f32).collect();
    let (mut grad_rotations, mut grad_translations) =
        (Vec::with_capacity(rotations.len()), Vec::with_capacity(translations.len()));
    for side in 0..2 {
        for (_, gradients) in &found {
            let (rotation, translation) = &gradients[side];
            grad_rotations.extend(rotation.map(|v| v as f32));
            grad_translations.extend(translation.map(|v| v as f32));
        }
    }
    (losses, grad_rotations, grad_translations)
}

/// Rᵀ(x - t) of every point.
pub(super) fn canonical(points: &[[f32; 3]], rotation: &[f32], t: &[f32]) -> Vec<[f32; 3]> {
    let turned = |p: &[f32; 3]| {
        let d = [p[0] - t[0], p[1] - t[1], p[2] - t[2]];
        from_fn(|c| (0..3).map(|r| rotation[r * 3 + c] * d[r]).sum())
    };
    points.iter().map(turned).collect()
}

/// The mean squared distance from the points `x` to the nearest of `y`; adds its gradients.
fn one_way(x: &[[f32; 3]], y: &[[f32; 3]], grad_x: &mut [[f32; 3]], grad_y: &mut [[f32; 3]]) -> f64 {
    let mut nearest = vec![0; x.len()];
    nearest_points(x, y, &mut nearest);
    let share = 2.0 / x.len() as f32;
    let mut sum = 0.0;
    for ((x, grad_x), &j) in x.iter().zip(grad_x).zip(&nearest) {
        let (y, grad_y) = (&y[j as usize], &mut grad_y[j as usize]);
        for a in 0..3 {
            let d = x[a] - y[a];
            sum += f64::from(d * d);
            grad_x[a] += share * d;
            grad_y[a] -= share * d;
        }
    }
    sum / x.len() as f64
}

/// With X_c = Rᵀ(X - t) and g the gradients of X_c: dR = Σ (x - t) gᵀ and dt = -R Σ g.
fn pose_gradients(
    points: &[[f32; 3]],
    gradients: &[[f32; 3]],
    rotation: &[f32],
    t: &[f32],
) -> ([f64; 9], [f64; 3]) {
    let (mut grad_rotation, mut sum) = ([0.0; 9], [0.0; 3]);
    for (p, g) in points.iter().zip(gradients) {
        for c in 0..3 {
            sum[c] += f64::from(g[c]);
            for r in 0..3 {
                grad_rotation[r * 3 + c] += f64::from((p[r] - t[r]) * g[c]);
            }
        }
    }
    let grad_t = |r: usize| -(0..3).map(|c| f64::from(rotation[r * 3 + c]) * sum[c]).sum::<f64>();
    (grad_rotation, from_fn(grad_t))
}

/// For every point of `x` the index of the nearest of `y`, the first of equally near ones.
fn nearest_points(x: &[[f32; 3]], y: &[[f32; 3]], nearest: &mut [u32]) {
    // Padded with points that are nearest to nothing.
    let padded = y.len().next_multiple_of(LANES);
    let coordinates: Vec<f32> =
        (0..3).flat_map(|a| (0..padded).map(move |j| y.get(j).map_or(f32::INFINITY, |p| p[a]))).collect();
    search(x, &coordinates, padded, nearest);
}

const LANES: usize = 16;

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn search(x: &[[f32; 3]], coordinates: &[f32], padded: usize, nearest: &mut [u32]) {
    let (ys, zs) = (&coordinates[padded..2 * padded], &coordinates[2 * padded..]);
    for (p, nearest) in x.iter().zip(nearest) {
        let (mut best, mut block) = ([f32::INFINITY; LANES], [0_i32; LANES]);
        let blocks = coordinates[..padded]
            .as_chunks::<LANES>()
            .0
            .iter()
            .zip(ys.as_chunks::<LANES>().0)
            .zip(zs.as_chunks::<LANES>().0);
        for (at, ((xs, ys), zs)) in (0_i32..).zip(blocks) {
            let (mut next_best, mut next_block) = ([0.0; LANES], [0; LANES]);
            for l in 0..LANES {
                let (dx, dy, dz) = (xs[l] - p[0], ys[l] - p[1], zs[l] - p[2]);
                let distance_sq = dx * dx + dy * dy + dz * dz;
                let nearer = distance_sq < best[l];
                next_best[l] = if nearer { distance_sq } else { best[l] };
                next_block[l] = if nearer { at } else { block[l] };
            }
            (best, block) = (next_best, next_block);
        }
        let mut found = (f32::INFINITY, u32::MAX);
        for l in 0..LANES {
            let index = block[l] as u32 * LANES as u32 + l as u32;
            if best[l] < found.0 || (best[l] == found.0 && index < found.1) {
                found = (best[l], index);
            }
        }
        *nearest = if found.0 < f32::INFINITY { found.1 } else { 0 };
    }
}
