//! Deep closest point (Wang & Solomon, ICCV 2019): soft matches of learned features, and the pose that fits them.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;
use serde::{Deserialize, Serialize};

use upcr::Result;

use super::attention::{Transformer, TransformerConfig};
use super::dense::BatchStatistics;
use super::dgcnn::{DEFAULT_K, DEFAULT_WIDTHS, Dgcnn, Edges, check_k};
use super::layers::{Init, Statistics, check_channels};
use super::procrustes;
use super::truth::Truth;
use crate::ops::attention;

/// A DCP network. The default is the paper's DCP-v2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DcpConfig {
    /// Neighbours of a point, itself included.
    pub k: usize,
    /// Channels after each of the point feature's first four layers.
    pub widths: [usize; 4],
    /// Channels of a point's feature.
    pub channels: usize,
    /// The transformer of DCP-v2; DCP-v1 has none, nor a file that tells none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pointer: Option<TransformerConfig>,
}

impl Default for DcpConfig {
    fn default() -> Self {
        let pointer = TransformerConfig { channels: 512, heads: 4, blocks: 1, inner: 1024 };
        Self { k: DEFAULT_K, widths: DEFAULT_WIDTHS, channels: 512, pointer: Some(pointer) }
    }
}

impl DcpConfig {
    /// The paper's DCP-v1.
    pub fn v1() -> Self {
        Self { pointer: None, ..Self::default() }
    }

    /// Refuses what makes no network.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        check_k(self.k)?;
        self.widths.into_iter().try_for_each(check_channels)?;
        check_channels(self.channels)?;
        match &self.pointer {
            Some(pointer) => pointer.check(self.channels),
            None => Ok(()),
        }
    }

    /// Random weights.
    pub fn init(&self, rng: &mut impl Rng, device: &Device) -> Dcp {
        let mut init = Init::new(rng, device);
        Dcp {
            config: self.clone(),
            emb_nn: Dgcnn::init(Edges::Kept, self.widths, self.channels, &mut init),
            pointer: self.pointer.map(|config| Transformer::init(&config, 0.0, &mut init)),
        }
    }
}

/// The network. Fields are named as in the published files.
#[derive(Module, Debug)]
pub struct Dcp {
    /// Features of points.
    pub emb_nn: Dgcnn,
    /// What they gain from the other cloud.
    pub pointer: Option<Transformer>,
    /// What the network is made of.
    #[module(skip)]
    pub config: DcpConfig,
}

/// What DCP finds of a batch of pairs.
#[derive(Debug, Clone)]
pub struct DcpOutput {
    /// Features of the sources' points, `[pairs, points, channels]`.
    pub source: Tensor<3>,
    /// Features of the targets' points.
    pub target: Tensor<3>,
    /// What the transformer gives for the source; the features where there is none.
    pub source_attended: Tensor<3>,
    /// The same of the target.
    pub target_attended: Tensor<3>,
    /// From source to target, `[pairs, 3, 3]`.
    pub rotation: Tensor<3>,
    /// From source to target, `[pairs, 3]`.
    pub translation: Tensor<2>,
    /// Of the norms, where the batch's normalised.
    pub statistics: BatchStatistics,
}

impl Dcp {
    /// The same network with `k` neighbours: among fewer points, fewer reach as far.
    #[must_use]
    pub fn seeing(&self, k: usize) -> Self {
        Self { config: DcpConfig { k, ..self.config.clone() }, ..self.clone() }
    }

    /// Features of the points of sources and targets, each `[pairs, points, channels]`, and what the transformer makes of
    /// them.
    pub(super) fn features(
        &self,
        source_points: &Tensor<3>,
        target_points: &Tensor<3>,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> ([Tensor<3>; 2], [Tensor<3>; 2]) {
        let k = self.config.k;
        let [source, target] = self.emb_nn.of_pairs(source_points, target_points, k, statistics, found);
        let attended = match &self.pointer {
            Some(pointer) => pointer.forward(&source, &target),
            None => [source.clone(), target.clone()],
        };
        ([source, target], attended)
    }

    /// From `[pairs, points, 3]` of sources and targets.
    pub fn forward(
        &self,
        source_points: &Tensor<3>,
        target_points: &Tensor<3>,
        statistics: Statistics,
    ) -> DcpOutput {
        let mut found = Vec::new();
        let ([source, target], [source_attended, target_attended]) =
            self.features(source_points, target_points, statistics, &mut found);
        let (rotation, translation) = soft_pose(
            source_points,
            target_points,
            source.clone() + source_attended.clone(),
            target.clone() + target_attended.clone(),
        );
        DcpOutput {
            source,
            target,
            source_attended,
            target_attended,
            rotation,
            translation,
            statistics: found,
        }
    }

    /// The network with running statistics moved by `share` towards a batch's.
    #[must_use]
    pub fn observed(self, batch: &[[Tensor<1>; 2]], share: f64) -> Self {
        Self { emb_nn: self.emb_nn.observed(&mut batch.iter(), share), ..self }
    }
}

impl DcpOutput {
    /// DCP learns from true poses.
    pub fn loss(&self, truth: &Truth) -> Tensor<1> {
        truth.distance(&self.rotation, &self.translation)
    }
}

/// The pose that fits each source's points to the mean of the target's, weighted by how alike their features are.
fn soft_pose(
    source_points: &Tensor<3>,
    target_points: &Tensor<3>,
    source: Tensor<3>,
    target: Tensor<3>,
) -> (Tensor<3>, Tensor<2>) {
    let scale = 1.0 / (source.dims()[2] as f32).sqrt();
    let partners = attention(source, target, target_points.clone(), 1, scale);
    pose_of_matches(source_points.clone(), partners)
}

/// How alike features `[pairs, points, channels]` of sources and targets are, `[pairs, points, points]`.
pub(super) fn likeness(source: Tensor<3>, target: Tensor<3>) -> Tensor<3> {
    let scale = 1.0 / (source.dims()[2] as f64).sqrt();
    source.matmul(target.transpose()) * scale
}

/// The pose that lays points on their partners, both `[pairs, points, 3]`, with the least sum of squares.
pub(super) fn pose_of_matches(source: Tensor<3>, partners: Tensor<3>) -> (Tensor<3>, Tensor<2>) {
    let [pairs, ..] = source.dims();
    let (source_mean, partners_mean) = (source.clone().mean_dim(1), partners.clone().mean_dim(1));
    let covariance = (partners - partners_mean.clone()).transpose().matmul(source - source_mean.clone());
    let rotation = procrustes::rotation(covariance);
    let translation = partners_mean - source_mean.matmul(rotation.clone().transpose());
    (rotation, translation.reshape([pairs, 3]))
}
