//! Iterative closest points, coarse to fine.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::{
    Factor, LockedPose, RobustKernel,
    solver::{Correspondence, MIN_DAMPING, Objective},
};
use crate::{
    prepare::Level,
    transform::Rigid,
    watch::{Call, StepPairs},
};

/// Source points are matched in blocks of this many; the blocks' results stand in order.
const BLOCK: usize = 256;
/// Surfaces that face more than this far apart (cosine) are not the same surface.
pub(super) const NORMAL_COSINE: f32 = 0.5;
/// Fewer pairs than a pose has degrees of freedom hold none.
pub(super) const FEWEST_PAIRS: usize = 6;
/// No target point was near.
const NOTHING: u32 = u32::MAX;
/// Residuals that tell the kernel's scale.
const SCALE_SAMPLE: usize = 1024;
/// See [`Schedule::max_slide_voxels`].
const MAX_SLIDE_VOXELS: f32 = 0.75;
/// Motion in voxels, at the target's rim, under which the pose has settled.
const SETTLED_VOXELS: f64 = 1e-2;

/// How far and how long to look for correspondences.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Schedule {
    /// Pairs further apart are no pairs: at the first iteration, and at the last.
    pub max_distance: (f32, f32),
    /// Iterations from the one to the other.
    pub shrink_over: usize,
    /// Iterations at most.
    pub max_iterations: usize,
    /// Share of the closest pairs that is kept.
    pub keep: f64,
    /// Once the distance is at its last, pairs this many voxels apart along the surface are no pairs either: averages
    /// of cells have a partner nearer than that, unless the other scan ends there.
    pub max_slide_voxels: f32,
}

impl Schedule {
    /// A few steps at a coarse level, whose pairs are `reach` apart at most.
    pub fn coarse(reach: f32) -> Self {
        Self {
            max_distance: (2.0 * reach, reach),
            shrink_over: 4,
            max_iterations: 6,
            keep: 1.0,
            max_slide_voxels: f32::INFINITY,
        }
    }

    /// Until the pose settles, from pairs `first` apart to pairs `reach` apart.
    pub fn fine(first: f32, reach: f32, keep: f64) -> Self {
        let max_slide_voxels = MAX_SLIDE_VOXELS;
        Self { max_distance: (first, reach), shrink_over: 6, max_iterations: 30, keep, max_slide_voxels }
    }

    /// A few last steps with pairs `reach` apart at most.
    pub fn settled(reach: f32, keep: f64) -> Self {
        Self { shrink_over: 1, max_iterations: 4, ..Self::fine(reach, reach, keep) }
    }
}

/// A refined pose.
#[derive(Debug, Clone)]
pub(crate) struct Refined {
    pub pose: Rigid,
    pub iterations: usize,
    pub converged: bool,
}

/// Hears of each iteration's pose, in local frames, and pairs.
pub(crate) type Hear<'a> = &'a mut dyn FnMut(&Rigid, StepPairs);

/// Iterative closest points between two clouds.
pub(crate) struct Icp<'a> {
    pub source: &'a Level,
    pub target: &'a Level,
    pub factor: &'a dyn Factor,
    pub kernel: RobustKernel,
    pub lock: Option<&'a LockedPose>,
    pub call: &'a Call<'a>,
}

impl<'a> Icp<'a> {
    /// Refines `pose` by moving the points `moved` of the source onto the target. `hear` hears of every iteration counted.
    pub fn refine(
        &self,
        moved: &[u32],
        pose: &Rigid,
        schedule: &Schedule,
        mut hear: Option<Hear>,
    ) -> Refined {
        let mut refined =
            Refined { pose: self.lock.map_or(*pose, |l| l.project(pose)), iterations: 0, converged: false };
        let (first, last) = schedule.max_distance;
        let mut damping = MIN_DAMPING;
        let mut nearest = vec![NOTHING; moved.len()];
        for iteration in 0..schedule.max_iterations {
            if self.call.is_over() {
                break;
            }
            let along = (iteration as f32 / schedule.shrink_over.max(1) as f32).min(1.0);
            let max_distance = first * (last / first).powf(along);
            let max_slide = if along < 1.0 { f32::INFINITY } else { self.max_slide(schedule) };
            let mut pairs = self.correspondences(moved, &refined.pose, max_distance, max_slide, &mut nearest);
            keep_closest(&mut pairs, &refined.pose, schedule.keep);
            if pairs.len() < FEWEST_PAIRS {
                refined.converged = false;
                return refined;
            }
            let objective = self.objective(&pairs, &refined.pose, max_distance);
            refined.iterations = iteration + 1;
            let next = objective.step(&refined.pose, &pairs, self.lock, &mut damping);
            if let Some(hear) = &mut hear {
                let pose = next.as_ref().unwrap_or(&refined.pose);
                let share = pairs.len() as f64 / moved.len() as f64;
                hear(pose, StepPairs { share, rmse: rmse(&pairs, pose) });
            }
            let Some(next) = next else {
                refined.converged = along >= 1.0;
                if refined.converged {
                    break;
                }
                continue;
            };
            let motion = next * refined.pose.inverse();
            let moved_by = motion.angle() * f64::from(self.target.radius) + motion.translation.norm();
            refined.pose = next;
            if along >= 1.0 && moved_by < SETTLED_VOXELS * f64::from(self.source.voxel_size) {
                refined.converged = true;
                break;
            }
        }
        refined
    }

    /// The pairs of the points `moved` at `pose` as the last iteration of `schedule` makes them.
    pub(super) fn last_pairs(&self, moved: &[u32], pose: &Rigid, schedule: &Schedule) -> Vec<Correspondence> {
        let mut nearest = vec![NOTHING; moved.len()];
        let (_, reach) = schedule.max_distance;
        let mut pairs = self.correspondences(moved, pose, reach, self.max_slide(schedule), &mut nearest);
        keep_closest(&mut pairs, pose, schedule.keep);
        pairs
    }

    /// How far apart along the surface pairs may be in the end; samples as they were taken may lie anywhere.
    fn max_slide(&self, schedule: &Schedule) -> f32 {
        if self.target.gridded { schedule.max_slide_voxels * self.target.voxel_size } else { f32::INFINITY }
    }

    /// What is minimised over `pairs`. The kernel's scale comes from the residuals themselves: a few robust
    /// standard deviations, within what the search radius allows.
    pub(super) fn objective(
        &self,
        pairs: &[Correspondence],
        pose: &Rigid,
        max_distance: f32,
    ) -> Objective<'a> {
        let plain = Objective { factor: self.factor, kernel: RobustKernel::None, scale_sq: 1.0 };
        let mut squares: Vec<f64> = pairs
            .iter()
            .step_by(pairs.len().div_ceil(SCALE_SAMPLE))
            .map(|c| plain.squared(pose, c))
            .collect();
        let middle = squares.len() / 2;
        let median_sq = *squares.select_nth_unstable_by(middle, f64::total_cmp).1;
        // 1.4826² turns a squared median into a variance; three standard deviations.
        let limit = f64::from(max_distance).powi(2);
        let scale_sq = (9.0 * 2.198 * median_sq).clamp(1e-8 * limit, limit);
        Objective { factor: self.factor, kernel: self.kernel, scale_sq }
    }

    /// Pairs each point of `moved` with its nearest target point, where one is near and faces the same way.
    ///
    /// `nearest` holds the last iteration's answers, from which the search starts, and takes this one's.
    fn correspondences(
        &self,
        moved: &[u32],
        pose: &Rigid,
        max_distance: f32,
        max_slide: f32,
        nearest: &mut [u32],
    ) -> Vec<Correspondence> {
        let (source, target) = (self.source, self.target);
        let rotation = pose.rotation.map(|v| v as f32);
        let translation = pose.translation.map(|v| v as f32);
        let blocks: Vec<Vec<Correspondence>> = moved
            .par_chunks(BLOCK)
            .zip(nearest.par_chunks_mut(BLOCK))
            .map(|(block, nearest)| {
                let mut found = Vec::with_capacity(block.len());
                for (&i, nearest) in block.iter().zip(nearest) {
                    let p = source.points[i as usize];
                    let y = rotation * Vector3::from(p) + translation;
                    let limit_sq = max_distance * max_distance;
                    let neighbor = match *nearest {
                        NOTHING => target.tree.nearest(y.into(), limit_sq),
                        hint => target.tree.nearest_with_hint(y.into(), limit_sq, hint),
                    };
                    *nearest = neighbor.map_or(NOTHING, |n| n.index);
                    let Some(neighbor) = neighbor else { continue };
                    let (m, n) = (source.normals[i as usize], target.normals[neighbor.index as usize]);
                    let (q, n) = (Vector3::from(target.points[neighbor.index as usize]), Vector3::from(n));
                    if (rotation * Vector3::from(m)).dot(&n).abs() < NORMAL_COSINE {
                        continue;
                    }
                    let across = n.dot(&(y - q));
                    if (y - q).norm_squared() - across * across > max_slide * max_slide {
                        continue;
                    }
                    found.push(Correspondence {
                        source: p,
                        target: q.into(),
                        source_normal: m,
                        target_normal: n.into(),
                    });
                }
                found
            })
            .collect();
        blocks.concat()
    }
}

fn keep_closest(pairs: &mut Vec<Correspondence>, pose: &Rigid, keep: f64) {
    let kept = (pairs.len() as f64 * keep).ceil() as usize;
    if kept == 0 || kept >= pairs.len() {
        return;
    }
    pairs.select_nth_unstable_by(kept - 1, |a, b| distance_sq(a, pose).total_cmp(&distance_sq(b, pose)));
    pairs.truncate(kept);
}

fn rmse(pairs: &[Correspondence], pose: &Rigid) -> f64 {
    let sum: f64 = pairs.iter().map(|c| distance_sq(c, pose)).sum();
    (sum / pairs.len() as f64).sqrt()
}

fn distance_sq(c: &Correspondence, pose: &Rigid) -> f64 {
    (pose.rotation * Vector3::from(c.source.map(f64::from)) + pose.translation
        - Vector3::from(c.target.map(f64::from)))
    .norm_squared()
}
