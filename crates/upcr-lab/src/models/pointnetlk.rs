//! PointNetLK (Aoki et al., CVPR 2019): Lucas and Kanade's registration of two clouds' PointNet features, inverse
//! compositional, its Jacobian by finite differences.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use rand::Rng;
use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use super::dense::{BatchNorm, BatchStatistics, Dense};
use super::layers::{Init, Statistics, check_channels};
use super::procrustes::cross_matrix;
use super::truth::Truth;
use crate::ops::group_max;

/// A PointNetLK network. The default is the paper's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PointNetLkConfig {
    /// Channels after each map of a point; the last is the feature of a cloud.
    pub widths: [usize; 5],
    /// Steps at most.
    pub steps: usize,
}

impl Default for PointNetLkConfig {
    fn default() -> Self {
        Self { widths: [64, 64, 64, 128, 1024], steps: 10 }
    }
}

/// Twists by which the Jacobian's differences are taken.
const DIFFERENCE: f32 = 1e-2;
/// Twists smaller than this end the search.
const SMALL: f32 = 1e-7;
/// Squared angles below which the exponential's factors are taken from their series.
const SMALL_ANGLE_SQ: f64 = 1e-4;

impl PointNetLkConfig {
    /// Refuses what makes no network.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        self.widths.into_iter().try_for_each(check_channels)?;
        if (1..=1000).contains(&self.steps) {
            return Ok(());
        }
        Err(Error::InvalidSetting { name: "steps", reason: format!("must be 1 to 1000, not {}", self.steps) })
    }

    /// Random weights.
    pub fn init(&self, rng: &mut impl Rng, device: &Device) -> PointNetLk {
        let mut init = Init::new(rng, device);
        PointNetLk {
            feature_model: PointNet::init(self.widths, &mut init),
            dt: init.constant(DIFFERENCE, [1, 6]),
            config: self.clone(),
        }
    }
}

/// The network. Fields are named as in the published files.
#[derive(Module, Debug)]
pub struct PointNetLk {
    /// A cloud's feature.
    pub feature_model: PointNet,
    /// Twists of the Jacobian's differences, `[1, 6]`: rotation, then translation.
    pub dt: Param<Tensor<2>>,
    /// What the network is made of.
    #[module(skip)]
    pub config: PointNetLkConfig,
}

/// What PointNetLK finds of a batch of pairs.
#[derive(Debug, Clone)]
pub struct PointNetLkOutput {
    /// Between the clouds about their means, before the first step and after each, `[pairs, 4, 4]`; where a step changed
    /// nothing, the last ones are equal.
    pub series: Vec<Tensor<3>>,
    /// T_target_source of the last, `[pairs, 4, 4]`.
    pub pose: Tensor<3>,
    /// How far the source's last feature is from the target's, `[pairs, channels]`.
    pub residual: Tensor<2>,
    /// Of the norms, where the batch's normalised.
    pub statistics: BatchStatistics,
}

impl PointNetLkOutput {
    /// The last estimate's rotations `[pairs, 3, 3]` and translations `[pairs, 3]`.
    pub fn pose_parts(&self) -> (Tensor<3>, Tensor<2>) {
        let top = self.pose.clone().narrow(1, 0, 3);
        let [pairs, ..] = top.dims();
        (top.clone().narrow(2, 0, 3), top.narrow(2, 3, 1).reshape([pairs, 3]))
    }

    /// PointNetLK learns from true poses, and that the features of clouds in their true poses are equal: the mean square
    /// of the entries of T·T'⁻¹ − I, sixteen times, and of the feature's residual.
    pub fn loss(&self, truth: &Truth) -> Tensor<1> {
        let (rotation, translation) = self.pose_parts();
        let [pairs, ..] = rotation.dims();
        // T·T'⁻¹ = [R·R'ᵀ, t − R·R'ᵀ·t']
        let turn = rotation.matmul(truth.rotation.clone().transpose());
        let shift = truth.translation.clone().reshape([pairs, 3, 1]);
        let shift = translation.reshape([pairs, 3, 1]) - turn.clone().matmul(shift);
        let identity = Tensor::<2>::eye(3, &turn.device()).unsqueeze::<3>();
        let pose = ((turn - identity).square().sum() + shift.square().sum()) / pairs as f64;
        pose + self.residual.clone().square().mean()
    }
}

impl PointNetLk {
    /// From `[pairs, points, 3]` of sources and targets. Norms of the batch normalise the features of the clouds as they
    /// came; those of moved clouds have the running ones, which a feature and its differences share.
    pub fn forward(
        &self,
        source_points: &Tensor<3>,
        target_points: &Tensor<3>,
        statistics: Statistics,
    ) -> PointNetLkOutput {
        let mut found = Vec::new();
        let [pairs, ..] = source_points.dims();
        let device = source_points.device();
        if statistics == Statistics::Batch {
            let clouds = Tensor::cat(vec![source_points.clone(), target_points.clone()], 0);
            self.feature_model.forward(&centered(&clouds).0, statistics, &mut found);
        }
        let feature =
            |points: &Tensor<3>| self.feature_model.forward(points, Statistics::Running, &mut Vec::new());
        let ((source, source_mean), (target, target_mean)) =
            (centered(source_points), centered(target_points));
        let target_feature = feature(&target);
        let jacobian = self.jacobian(&target, &target_feature, feature);
        let jacobian_t = jacobian.clone().transpose();
        let normal = inverse(jacobian_t.clone().matmul(jacobian));
        let mut estimate = Tensor::<2>::eye(4, &device).unsqueeze::<3>().repeat_dim(0, pairs);
        let mut residual = target_feature.zeros_like();
        let mut series = Vec::with_capacity(self.config.steps + 1);
        series.push(estimate.clone());
        for _ in 0..self.config.steps {
            residual = feature(&moved(&estimate, &source)) - target_feature.clone();
            let channels = residual.dims()[1];
            let along = jacobian_t.clone().matmul(residual.clone().reshape([pairs, channels, 1]));
            let twist = -normal.clone().matmul(along);
            let largest = twist.clone().detach().abs().max().into_scalar::<f32>();
            if largest >= SMALL {
                estimate = exponential(twist).matmul(estimate);
            }
            series.push(estimate.clone());
        }
        let pose = between(estimate, &source_mean, &target_mean);
        PointNetLkOutput { series, pose, residual, statistics: found }
    }

    /// As many features as a pose takes: the target's, those of its twists, and the source's at every step.
    pub(super) fn features(&self, source_points: &Tensor<3>, target_points: &Tensor<3>) {
        let feature = |points| drop(self.feature_model.forward(points, Statistics::Running, &mut Vec::new()));
        feature(target_points);
        (0..6).for_each(|_| feature(target_points));
        (0..self.config.steps).for_each(|_| feature(source_points));
    }

    /// Changes of the target's feature by its twists, `[pairs, channels, 6]`.
    fn jacobian(
        &self,
        target: &Tensor<3>,
        target_feature: &Tensor<2>,
        feature: impl Fn(&Tensor<3>) -> Tensor<2>,
    ) -> Tensor<3> {
        let [pairs, ..] = target.dims();
        let channels = target_feature.dims()[1];
        let columns = (0..6).map(|axis| {
            let size = self.dt.val().narrow(1, axis, 1);
            let twist = Tensor::cat(
                (0..6).map(|a| if a == axis { -size.clone() } else { size.zeros_like() }).collect(),
                1,
            );
            let twist: Tensor<3> = twist.reshape([1, 6, 1]).repeat_dim(0, pairs);
            let change = target_feature.clone() - feature(&moved(&exponential(twist), target));
            (change / size).reshape([pairs, channels, 1])
        });
        Tensor::cat(columns.collect(), 2)
    }

    /// The network with running statistics moved by `share` towards a batch's.
    #[must_use]
    pub fn observed(self, batch: &[[Tensor<1>; 2]], share: f64) -> Self {
        Self { feature_model: self.feature_model.observed(&mut batch.iter(), share), ..self }
    }
}

/// Five maps of each point and the maximum over all. Fields are named as in the published files.
#[derive(Module, Debug)]
#[allow(missing_docs)]
pub struct PointNet {
    pub conv1: Dense,
    pub conv2: Dense,
    pub conv3: Dense,
    pub conv4: Dense,
    pub conv5: Dense,
    pub bn1: BatchNorm,
    pub bn2: BatchNorm,
    pub bn3: BatchNorm,
    pub bn4: BatchNorm,
    pub bn5: BatchNorm,
}

impl PointNet {
    fn init([a, b, c, d, e]: [usize; 5], init: &mut Init<impl Rng>) -> Self {
        Self {
            conv1: Dense::init(3, a, init),
            conv2: Dense::init(a, b, init),
            conv3: Dense::init(b, c, init),
            conv4: Dense::init(c, d, init),
            conv5: Dense::init(d, e, init),
            bn1: BatchNorm::init(a, init),
            bn2: BatchNorm::init(b, init),
            bn3: BatchNorm::init(c, init),
            bn4: BatchNorm::init(d, init),
            bn5: BatchNorm::init(e, init),
        }
    }

    /// `[clouds, points, 3]` → `[clouds, channels]`.
    pub fn forward(
        &self,
        points: &Tensor<3>,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> Tensor<2> {
        let [clouds, count, _] = points.dims();
        let layers = [
            (&self.conv1, &self.bn1),
            (&self.conv2, &self.bn2),
            (&self.conv3, &self.bn3),
            (&self.conv4, &self.bn4),
            (&self.conv5, &self.bn5),
        ];
        let mut x = points.clone().reshape([clouds * count, 3]);
        for (map, norm) in layers {
            x = norm.after(map, x, 0.0, statistics, found);
        }
        group_max(x, count)
    }

    fn observed<'a>(self, batch: &mut impl Iterator<Item = &'a [Tensor<1>; 2]>, share: f64) -> Self {
        let mut observe = |norm: BatchNorm| norm.observed(batch, share);
        Self {
            bn1: observe(self.bn1),
            bn2: observe(self.bn2),
            bn3: observe(self.bn3),
            bn4: observe(self.bn4),
            bn5: observe(self.bn5),
            ..self
        }
    }
}

/// Points about their mean, and the mean, `[pairs, 1, 3]`.
fn centered(points: &Tensor<3>) -> (Tensor<3>, Tensor<3>) {
    let mean = points.clone().mean_dim(1);
    (points.clone() - mean.clone(), mean)
}

/// Points `[pairs, points, 3]` moved by poses `[pairs, 4, 4]`.
fn moved(pose: &Tensor<3>, points: &Tensor<3>) -> Tensor<3> {
    let rotation = pose.clone().narrow(1, 0, 3).narrow(2, 0, 3);
    let translation = pose.clone().narrow(1, 0, 3).narrow(2, 3, 1);
    points.clone().matmul(rotation.transpose()) + translation.transpose()
}

/// The pose between clouds whose means, `[pairs, 1, 3]`, were taken off.
fn between(pose: Tensor<3>, source_mean: &Tensor<3>, target_mean: &Tensor<3>) -> Tensor<3> {
    let top = pose.clone().narrow(1, 0, 3);
    let rotation = top.clone().narrow(2, 0, 3);
    let turned = rotation.clone().matmul(source_mean.clone().transpose());
    let translation = top.narrow(2, 3, 1) + target_mean.clone().transpose() - turned;
    Tensor::cat(vec![Tensor::cat(vec![rotation, translation], 2), pose.narrow(1, 3, 1)], 1)
}

/// Twists `[pairs, 6, 1]`, rotation before translation, to poses `[pairs, 4, 4]`.
fn exponential(twist: Tensor<3>) -> Tensor<3> {
    let [pairs, ..] = twist.dims();
    let device = twist.device();
    let (w, v) = (twist.clone().narrow(1, 0, 3), twist.narrow(1, 3, 3));
    let angle_sq: Tensor<3> = w.clone().square().sum_dim(1);
    let small = angle_sq.clone().lower_elem(SMALL_ANGLE_SQ);
    // Where the angle is small, another stands in for it, so that what is not used has a gradient too.
    let angle_sq_safe = angle_sq.clone().mask_fill(small.clone(), 1.0);
    let angle = angle_sq_safe.clone().sqrt();
    // sin θ / θ, (1 − cos θ) / θ², (θ − sin θ) / θ³
    let chosen = |large: Tensor<3>, [a, b, c]: [f64; 3]| {
        let series = (angle_sq.clone() * c + b) * angle_sq.clone() + a;
        large.mask_where(small.clone(), series)
    };
    let first = chosen(angle.clone().sin() / angle.clone(), [1.0, -1.0 / 6.0, 1.0 / 120.0]);
    let second =
        chosen((-angle.clone().cos() + 1.0) / angle_sq_safe.clone(), [0.5, -1.0 / 24.0, 1.0 / 720.0]);
    let third = (angle.clone() - angle.clone().sin()) / (angle_sq_safe * angle);
    let third = chosen(third, [1.0 / 6.0, -1.0 / 120.0, 1.0 / 5040.0]);
    let cross = cross_matrix(&w);
    let squared = cross.clone().matmul(cross.clone());
    let identity = Tensor::<2>::eye(3, &device).unsqueeze::<3>();
    let rotation = cross.clone() * first + squared.clone() * second.clone() + identity.clone();
    let translation = (cross * second + squared * third + identity).matmul(v);
    let last =
        Tensor::<1>::from_floats([0.0, 0.0, 0.0, 1.0], &device).reshape([1, 1, 4]).repeat_dim(0, pairs);
    Tensor::cat(vec![Tensor::cat(vec![rotation, translation], 2), last], 1)
}

/// Inverses of symmetric positive matrices `[pairs, n, n]`, by Gauss and Jordan: they need no pivots.
fn inverse(matrices: Tensor<3>) -> Tensor<3> {
    let [pairs, n, _] = matrices.dims();
    let identity = Tensor::<2>::eye(n, &matrices.device()).unsqueeze::<3>().repeat_dim(0, pairs);
    let mut rows = Tensor::cat(vec![matrices, identity.clone()], 2);
    for pivot in 0..n {
        let row = rows.clone().narrow(1, pivot, 1);
        let row = row.clone() / row.narrow(2, pivot, 1);
        let unit = identity.clone().narrow(2, pivot, 1);
        // The pivot's own row becomes `row`, the others lose their share of it.
        let share = rows.clone().narrow(2, pivot, 1) - unit;
        rows = rows - share.matmul(row);
    }
    rows.narrow(2, n, n)
}
