//! What the pairs at a pose say about it: how firmly they hold it, and how strongly their noise pulls at it.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use super::{
    Icp, Schedule,
    icp::{FEWEST_PAIRS, NORMAL_COSINE},
    solver::{Correspondence, Objective},
};
use crate::transform::Rigid;

/// Edge of a patch in voxels. Errors of pairs in one patch may have one cause (a target point that serves several
/// source points, normals from common neighbours); those of different patches are taken as independent.
const PATCH_VOXELS: f64 = 4.0;
/// Pairs that tell the adherence, and how far they are moved, in voxels: no further than poses err.
const MOVED_PAIRS: usize = 512;
const MOVE_VOXELS: f64 = 0.15;

/// Mean squared difference of normals, over the most that is allowed: at 0.5 they would say nothing, of this or more it
/// cannot be told how little.
const MOST_DIFFERENT: f64 = 0.45;

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
    /// What normals of no meaning would seem to agree on, over their disagreement, because only pairs whose normals are
    /// alike are pairs: 0 where nearly all would be anyhow.
    pub agreement_by_choice: f64,
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
        let sum = |of: fn(&Patch) -> Matrix6<f64>| -> Matrix6<f64> { patches.iter().map(of).sum() };
        // n · m and |n − m|² / 2; together 1 a pair.
        let [alike, apart] =
            [sum(|p| p.agreement), sum(|p| p.disagreement)].map(|m| m.fixed_view::<3, 3>(3, 3).trace());
        let most = 2.0 - 2.0 * f64::from(NORMAL_COSINE);
        Self {
            agreement_by_choice: agreement_by_choice(2.0 * apart / ((alike + apart) * most)),
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
    /// (either way) and across it.
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
            // Few of the pairs re-form, and those by far: the mean over one way alone is uncertain.
            Some([f64::midpoint(share(along)?, share(n.cross(&along))?), share(n)?])
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

/// What choosing pairs whose normals are alike adds to their agreement, over their disagreement; `mean`: of their squared
/// differences, over the most that is allowed.
///
/// Normals with errors a and b agree on ab = ((a + b) / 2)² − ((a − b) / 2)². Of Gaussian errors, both squares are
/// independent and of one mean; the choice reduces the second alone, say to 1/t, which leaves ab at (t − 1) / 2 of the
/// disagreement (a − b)² / 2. The squared difference of two normals is exponential, and cut off at the most allowed.
fn agreement_by_choice(mean: f64) -> f64 {
    const ITERATIONS: usize = 64;
    let mean = if mean > 1e-3 { mean.min(MOST_DIFFERENT) } else { return 0.0 };
    // The mean of an exponential variable cut off at 1 is 1 / rate − 1 / (exp rate − 1).
    let rate = (0..ITERATIONS).fold(1.0 / mean, |rate, _| (1.0 - rate / rate.exp_m1()) / mean);
    (1.0 / (rate * mean) - 1.0) / 2.0
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

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        CloudRole, PointCloud,
        prepare::{Described, Prepared, check, prepare},
        refine::{Refinement, RobustKernel, factor},
        watch::{Call, Watch},
    };

    fn unit(rng: &mut impl Rng) -> Vector3<f64> {
        Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0)).normalize()
    }

    /// Deviates of variance 1.
    fn normal(rng: &mut impl Rng) -> f64 {
        (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
    }

    fn single(v: Vector3<f64>) -> [f32; 3] {
        v.map(|v| v as f32).into()
    }

    const POSE: [f64; 6] = [0.4, -0.2, 0.7, 0.3, -1.0, 0.5];

    /// Pairs anywhere, half a length apart, whose normals differ by `tilt` under the pose.
    fn pairs_anywhere(pose: &Rigid, tilt: f64) -> Vec<Correspondence> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let pair = |_| {
            let (y, n) = (2.0 * unit(&mut rng), unit(&mut rng));
            let m = (n + tilt * unit(&mut rng)).normalize();
            Correspondence {
                source: single(pose.rotation.transpose() * (y - pose.translation)),
                target: single(y + 0.5 * unit(&mut rng)),
                source_normal: single(pose.rotation.transpose() * m),
                target_normal: single(n),
            }
        };
        (0..40).map(pair).collect()
    }

    fn surface<'a>(objective: Objective<'a>, pose: &'a Rigid) -> Surface<'a> {
        Surface { objective, pose, adherence: [1.0; 2], normal_variance: 0.0 }
    }

    fn objective(refinement: Refinement) -> Objective<'static> {
        let kernel = RobustKernel::GemanMcclure;
        Objective { factor: factor(refinement, false), kernel, scale_sq: 0.2 }
    }

    /// How `f` changes with each coordinate of the left twist, column by column.
    fn derivative(pose: &Rigid, step: f64, f: impl Fn(&Rigid) -> Vector6<f64>) -> Matrix6<f64> {
        let at = |k: usize, by: f64| f(&(Rigid::exp(&(Vector6::ith(k, by))) * *pose));
        Matrix6::from_columns(&std::array::from_fn::<_, 6, _>(|k| {
            (at(k, step) - at(k, -step)) / (2.0 * step)
        }))
    }

    #[test]
    fn gradient_and_hessian_are_those_of_the_solver() {
        let pose = Rigid::exp(&Vector6::from(POSE));
        let pairs = pairs_anywhere(&pose, 0.3);
        for refinement in [Refinement::Gicp, Refinement::Plane, Refinement::Point] {
            let objective = objective(refinement);
            let found = surface(objective, &pose).patch(pairs.iter());
            let model = objective.linearize(&pose, &pairs);
            assert!((found.gradient - model.gradient).amax() < 1e-9 * model.gradient.amax());
            assert!((found.hessian - model.hessian).amax() < 1e-9 * model.hessian.amax());
        }
    }

    /// Where information does not turn with the source's normals, so that all of the cost's change is the points'.
    #[test]
    fn the_gradient_is_that_of_half_the_cost() {
        let pose = Rigid::exp(&Vector6::from(POSE));
        let pairs = pairs_anywhere(&pose, 0.3);
        for refinement in [Refinement::Plane, Refinement::Point] {
            let objective = objective(refinement);
            let found = surface(objective, &pose).patch(pairs.iter()).gradient;
            let half = |pose: &Rigid| Vector6::repeat(0.5 * objective.cost(pose, &pairs));
            let expected: Vector6<f64> = derivative(&pose, 1e-5, half).row(0).transpose();
            assert!((found - expected).amax() < 1e-7 * expected.amax(), "{found} {expected}");
        }
    }

    #[test]
    fn of_pairs_that_stay_the_stiffness_is_how_their_forces_change() {
        let pose = Rigid::exp(&Vector6::from(POSE));
        let pairs = pairs_anywhere(&pose, 0.3);
        for refinement in [Refinement::Plane, Refinement::Point] {
            let objective = objective(refinement);
            let found = surface(objective, &pose).patch(pairs.iter()).stiffness;
            let forces = |moved: &Rigid| -> Vector6<f64> {
                // Attached where the points were.
                pairs.iter().map(|c| row(&at(&pose, c), &objective.pull(moved, c).force)).sum()
            };
            let expected = derivative(&pose, 1e-5, forces);
            assert!((found - expected).amax() < 1e-7 * expected.amax(), "{found} {expected}");
        }
    }

    fn at(pose: &Rigid, c: &Correspondence) -> Vector3<f64> {
        Vector3::from(pose.apply(c.source.map(f64::from)))
    }

    /// Of a pair of points that face along z, whose factor holds all directions alike.
    #[test]
    fn adherence_and_normals_errors_take_from_the_stiffness() {
        let pair = Correspondence {
            source: [0.0; 3],
            target: [0.0; 3],
            source_normal: [0.0, 0.0, 1.0],
            target_normal: [0.0, 0.0, 1.0],
        };
        let plain = Objective { kernel: RobustKernel::None, ..objective(Refinement::Point) };
        for ([along, across], normal_variance) in
            [([0.3, 0.8], 0.0), ([0.3, 0.8], 0.1), ([0.8, 0.3], 0.1), ([0.0, 1.0], 0.2)]
        {
            let pose = Rigid::identity();
            let surface = Surface { adherence: [along, across], normal_variance, ..surface(plain, &pose) };
            let found = surface.patch(std::iter::once(&pair)).stiffness;
            let sideways = along - normal_variance * f64::max(across - along, 0.0);
            let expected = Vector6::new(0.0, 0.0, 0.0, sideways, sideways, across);
            assert!((found - Matrix6::from_diagonal(&expected)).amax() < 1e-12, "{found} {expected}");
        }
    }

    #[test]
    fn agreement_and_disagreement_are_what_either_cloud_says() {
        let pose = Rigid::exp(&Vector6::from(POSE));
        let mut pairs = pairs_anywhere(&pose, 0.3);
        let of = |pairs: &[Correspondence]| surface(objective(Refinement::Gicp), &pose).patch(pairs.iter());
        let found = of(&pairs);
        let said = |of: &dyn Fn(&Correspondence) -> Vector6<f64>| -> Matrix6<f64> {
            pairs.iter().map(|c| of(c) * of(c).transpose()).sum()
        };
        let by_target = said(&|c| row(&Vector3::from(c.target.map(f64::from)), &normals(c, &pose).0));
        let by_source = said(&|c| row(&at(&pose, c), &normals(c, &pose).1));
        let sum = found.agreement + found.disagreement;
        assert!((sum - (by_target + by_source) / 2.0).amax() < 1e-9 * sum.amax());
        assert!(found.disagreement.symmetric_eigenvalues().min() > 0.0);
        // Normals have no sign.
        for c in &mut pairs {
            c.source_normal = c.source_normal.map(|v| -v);
        }
        let turned = of(&pairs);
        assert_eq!((turned.agreement, turned.stiffness), (found.agreement, found.stiffness));
    }

    const ACROSS: usize = 20;

    /// Points of a square of edge 1 about the origin, in steps of 1/20.
    fn square(shift: [f64; 2]) -> Vec<[f64; 2]> {
        let step = 1.0 / ACROSS as f64;
        let place = |i: usize, shift: f64| (i as f64 + 0.5 + shift) * step - 0.5;
        (0..ACROSS * ACROSS).map(|i| [place(i % ACROSS, shift[0]), place(i / ACROSS, shift[1])]).collect()
    }

    fn plane() -> PointCloud {
        PointCloud::from_points(square([0.0; 2]).iter().map(|&[u, v]| [u, v, 0.0]).collect())
    }

    /// Samples of the plane that lie in every way beside those of [`plane`].
    fn plane_of_other_samples() -> PointCloud {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let edge = 0.45;
        PointCloud::from_points(
            (0..400).map(|_| [rng.random_range(-edge..edge), rng.random_range(-edge..edge), 0.0]).collect(),
        )
    }

    /// Three walls, apart from each other: every normal is that of its wall.
    fn corner() -> PointCloud {
        let walls =
            square([0.0; 2]).into_iter().flat_map(|[u, v]| [[u, v, -1.0], [-1.0, u, v], [v, -1.0, u]]);
        PointCloud::from_points(walls.collect())
    }

    const VOXEL_SIZE: f64 = 1.0 / ACROSS as f64;

    fn ready(cloud: &PointCloud) -> Prepared {
        let call = Call::new(None, Watch::default());
        let checked = check(cloud, CloudRole::Cloud, &call).unwrap();
        prepare(&checked, VOXEL_SIZE, Described::Never, cloud.len(), &call).unwrap()
    }

    fn information(source: &Prepared, target: &Prepared, pose: &Rigid, of: Refinement) -> Information {
        let icp = Icp {
            source: &source.fine,
            target: &target.fine,
            factor: factor(of, true),
            kernel: RobustKernel::None,
            lock: None,
            call: &Call::new(None, Watch::default()),
        };
        let all: Vec<u32> = (0..source.fine.points.len() as u32).collect();
        icp.information(&all, pose, &Schedule::settled(2.0 * VOXEL_SIZE as f32, 1.0)).unwrap()
    }

    fn agreement(of: &Information) -> Matrix6<f64> {
        of.patches.iter().map(|patch| patch.agreement).sum()
    }

    #[test]
    fn a_plane_agrees_on_three_motions() {
        let plane = ready(&plane());
        let found = information(&plane, &plane, &Rigid::identity(), Refinement::Plane);
        // Of the places that a side has, i + 1/2 for i from −10 to 9, the mean square is (20² − 1) / 12.
        let points = (ACROSS * ACROSS) as f64;
        let turns = points * (points - 1.0) / 12.0 * VOXEL_SIZE * VOXEL_SIZE;
        let expected = Matrix6::from_diagonal(&Vector6::new(turns, turns, 0.0, 0.0, 0.0, points));
        assert!((agreement(&found) - expected).amax() < 1e-4 * points, "{}", agreement(&found));
        assert!((found.hessian - expected).amax() < 1e-4 * points, "{}", found.hessian);
        let disagreement: Matrix6<f64> = found.patches.iter().map(|patch| patch.disagreement).sum();
        assert!(disagreement.amax() < 1e-6 * points && found.gradient.amax() < 1e-4 * points);
        // Of four voxels each, counted from the middle of the 20: six along a side.
        assert_eq!(found.patches.len(), 36);
    }

    #[test]
    fn a_corner_agrees_on_all_motions_and_pulls_back() {
        let corner = ready(&corner());
        let pose = Rigid::from_translation([0.3, -0.2, 0.1].map(|v| v * VOXEL_SIZE));
        let found = information(&corner, &corner, &pose, Refinement::Plane);
        let points = (ACROSS * ACROSS) as f64;
        let slides = agreement(&found).fixed_view::<3, 3>(3, 3).into_owned();
        assert!((slides - Matrix3::identity() * points).amax() < 1e-3 * points, "{slides}");
        assert!(agreement(&found).symmetric_eigenvalues().min() > 1.0, "{}", agreement(&found));
        let force = found.gradient.fixed_rows::<3>(3).into_owned();
        assert!((force / points - pose.translation).amax() < 1e-3 * VOXEL_SIZE, "{force}");
    }

    #[test]
    fn adherence_tells_same_samples_from_others_and_from_averages() {
        let (plane, other) = (ready(&plane()), ready(&plane_of_other_samples()));
        assert!(plane.fine.sparse && other.fine.sparse && !plane.fine.gridded && !other.fine.gridded);
        let of = |source: &Prepared, target: &Prepared| {
            information(source, target, &Rigid::identity(), Refinement::Gicp).adherence
        };
        assert_eq!(of(&plane, &plane), 1.0);
        assert!(of(&other, &plane) < 0.15, "{}", of(&other, &plane));
        // Several samples in each cell.
        let many = (0..16).flat_map(|i| square([f64::from(i % 4) / 4.0, f64::from(i / 4) / 4.0]));
        let averages = ready(&PointCloud::from_points(many.map(|[u, v]| [u, v, 0.0]).collect()));
        assert!(averages.fine.gridded && averages.fine.points.len() >= 400);
        assert_eq!(of(&averages, &averages), 0.0);
    }

    /// Over the distance that poses err by; of points, whose pairs hold in every direction as long as they are pairs.
    #[test]
    fn the_stiffness_is_how_the_gradient_changes_while_pairs_re_form() {
        let [plane, other] = [plane(), plane_of_other_samples()].map(|cloud| {
            let mut ready = ready(&cloud);
            // Without rounding, all are moved along one axis.
            ready.fine.normals.fill([0.0, 0.0, 1.0]);
            ready
        });
        let step = MOVE_VOXELS * VOXEL_SIZE;
        for (source, target) in [(&plane, &plane), (&other, &plane), (&plane, &other)] {
            let aligned =
                Rigid::from_translation(target.origin).inverse() * Rigid::from_translation(source.origin);
            let at = |by: Vector3<f64>| {
                let pose = Rigid::from_translation(by.into()) * aligned;
                information(source, target, &pose, Refinement::Point)
            };
            let change = |axis: usize| {
                let by = Vector3::ith(axis, step);
                (at(by).gradient[3 + axis] - at(-by).gradient[3 + axis]) / (2.0 * step)
            };
            let here = at(Vector3::zeros());
            // Along the plane, either way alike, and across it.
            for (axis, expected) in [(1, f64::midpoint(change(0), change(1))), (2, change(2))] {
                let at = (3 + axis, 3 + axis);
                let (found, held) = (here.stiffness[at], here.hessian[at]);
                // What is below zero by chance counts as zero.
                assert!((found - expected.max(0.0)).abs() < 1e-3 * held, "{found} {expected} {held}");
            }
        }
    }

    #[test]
    fn too_few_pairs_say_nothing() {
        let plane = ready(&plane());
        let call = Call::new(None, Watch::default());
        let icp = Icp {
            source: &plane.fine,
            target: &plane.fine,
            factor: factor(Refinement::Gicp, true),
            kernel: RobustKernel::None,
            lock: None,
            call: &call,
        };
        let schedule = Schedule::settled(2.0 * VOXEL_SIZE as f32, 1.0);
        let few = |n: u32, pose: &Rigid| icp.information(&(0..n).collect::<Vec<_>>(), pose, &schedule);
        assert!(few(5, &Rigid::identity()).is_none() && few(6, &Rigid::identity()).is_some());
        assert!(few(400, &Rigid::from_translation([0.0, 0.0, 1.0])).is_none());
    }

    #[test]
    fn patches_are_cells_and_hold_every_pair_once() {
        let pose = Rigid::identity();
        let (pairs, size) = (pairs_anywhere(&pose, 0.0), 0.7);
        let found = patches(&pairs, size);
        let mut all = found.concat();
        all.sort_unstable();
        assert_eq!(all, (0..pairs.len() as u32).collect::<Vec<_>>());
        let cell = |i: &u32| pairs[*i as usize].target.map(|v| (f64::from(v) / size).floor() as i32);
        let mut cells: Vec<_> = found.iter().map(|patch| cell(&patch[0])).collect();
        assert!(found.iter().zip(&cells).all(|(patch, of)| patch.iter().all(|i| cell(i) == *of)));
        cells.sort_unstable();
        cells.dedup();
        assert_eq!(cells.len(), found.len());
        // Cells on either side of zero are two.
        let beside = |x: f32| Correspondence { target: [x, 0.1, 0.1], ..pairs[0] };
        assert_eq!(patches(&[beside(0.1), beside(-0.1), beside(0.2)], size), [vec![1], vec![0, 2]]);
    }

    #[test]
    fn normal_variance_is_that_of_the_mean_normal() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let (pose, sigma) = (Rigid::exp(&Vector6::from(POSE)), 0.05);
        let mut tilted = || Vector3::new(sigma * normal(&mut rng), sigma * normal(&mut rng), 1.0).normalize();
        let pairs: Vec<Correspondence> = (0..10_000)
            .map(|i| {
                let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
                Correspondence {
                    source: [0.0; 3],
                    target: [0.0; 3],
                    source_normal: single(pose.rotation.transpose() * tilted() * sign),
                    target_normal: single(tilted()),
                }
            })
            .collect();
        let found = normal_variance(&pairs, &pose);
        let expected = sigma * sigma / 2.0;
        assert!((found / expected - 1.0).abs() < 0.05, "{found} {expected}");
    }

    #[test]
    fn errors_agree_by_choice_as_much_as_is_said() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (sigma, expected) in [(0.1, 0.0..0.001), (0.3, 0.05..0.15), (0.4, 0.2..0.4), (0.5, 0.5..0.8)] {
            let mut error = || sigma * normal(&mut rng);
            let (mut pairs, mut agreement, mut difference) = (0.0, 0.0, 0.0);
            for _ in 0..100_000 {
                let [a, b] = [[error(), error()], [error(), error()]];
                let squared = (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
                if squared < 1.0 {
                    pairs += 1.0;
                    agreement += a[0] * b[0] + a[1] * b[1];
                    difference += squared;
                }
            }
            let (found, told) = (2.0 * agreement / difference, agreement_by_choice(difference / pairs));
            assert!((found - told).abs() < 0.02 && expected.contains(&told), "{sigma}: {found} {told}");
        }
        assert_eq!(agreement_by_choice(0.0), 0.0);
        assert!(agreement_by_choice(1.0) < 2.0);
        assert_eq!(agreement_by_choice(f64::NAN), 0.0);
    }
}
