//! What the pairs at a pose say about it: how firmly they hold it, and how strongly their noise pulls at it.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use super::{
    Icp, Schedule,
    icp::FEWEST_PAIRS,
    solver::{Correspondence, Objective},
};
use crate::transform::Rigid;

/// Edge of a patch in voxels. Errors of pairs in one patch may have one cause (a target point that serves several
/// source points, normals from common neighbours); those of different patches are taken as independent.
const PATCH_VOXELS: f64 = 4.0;
/// Pairs that tell the adherence, and how far they are moved, in voxels: no further than poses err.
const MOVED_PAIRS: usize = 512;
const MOVE_VOXELS: f64 = 0.15;

/// All in the left twist (rotation rad, translation) about the target's local origin.
pub(crate) struct Information {
    /// Derivative of the gradient by the pose, pairs re-forming as it moves.
    pub stiffness: Matrix6<f64>,
    /// The same as the steps of the refinement see it, pairs and weights held.
    pub hessian: Matrix6<f64>,
    /// Gradient of the cost; zero where the refinement has settled.
    pub gradient: Vector6<f64>,
    /// Share of a small slide along the surface that pulls pairs apart instead of re-forming them: near 1 where both
    /// clouds hold the same samples, near 0 where each has its own.
    pub adherence: f64,
    /// The surface, piece by piece.
    pub patches: Vec<Patch>,
}

/// Sums over the pairs of one piece of surface.
#[derive(Clone, Copy)]
pub(crate) struct Patch {
    /// Gradient of the cost.
    pub gradient: Vector6<f64>,
    /// Σ (a bᵀ + b aᵀ) / 2 over the rows a = (q × n, n) of the target and b = (y × m, m) of the source: the part of
    /// the point-to-plane information that both clouds' normals, of independent errors, agree on.
    pub agreement: Matrix6<f64>,
    /// Σ (a − b) (a − b)ᵀ / 2: what the normals' errors alone make of it.
    pub disagreement: Matrix6<f64>,
    /// The part of [`Information::stiffness`].
    pub stiffness: Matrix6<f64>,
    /// The part of [`Information::hessian`].
    pub hessian: Matrix6<f64>,
}

impl Information {
    /// The sums over all patches.
    pub fn of(patches: Vec<Patch>, adherence: f64) -> Self {
        let sum = |of: fn(&Patch) -> Matrix6<f64>| patches.iter().map(of).sum();
        Self {
            stiffness: sum(|p| p.stiffness),
            hessian: sum(|p| p.hessian),
            gradient: patches.iter().map(|p| p.gradient).sum(),
            adherence,
            patches,
        }
    }
}

impl Icp<'_> {
    /// What the points `moved` of the source say about `pose`, paired as the last iteration of `schedule` pairs them;
    /// `None` where they are too few.
    pub fn information(&self, moved: &[u32], pose: &Rigid, schedule: &Schedule) -> Option<Information> {
        let pairs = self.last_pairs(moved, pose, schedule);
        let (_, reach) = schedule.max_distance;
        if pairs.len() < FEWEST_PAIRS {
            return None;
        }
        let surface = Surface {
            objective: self.objective(&pairs, pose, reach),
            pose,
            adherence: self.adherence(&pairs, pose, reach),
            normal_variance: normal_variance(&pairs, pose),
        };
        let patches: Vec<Patch> = patches(&pairs, PATCH_VOXELS * f64::from(self.target.voxel_size))
            .par_iter()
            .with_min_len(16)
            .map(|patch| surface.patch(patch.iter().map(|&i| &pairs[i as usize])))
            .collect();
        Some(Information::of(patches, surface.adherence[0]))
    }

    /// Share of a small motion of the source that pulls pairs apart instead of re-forming them: along the surface
    /// and across it.
    fn adherence(&self, pairs: &[Correspondence], pose: &Rigid, reach: f32) -> [f64; 2] {
        let step = MOVE_VOXELS * f64::from(self.target.voxel_size);
        let nearest = |y: Vector3<f64>| {
            let found = self.target.tree.nearest(y.map(|v| v as f32).into(), reach * reach)?;
            Some(Vector3::from(self.target.points[found.index as usize].map(f64::from)))
        };
        let pulled_apart = |c: &Correspondence| {
            let n = Vector3::from(c.target_normal.map(f64::from));
            let along = n.cross(&Vector3::ith(n.iamin(), 1.0)).try_normalize(0.0)?;
            let y = pose.rotation * Vector3::from(c.source.map(f64::from)) + pose.translation;
            let share = |way: Vector3<f64>| {
                let follows = nearest(y + way * step)? - nearest(y - way * step)?;
                Some(1.0 - follows.dot(&way) / (2.0 * step))
            };
            Some([share(along)?, share(n)?])
        };
        let sample: Vec<&Correspondence> = pairs.iter().step_by(pairs.len().div_ceil(MOVED_PAIRS)).collect();
        let shares: Vec<[f64; 2]> =
            sample.par_iter().with_min_len(64).filter_map(|c| pulled_apart(c)).collect();
        let mean = |k: usize| shares.iter().map(|s| s[k]).sum::<f64>() / shares.len().max(1) as f64;
        // Averages over cells are paired where they happen to be near: these follow less than all of them would.
        let along = if self.source.gridded || self.target.gridded { 0.0 } else { mean(0) };
        [along, mean(1)].map(|share| share.clamp(0.0, 1.0))
    }
}

/// What the sums over a patch need to know.
struct Surface<'a> {
    objective: Objective<'a>,
    pose: &'a Rigid,
    /// See [`Icp::adherence`].
    adherence: [f64; 2],
    /// Variance of a mean normal of a pair, along either direction across it.
    normal_variance: f64,
}

impl Surface<'_> {
    fn patch<'a>(&self, pairs: impl Iterator<Item = &'a Correspondence>) -> Patch {
        let mut sum = Patch {
            gradient: Vector6::zeros(),
            agreement: Matrix6::zeros(),
            disagreement: Matrix6::zeros(),
            stiffness: Matrix6::zeros(),
            hessian: Matrix6::zeros(),
        };
        for c in pairs {
            let y = self.pose.rotation * Vector3::from(c.source.map(f64::from)) + self.pose.translation;
            let q = Vector3::from(c.target.map(f64::from));
            let (n, m) = normals(c, self.pose);
            let pull = self.objective.pull(self.pose, c);
            sum.gradient += row(&y, &pull.force);
            add(&mut sum.hessian, &y, &pull.hessian);
            let (a, b) = (row(&q, &n), row(&y, &m));
            sum.agreement += (a * b.transpose() + b * a.transpose()) / 2.0;
            sum.disagreement += (a - b) * (a - b).transpose() / 2.0;
            let across = (n + m).try_normalize(0.0).unwrap_or(n);
            let held = across * across.transpose();
            let firmly = across.dot(&(pull.derivative * across));
            // Of what the factor says of motions along the surface, some is the errors of `across`.
            let feigned = (Matrix3::identity() - held) * (firmly * self.normal_variance);
            let (rest, [along, stays]) = (pull.derivative - held * firmly, self.adherence);
            let stiffness = held * firmly * stays - feigned * (stays - along).max(0.0) + rest * along;
            add(&mut sum.stiffness, &y, &stiffness);
        }
        sum
    }
}

/// The normals of a pair in the target's frame, the source's turned to the target's side.
fn normals(c: &Correspondence, pose: &Rigid) -> (Vector3<f64>, Vector3<f64>) {
    let n = Vector3::from(c.target_normal.map(f64::from));
    let m = pose.rotation * Vector3::from(c.source_normal.map(f64::from));
    (n, if n.dot(&m) < 0.0 { -m } else { m })
}

/// `(y × f, f)`: what the force f at y does to the left twist.
fn row(y: &Vector3<f64>, f: &Vector3<f64>) -> Vector6<f64> {
    let torque = y.cross(f);
    Vector6::new(torque[0], torque[1], torque[2], f[0], f[1], f[2])
}

/// Adds `Jᵀ m J`, J = [−[y]ₓ, I].
fn add(sum: &mut Matrix6<f64>, y: &Vector3<f64>, m: &Matrix3<f64>) {
    let hat = y.cross_matrix();
    let hat_m = hat * m;
    let mut view = sum.fixed_view_mut::<3, 3>(0, 0);
    view -= hat_m * hat;
    let mut view = sum.fixed_view_mut::<3, 3>(0, 3);
    view += hat_m;
    let mut view = sum.fixed_view_mut::<3, 3>(3, 0);
    view += hat_m.transpose();
    let mut view = sum.fixed_view_mut::<3, 3>(3, 3);
    view += m;
}

/// Variance of a pair's mean normal along either direction across it, from how far the two normals differ.
fn normal_variance(pairs: &[Correspondence], pose: &Rigid) -> f64 {
    let mut squares: Vec<f64> = pairs
        .iter()
        .map(|c| {
            let (n, m) = normals(c, pose);
            (n - m).norm_squared()
        })
        .collect();
    let middle = squares.len() / 2;
    let median = *squares.select_nth_unstable_by(middle, f64::total_cmp).1;
    // The median of a square in the plane is ln 2 of its mean, which is eight times the variance of half the sum.
    median / (8.0 * std::f64::consts::LN_2)
}

/// Indices of the pairs, by the cell of edge `size` that holds the target's point.
fn patches(pairs: &[Correspondence], size: f64) -> Vec<Vec<u32>> {
    let cell = |i: u32| pairs[i as usize].target.map(|v| (f64::from(v) / size).floor() as i64);
    let mut sorted: Vec<([i64; 3], u32)> = (0..pairs.len() as u32).map(|i| (cell(i), i)).collect();
    sorted.sort_unstable();
    sorted.chunk_by(|a, b| a.0 == b.0).map(|patch| patch.iter().map(|&(_, i)| i).collect()).collect()
}
