//! How well one cloud lies on the other.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::{prepare::Level, transform::Rigid};

const BLOCK: usize = 128;

/// Squared distances of some points of one cloud to the nearest of the other; infinite beyond the limit.
struct Distances(Vec<f32>);

/// Distances of the points `indices` of `from`, moved by `pose`, to `to`, as far as `limit`.
fn distances(from: &Level, indices: &[u32], to: &Level, pose: &Rigid, limit: f32) -> Distances {
    let rotation = pose.rotation.map(|v| v as f32);
    let translation = pose.translation.map(|v| v as f32);
    let one = |&i: &u32| {
        let y = rotation * Vector3::from(from.points[i as usize]) + translation;
        to.tree.nearest(y.into(), limit * limit).map_or(f32::INFINITY, |n| n.distance_sq)
    };
    Distances(indices.par_iter().with_min_len(BLOCK).map(one).collect())
}

impl Distances {
    /// Mean of max(0, 1 − d²/limit²): truncated least squares turned into a score from 0 to 1.
    fn score(&self, limit: f32) -> f64 {
        let scale = 1.0 / (limit * limit);
        let sum: f64 = self.0.iter().map(|&d| f64::from((1.0 - d * scale).max(0.0))).sum();
        sum / self.0.len().max(1) as f64
    }
}

/// Distances of points of either cloud to the other, as far as a limit.
pub(crate) struct Overlap {
    forward: Distances,
    backward: Distances,
    limit: f32,
}

/// The overlap of two clouds at `pose`, seen by at most `count` points of each.
pub(crate) fn overlap_at(source: &Level, target: &Level, pose: &Rigid, count: usize, limit: f32) -> Overlap {
    Overlap {
        forward: distances(source, &source.spread(count), target, pose, limit),
        backward: distances(target, &target.spread(count), source, &pose.inverse(), limit),
        limit,
    }
}

impl Overlap {
    /// Mean score of both directions over `scales` limits, each half the one before: coarse agreement decides
    /// first, and between poses that agree coarsely (a symmetric object's) the fine one does.
    pub fn score(&self, scales: u32) -> f64 {
        let total: f64 = (0..scales)
            .map(|s| {
                let at = self.limit / (1u32 << s) as f32;
                0.5 * (self.forward.score(at) + self.backward.score(at))
            })
            .sum();
        total / f64::from(scales)
    }
}
