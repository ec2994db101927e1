//! The point features of DCP and PRNet: dynamic graph convolutions (Wang et al., 2019), as these two use them.

use std::sync::Arc;

use burn::module::Module;
use burn::tensor::{Int, Tensor, TensorData};
use rand::Rng;
use upcr::{Error, Result};

use super::dense::{BatchNorm, BatchStatistics, Dense};
use super::layers::{Init, Statistics};
use crate::ops::{BatchGraph, Normalized, NormalizedMap, graph_layer, group_max, nearest_features};

/// Neighbours of a point, itself included, as published.
pub const DEFAULT_K: usize = 20;
/// Channels after each of the first four layers, which the fifth reads together, as published.
pub const DEFAULT_WIDTHS: [usize; 4] = [64, 64, 128, 256];
/// Slope of PRNet's rectifiers for negative values.
pub(super) const NEGATIVE_SLOPE: f32 = 0.2;

/// Refuses what is no number of neighbours.
pub(super) fn check_k(k: usize) -> Result<()> {
    if (1..=255).contains(&k) {
        return Ok(());
    }
    Err(Error::InvalidSetting { name: "k", reason: format!("must be 1 to 255 neighbours, not {k}") })
}

/// Over which edges the layers look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edges {
    /// DCP: one graph, of positions; the features of edges go from layer to layer, and each layer's maximum over a point's
    /// edges is kept for the last.
    Kept,
    /// PRNet: every layer has the graph of the features that it is given.
    Dynamic,
}

/// Five maps and their norms. Fields are named as in the published files.
#[derive(Module, Debug)]
#[allow(missing_docs)]
pub struct Dgcnn {
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
    #[module(skip)]
    pub edges: Edges,
}

impl Dgcnn {
    pub(super) fn init(
        edges: Edges,
        [a, b, c, d]: [usize; 4],
        channels: usize,
        init: &mut Init<impl Rng>,
    ) -> Self {
        // A layer on the features of points sees an edge's two.
        let ends = if edges == Edges::Dynamic { 2 } else { 1 };
        Self {
            conv1: Dense::without_bias(6, a, init),
            conv2: Dense::without_bias(ends * a, b, init),
            conv3: Dense::without_bias(ends * b, c, init),
            conv4: Dense::without_bias(ends * c, d, init),
            conv5: Dense::without_bias(a + b + c + d, channels, init),
            bn1: BatchNorm::init(a, init),
            bn2: BatchNorm::init(b, init),
            bn3: BatchNorm::init(c, init),
            bn4: BatchNorm::init(d, init),
            bn5: BatchNorm::init(channels, init),
            edges,
        }
    }

    /// `[clouds, points, 3]` → `[clouds, points, channels]`, with `k` neighbours of each point.
    pub fn forward(
        &self,
        points: &Tensor<3>,
        k: usize,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> Tensor<3> {
        let [clouds, count, _] = points.dims();
        let rows = points.clone().reshape([clouds * count, 3]);
        let features = match self.edges {
            Edges::Kept => self.on_kept_edges(rows, [clouds, count], k, statistics, found),
            Edges::Dynamic => self.on_dynamic_edges(rows, count, k, statistics, found),
        };
        let slope = match self.edges {
            Edges::Kept => 0.0,
            Edges::Dynamic => NEGATIVE_SLOPE,
        };
        let joined = self.bn5.after(&self.conv5, Tensor::cat(features, 1), slope, statistics, found);
        let channels = joined.dims()[1];
        joined.reshape([clouds, count, channels])
    }

    /// The same of sources and of targets, which are normalised together.
    pub fn of_pairs(
        &self,
        source: &Tensor<3>,
        target: &Tensor<3>,
        k: usize,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> [Tensor<3>; 2] {
        let [pairs, ..] = source.dims();
        let clouds = Tensor::cat(vec![source.clone(), target.clone()], 0);
        let features = self.forward(&clouds, k, statistics, found);
        [features.clone().narrow(0, 0, pairs), features.narrow(0, pairs, pairs)]
    }

    fn layers(&self) -> [(&Dense, &BatchNorm); 4] {
        [
            (&self.conv1, &self.bn1),
            (&self.conv2, &self.bn2),
            (&self.conv3, &self.bn3),
            (&self.conv4, &self.bn4),
        ]
    }

    fn on_kept_edges(
        &self,
        points: Tensor<2>,
        [clouds, count]: [usize; 2],
        k: usize,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> Vec<Tensor<2>> {
        let graph = graph_of(&points, count, k);
        let k = graph.k;
        let device = points.device();
        let starts = (0..clouds).flat_map(|cloud| std::iter::repeat_n(cloud * count, count * k));
        let ends = graph.neighbors.iter().zip(starts).map(|(&j, start)| (start + j as usize) as i32);
        let ends = TensorData::new(ends.collect::<Vec<_>>(), [clouds * count * k]);
        let neighbors = points.clone().select(0, Tensor::<1, Int>::from_data(ends, &device));
        let centers =
            points.reshape([clouds * count, 1, 3]).repeat_dim(1, k).reshape([clouds * count * k, 3]);
        let mut edges = Tensor::cat(vec![neighbors, centers], 1);
        let layers = self.layers().map(|(map, norm)| {
            edges = norm.after(map, edges.clone(), 0.0, statistics, found);
            group_max(edges.clone(), k)
        });
        layers.to_vec()
    }

    fn on_dynamic_edges(
        &self,
        points: Tensor<2>,
        count: usize,
        k: usize,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> Vec<Tensor<2>> {
        let mut features = points;
        let layers = self.layers().map(|(map, norm)| {
            let graph = Arc::new(graph_of(&features, count, k));
            let inputs = features.dims()[1];
            // The published map is one of [Fⱼ ; Fᵢ], that of a graph layer of [Fᵢ ; Fⱼ − Fᵢ].
            let weight = map.weight.val().transpose();
            let (of_neighbor, of_center) =
                (weight.clone().narrow(0, 0, inputs), weight.narrow(0, inputs, inputs));
            let map = NormalizedMap {
                weight: Tensor::cat(vec![of_center + of_neighbor.clone(), of_neighbor], 0),
                gamma: norm.weight.val(),
                beta: norm.bias.val(),
                negative_slope: NEGATIVE_SLOPE,
            };
            let given = (statistics == Statistics::Running)
                .then(|| [norm.running_mean.val(), norm.running_var.val()]);
            let learned = given.is_none();
            let Normalized { values, statistics } = graph_layer(features.clone(), map, &graph, given);
            if learned {
                found.push(statistics);
            }
            features = values.clone();
            values
        });
        layers.to_vec()
    }

    /// The network with running statistics moved by `share` towards a batch's, taken from `batch` in the order of use.
    #[must_use]
    pub(super) fn observed<'a>(
        self,
        batch: &mut impl Iterator<Item = &'a [Tensor<1>; 2]>,
        share: f64,
    ) -> Self {
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

/// The nearest neighbours of every row among those of its cloud, itself included. Squared distances are computed as the
/// published code does, from inner products in single precision: where two are nearly equal, its choice is made.
fn graph_of(rows: &Tensor<2>, count: usize, k: usize) -> BatchGraph {
    let channels = rows.dims()[1];
    let features: Vec<f32> = rows.clone().detach().into_data().iter::<f32>().collect();
    nearest_features(&features, count, channels, k)
}
