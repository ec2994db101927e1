//! Levenberg–Marquardt over a set of correspondences, and the closed form for points alone.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use super::{Factor, LockedPose, RobustKernel, Symmetric3};
use crate::transform::{Rigid, nearest_rotation};

/// Sums run over chunks of this many pairs and then over the chunks in order: one order on any thread count.
const CHUNK: usize = 1024;
const MAX_DAMPING_TRIALS: usize = 5;

/// A source point and the target point it is paired with, in their local frames.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Correspondence {
    pub source: [f32; 3],
    pub target: [f32; 3],
    /// Unit normals, each in its own cloud's frame.
    pub source_normal: [f32; 3],
    pub target_normal: [f32; 3],
}

/// Σ ρ(r) and its quadratic model in the left twist (rotation, translation) of the pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Linearized {
    pub hessian: Matrix6<f64>,
    pub gradient: Vector6<f64>,
    pub cost: f64,
}

impl Linearized {
    fn zero() -> Self {
        Self { hessian: Matrix6::zeros(), gradient: Vector6::zeros(), cost: 0.0 }
    }

    fn plus(mut self, other: &Self) -> Self {
        self.hessian += other.hessian;
        self.gradient += other.gradient;
        self.cost += other.cost;
        self
    }
}

/// What is minimised: a factor under a robust kernel.
#[derive(Clone, Copy)]
pub(crate) struct Objective<'a> {
    pub factor: &'a dyn Factor,
    pub kernel: RobustKernel,
    /// Square of the kernel's scale.
    pub scale_sq: f64,
}

/// Residual, information and transformed point of one pair.
struct Residual {
    y: Vector3<f64>,
    r: Vector3<f64>,
    information: Symmetric3,
    squared: f64,
}

/// Force on the moved point of a pair, the gradient of half its cost.
pub(crate) struct Pull {
    pub force: Vector3<f64>,
    /// Its derivative by the point, weights held.
    pub hessian: Matrix3<f64>,
    /// Its derivative by the point, the kernel's weight changing with it.
    pub derivative: Matrix3<f64>,
}

impl Objective<'_> {
    fn residual(&self, pose: &Rigid, c: &Correspondence) -> Residual {
        let y = pose.rotation * Vector3::from(c.source.map(f64::from)) + pose.translation;
        let r = y - Vector3::from(c.target.map(f64::from));
        let m = pose.rotation * Vector3::from(c.source_normal.map(f64::from));
        let information = self.factor.information(c.target_normal.map(f64::from), m.into());
        let squared = r.dot(&(times(&information, &r)));
        Residual { y, r, information, squared }
    }

    /// Squared residual under the factor's information.
    pub fn squared(&self, pose: &Rigid, c: &Correspondence) -> f64 {
        self.residual(pose, c).squared
    }

    /// What one pair does to its point under the pose.
    pub fn pull(&self, pose: &Rigid, c: &Correspondence) -> Pull {
        let Residual { r, information, squared, .. } = self.residual(pose, c);
        let (weight, _) = self.kernel.weight_and_cost(squared, self.scale_sq);
        let (information, straight) = (full(&information), times(&information, &r));
        let hessian = information * weight;
        let bend = 2.0 * self.kernel.weight_slope(squared, self.scale_sq) / self.scale_sq;
        Pull {
            force: straight * weight,
            hessian,
            derivative: hessian + straight * straight.transpose() * bend,
        }
    }

    /// Σ ρ.
    pub fn cost(&self, pose: &Rigid, pairs: &[Correspondence]) -> f64 {
        let cost =
            |c: &Correspondence| self.kernel.weight_and_cost(self.residual(pose, c).squared, self.scale_sq).1;
        let chunks: Vec<f64> = pairs.par_chunks(CHUNK).map(|chunk| chunk.iter().map(cost).sum()).collect();
        chunks.iter().sum()
    }

    /// Σ ρ with its quadratic model.
    pub fn linearize(&self, pose: &Rigid, pairs: &[Correspondence]) -> Linearized {
        let chunks: Vec<Linearized> = pairs
            .par_chunks(CHUNK)
            .map(|chunk| {
                let mut sum = Linearized::zero();
                for c in chunk {
                    self.add(pose, c, &mut sum);
                }
                sum
            })
            .collect();
        let mut sum = chunks.iter().fold(Linearized::zero(), Linearized::plus);
        sum.hessian.fill_upper_triangle_with_lower_triangle();
        sum
    }

    /// Adds one pair; of the Hessian the lower triangle only.
    fn add(&self, pose: &Rigid, c: &Correspondence, sum: &mut Linearized) {
        let Residual { y, r, information, squared } = self.residual(pose, c);
        let (w, cost) = self.kernel.weight_and_cost(squared, self.scale_sq);
        let full = full(&information) * w;
        // dy = ω × y + v, so the Jacobian is [−[y]ₓ, I].
        let hat = y.cross_matrix();
        let hat_m = hat * full;
        let rotation = -hat_m * hat;
        let force = full * r;
        let torque = y.cross(&force);
        for col in 0..3 {
            sum.gradient[col] += torque[col];
            sum.gradient[3 + col] += force[col];
            for row in col..3 {
                sum.hessian[(row, col)] += rotation[(row, col)];
                sum.hessian[(3 + row, 3 + col)] += full[(row, col)];
            }
            for row in 0..3 {
                sum.hessian[(3 + row, col)] += hat_m[(col, row)];
            }
        }
        sum.cost += cost;
    }

    /// One Levenberg–Marquardt step: the new pose and the twist or parameter step taken, or `None` where no
    /// step lowers the cost.
    pub fn step(
        &self,
        pose: &Rigid,
        pairs: &[Correspondence],
        lock: Option<&LockedPose>,
        damping: &mut f64,
    ) -> Option<Rigid> {
        let model = self.linearize(pose, pairs);
        for _ in 0..MAX_DAMPING_TRIALS {
            let candidate = match lock {
                None => solve(&model.hessian, &model.gradient, *damping).map(|d| Rigid::exp(&d) * *pose),
                Some(lock) => {
                    let tangent = lock.tangent(pose);
                    let hessian = tangent.transpose() * model.hessian * &tangent;
                    let gradient = tangent.transpose() * model.gradient;
                    solve_dynamic(hessian, &gradient, *damping).map(|d| lock.step(pose, d.as_slice()))
                }
            };
            if let Some(candidate) = candidate
                && self.cost(&candidate, pairs) <= model.cost
            {
                *damping = (*damping * 0.1).max(MIN_DAMPING);
                return Some(candidate);
            }
            *damping *= 10.0;
        }
        None
    }
}

/// Damping, relative to the Hessian's diagonal, that keeps a direction without information still.
pub(crate) const MIN_DAMPING: f64 = 1e-9;

fn solve(hessian: &Matrix6<f64>, gradient: &Vector6<f64>, damping: f64) -> Option<Vector6<f64>> {
    let mut h = *hessian;
    // Angles and lengths have units of their own, and so do their floors.
    let floor = [h.diagonal().fixed_rows::<3>(0).amax(), h.diagonal().fixed_rows::<3>(3).amax()];
    for k in 0..6 {
        h[(k, k)] += damping * h[(k, k)] + MIN_DAMPING * floor[k / 3];
    }
    let step = h.cholesky()?.solve(&-gradient);
    step.iter().all(|v| v.is_finite()).then_some(step)
}

fn solve_dynamic(mut hessian: DMatrix<f64>, gradient: &DVector<f64>, damping: f64) -> Option<DVector<f64>> {
    if gradient.is_empty() {
        return Some(DVector::zeros(0));
    }
    // Every free parameter has its own unit, and so its own floor.
    for k in 0..gradient.len() {
        hessian[(k, k)] *= 1.0 + damping + MIN_DAMPING;
        hessian[(k, k)] += f64::MIN_POSITIVE;
    }
    let step = hessian.cholesky()?.solve(&-gradient);
    step.iter().all(|v| v.is_finite()).then_some(step)
}

fn full(m: &Symmetric3) -> Matrix3<f64> {
    Matrix3::new(m[0], m[1], m[2], m[1], m[3], m[4], m[2], m[4], m[5])
}

fn times(m: &Symmetric3, v: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[1] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[2] * v[0] + m[4] * v[1] + m[5] * v[2],
    )
}

/// The rigid motion that minimises Σ w ‖R p + t − q‖² (Kabsch, 1976), `None` for fewer than three pairs.
pub(crate) fn align(pairs: impl Iterator<Item = ([f32; 3], [f32; 3], f64)> + Clone) -> Option<Rigid> {
    let (mut weight, mut p_mean, mut q_mean, mut count) = (0.0, Vector3::zeros(), Vector3::zeros(), 0);
    for (p, q, w) in pairs.clone() {
        weight += w;
        p_mean += Vector3::from(p.map(f64::from)) * w;
        q_mean += Vector3::from(q.map(f64::from)) * w;
        count += 1;
    }
    if count < 3 || weight <= 0.0 {
        return None;
    }
    p_mean /= weight;
    q_mean /= weight;
    let mut cross = Matrix3::zeros();
    for (p, q, w) in pairs {
        let (p, q) = (Vector3::from(p.map(f64::from)) - p_mean, Vector3::from(q.map(f64::from)) - q_mean);
        cross += q * p.transpose() * w;
    }
    let rotation = nearest_rotation(&cross);
    Some(Rigid { rotation, translation: q_mean - rotation * p_mean })
}
