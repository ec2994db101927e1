//! What can be seen of a pose once it is found.

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::Serialize;

use crate::{prepare::Level, transform::Rigid};

const BLOCK: usize = 64;
/// Surfaces this many voxels apart still look as if they were meant to meet.
const NEAR_VOXELS: f32 = 4.0;
/// Residuals relative to the cloud's own are told up to this.
const MOST_RESIDUAL: f64 = 1000.0;
/// Normals that enclose a smaller angle than this (cosine, 25°) agree.
const FACING_COSINE: f32 = 0.906;

/// What speaks for and against a pose; all that the probability is made of. Counts and shares are of points that the
/// refinement did not use, of both clouds, unless said otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Evidence {
    /// Share of the source's points with a target point within a voxel, and of the target's with a source point.
    pub overlap: [f64; 2],
    /// Points within a voxel of the other cloud.
    pub inliers: usize,
    /// Score of the pose over several distances relative to the largest of them: 1 where residuals vanish.
    pub closeness: f64,
    /// Median distance of points from the other cloud's tangent planes over that from their own cloud's: about 1, or
    /// less, where nothing but noise and sampling keeps the surfaces apart.
    pub residual_ratio: f64,
    /// Of the points within four voxels of the other cloud, the share that is not within one.
    pub near_misses: f64,
    /// Of the points within a voxel of the other cloud, the share whose normal agrees with that of the nearest point
    /// there, and the share with that of the nearest of its own cloud.
    pub facing: [f64; 2],
    /// Of the points within two voxels of the other cloud or where its sensor saw through to something behind, the share
    /// of the latter; `None` where it is known of neither cloud from where it was seen.
    pub in_free_space: Option<f64>,
    /// Score of the best clearly different pose over that of this one; 0 where there is none.
    pub runner_up: f64,
    /// The same after a coarse refinement, which more poses see.
    pub glimpsed: f64,
    /// How many clearly different poses score nearly as well.
    pub rivals: usize,
    /// Share of the most promising hypotheses that a coarse refinement led to this pose.
    pub agreement: f64,
    /// How many feature matches the pose explains, and of how many; `None` where none were looked for.
    pub matches: Option<[usize; 2]>,
    /// Information about the motion that the surfaces hold least, over that about the one that they hold best.
    pub conditioning: f64,
    /// How many directions of motion nothing holds.
    pub free_directions: usize,
    /// Whether the refinement settled.
    pub converged: bool,
    /// Points of the smaller cloud.
    pub points: usize,
    /// Whether the points are samples as they were taken, not averages of many.
    pub samples: bool,
}

impl Evidence {
    /// Of a pose that nothing speaks for, between clouds of at least `points` points.
    pub fn none(points: usize) -> Self {
        Self {
            overlap: [0.0; 2],
            inliers: 0,
            closeness: 0.0,
            residual_ratio: MOST_RESIDUAL,
            near_misses: 1.0,
            facing: [0.0; 2],
            in_free_space: None,
            runner_up: 0.0,
            glimpsed: 0.0,
            rivals: 0,
            agreement: 0.0,
            matches: None,
            conditioning: 0.0,
            free_directions: 0,
            converged: true,
            points,
            samples: true,
        }
    }
}

/// A point of one cloud beside the other.
#[derive(Clone, Copy)]
struct Beside {
    /// Squared distance to the nearest point there.
    distance_sq: f32,
    /// Whether its normal agrees with the normal there, and at the nearest point of its own cloud.
    facing: [bool; 2],
    /// Distance from the tangent plane there, and from that at the nearest point of its own cloud.
    off_plane: f32,
    off_own_plane: f32,
}

/// Points of one cloud beside the other.
pub(crate) struct Meeting {
    /// Those within reach.
    beside: Vec<Beside>,
    /// How many were looked at.
    of: usize,
}

/// How the points `indices` of `from`, moved by `pose`, lie beside `to`; `voxel_size` is the scale of both.
pub(crate) fn meeting(from: &Level, indices: &[u32], to: &Level, pose: &Rigid, voxel_size: f32) -> Meeting {
    let rotation = pose.rotation.map(|v| v as f32);
    let translation = pose.translation.map(|v| v as f32);
    let reach_sq = (NEAR_VOXELS * voxel_size).powi(2);
    let plane_distance = |p: Vector3<f32>, level: &Level, at: u32| {
        (p - Vector3::from(level.points[at as usize])).dot(&Vector3::from(level.normals[at as usize])).abs()
    };
    let beside = indices
        .par_iter()
        .with_min_len(BLOCK)
        .map_init(Vec::new, |found, &i| {
            let p = Vector3::from(from.points[i as usize]);
            let y = rotation * p + translation;
            let nearest = to.tree.nearest(y.into(), reach_sq)?;
            from.tree.knn(p.into(), 2, found);
            let own = found.iter().find(|n| n.index != i).map_or(i, |n| n.index);
            let normal = rotation * Vector3::from(from.normals[i as usize]);
            let agree =
                |n: Vector3<f32>, other: [f32; 3]| n.dot(&Vector3::from(other)).abs() >= FACING_COSINE;
            Some(Beside {
                distance_sq: nearest.distance_sq,
                facing: [
                    agree(normal, to.normals[nearest.index as usize]),
                    agree(from.normals[i as usize].into(), from.normals[own as usize]),
                ],
                off_plane: plane_distance(y, to, nearest.index),
                off_own_plane: plane_distance(p, from, own),
            })
        })
        .collect::<Vec<_>>();
    Meeting { beside: beside.into_iter().flatten().collect(), of: indices.len() }
}

impl Meeting {
    /// Those within `limit`.
    fn within(&self, limit: f32) -> impl Iterator<Item = &Beside> {
        self.beside.iter().filter(move |b| b.distance_sq <= limit * limit)
    }

    /// How many are within `limit`.
    pub fn count(&self, limit: f32) -> usize {
        self.within(limit).count()
    }

    /// Share of the points within `limit`, 0 to 1.
    pub fn share(&self, limit: f32) -> f64 {
        self.count(limit) as f64 / self.of.max(1) as f64
    }

    /// Root mean square of the distances within `limit`.
    pub fn rmse(&self, limit: f32) -> f64 {
        // Of none it is 0, where Rust's sum is -0.
        let sum = self.within(limit).fold(0.0, |sum, b| sum + f64::from(b.distance_sq));
        (sum / self.count(limit).max(1) as f64).sqrt()
    }
}

/// Fills in what two meetings, source to target and back, show.
pub(crate) fn seen(meetings: [&Meeting; 2], voxel_size: f32, rest: Evidence) -> Evidence {
    let both = |limit: f32| meetings.into_iter().flat_map(move |m| m.within(limit));
    let inliers = both(voxel_size).count();
    let near = meetings.iter().map(|m| m.beside.len()).sum::<usize>();
    let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
    let between = median(both(voxel_size).map(|b| b.off_plane).collect());
    let own = median(both(voxel_size).map(|b| b.off_own_plane).collect());
    // A cloud without noise has no distance from its own planes; a thousandth of a voxel is none either.
    let floor = 1e-3 * f64::from(voxel_size);
    Evidence {
        overlap: meetings.map(|m| m.share(voxel_size)),
        inliers,
        residual_ratio: ((between + floor) / (own + floor)).min(MOST_RESIDUAL),
        near_misses: 1.0 - share(inliers, near),
        facing: [0, 1].map(|k| share(both(voxel_size).filter(|b| b.facing[k]).count(), inliers)),
        ..rest
    }
}

/// The middle value; 0 of none.
fn median(mut values: Vec<f32>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
}
