//! The UPCR network (sections II-A and II-B): poses from what of a cloud's representation depends on the pose.

use std::sync::Arc;

use burn::module::Module;
use burn::tensor::activation::{leaky_relu, log_softmax};
use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use upcr::net::{GraphKind, Invariant, NetworkConfig};
use upcr::{Result, Rigid};

use super::input::Clouds;
use super::layers::{Init, Linear, NormalizedLayer, Statistics};
use super::rotation::rotations;

use crate::ops::{BatchGraph, Normalized, canonical_chamfer, edge_embed, graph_layer, pool_max};

/// The first weights of the pose head's last layer are this small: an unlearned network moves nothing much.
const LAST_LAYER_GAIN: f32 = 0.1;

/// The UPCR network.
#[derive(Module, Debug)]
pub struct Upcr {
    /// Graph layers on the coordinates: Γ_G.
    pub global: Vec<NormalizedLayer>,
    /// h_α on the invariant feature, where there is one.
    pub embed: Option<NormalizedLayer>,
    /// Graph layers on what h_α gives: Γ_ν.
    pub invariant: Vec<NormalizedLayer>,
    /// h_β.
    pub head: Vec<Linear>,
    /// What the network is made of.
    #[module(skip)]
    pub config: NetworkConfig,
}

/// What the network says of the clouds of a batch.
#[derive(Debug, Clone)]
pub struct Output {
    /// Γ_G, `[clouds, m]`.
    pub global: Tensor<2>,
    /// Γ_ν, `[clouds, m]`; none without an invariant branch.
    pub invariant: Option<Tensor<2>>,
    /// Γ_μ, `[clouds, m]`.
    pub pose_related: Tensor<2>,
    /// R_X, `[clouds, 9]`, row by row.
    pub rotations: Tensor<2>,
    /// t_X minus the cloud's centroid, `[clouds, 3]`.
    pub translations: Tensor<2>,
    /// Mean and variance over edges of every normalised layer, in the order of [`Upcr::normalized_layers`].
    pub statistics: Vec<[Tensor<1>; 2]>,
}

/// Random weights for a network of `config`.
///
/// # Errors
/// Where the configuration is no network's.
pub fn init(config: &NetworkConfig, rng: &mut impl Rng, device: &Device) -> Result<Upcr> {
    config.check()?;
    let mut init = Init::new(rng, device);
    let mut layers = |first: usize| -> Vec<NormalizedLayer> {
        let inputs = std::iter::once(first).chain(config.widths.iter().copied());
        inputs
            .zip(&config.widths)
            .map(|(inputs, &outputs)| NormalizedLayer::init(2 * inputs, outputs, &mut init))
            .collect()
    };
    let global = layers(3);
    let separated = config.invariant != Invariant::None;
    let invariant = if separated { layers(config.widths[0]) } else { Vec::new() };
    let phi = config.invariant.edge_dim() + config.invariant.point_dim();
    let embed = separated.then(|| NormalizedLayer::init(phi, config.widths[0], &mut init));
    let widths: Vec<usize> = std::iter::once(config.representation())
        .chain(config.head.iter().copied())
        .chain([config.rotation.values() + 3])
        .collect();
    let last = widths.len() - 2;
    let head = widths
        .windows(2)
        .enumerate()
        .map(|(layer, width)| {
            let gain = if layer == last { LAST_LAYER_GAIN } else { 1.0 };
            Linear::init(width[0], width[1], gain, &mut init)
        })
        .collect();
    Ok(Upcr { global, embed, invariant, head, config: config.clone() })
}

impl Upcr {
    /// Both branches, their separation and the poses.
    pub fn forward(&self, clouds: &Clouds, statistics: Statistics) -> Output {
        let device = self.head[0].weight.device();
        let mut found = Vec::new();
        let coordinates = clouds.points.points.as_flattened().to_vec();
        let rows = clouds.points.points.len();
        let x = Tensor::from_data(TensorData::new(coordinates, [rows, 3]), &device);
        let global = self.branch(x, &self.global, &clouds.graph, statistics, &mut found);
        let invariant = self.embed.as_ref().map(|embed| {
            let map = embed.map(self.config.negative_slope);
            let phi = edge_embed(&clouds.phi, map, &clouds.graph, given(embed, statistics));
            found.push(phi.statistics);
            self.branch(phi.values, &self.invariant, &clouds.graph, statistics, &mut found)
        });
        let pose_related = match &invariant {
            Some(invariant) => separated(global.clone(), invariant.clone()),
            None => global.clone(),
        };
        let mut pose = pose_related.clone();
        for (layer, linear) in self.head.iter().enumerate() {
            if layer > 0 {
                pose = leaky_relu(pose, f64::from(self.config.negative_slope));
            }
            pose = linear.forward(pose);
        }
        let turn = self.config.rotation.values();
        Output {
            global,
            invariant,
            pose_related,
            rotations: rotations(self.config.rotation, pose.clone().narrow(1, 0, turn)),
            translations: pose.narrow(1, turn, 3),
            statistics: found,
        }
    }

    /// Graph layers and the maximum over a cloud's points: `[rows, inputs]` → `[clouds, m]`.
    fn branch(
        &self,
        mut features: Tensor<2>,
        layers: &[NormalizedLayer],
        graph: &Arc<BatchGraph>,
        statistics: Statistics,
        found: &mut Vec<[Tensor<1>; 2]>,
    ) -> Tensor<2> {
        for layer in layers {
            let by_features;
            let graph = match self.config.graph {
                GraphKind::Static => graph,
                GraphKind::Dynamic => {
                    by_features = Arc::new(dynamic_graph(&features, graph));
                    &by_features
                }
            };
            let map = layer.map(self.config.negative_slope);
            let Normalized { values, statistics } =
                graph_layer(features, map, graph, given(layer, statistics));
            features = values;
            found.push(statistics);
        }
        pool_max(features, graph)
    }

    /// Layers with batch norm, in the order in which [`Output::statistics`] has theirs.
    pub fn normalized_layers(&self) -> impl Iterator<Item = &NormalizedLayer> {
        self.global.iter().chain(&self.embed).chain(&self.invariant)
    }

    /// Moves the running statistics by `share` towards a batch's.
    #[must_use]
    pub fn observed(mut self, batch: &[[Tensor<1>; 2]], share: f64) -> Self {
        let mut batch = batch.iter();
        let mut observe = |layer: NormalizedLayer| match batch.next() {
            Some(statistics) => layer.observed(statistics, share),
            None => layer,
        };
        self.global = self.global.into_iter().map(&mut observe).collect();
        self.embed = self.embed.map(&mut observe);
        self.invariant = self.invariant.into_iter().map(&mut observe).collect();
        self
    }
}

impl Output {
    /// The Chamfer distance between the canonical shapes of every pair, `[pairs]` (equation 7).
    pub fn loss(&self, clouds: &Clouds) -> Tensor<1> {
        canonical_chamfer(self.rotations.clone(), self.translations.clone(), &clouds.points)
    }

    /// The pose of every pair: R = R_Y·R_Xᵀ, t = t_Y - R·t_X.
    pub fn poses(&self, clouds: &Clouds) -> Vec<Rigid> {
        let values = |tensor: &Tensor<2>| tensor.clone().into_data().iter::<f32>().map(f64::from).collect();
        let (rotations, translations): (Vec<f64>, Vec<f64>) =
            (values(&self.rotations), values(&self.translations));
        let pose = |cloud: usize| {
            let centroid = Vector3::from(clouds.centroids[cloud].map(f64::from));
            Rigid {
                rotation: Matrix3::from_row_slice(&rotations[cloud * 9..][..9]),
                translation: Vector3::from_row_slice(&translations[cloud * 3..][..3]) + centroid,
            }
        };
        let pairs = clouds.pairs();
        (0..pairs).map(|pair| pose(pairs + pair) * pose(pair).inverse()).collect()
    }
}

/// Γ_μ = p · log(p / q) with q = softmax(Γ_G) and p = softmax(Γ_ν) (equation 5), times m so that entries are of
/// order one.
fn separated(global: Tensor<2>, invariant: Tensor<2>) -> Tensor<2> {
    let m = global.dims()[1] as f64;
    let (log_q, log_p) = (log_softmax(global, 1), log_softmax(invariant, 1));
    log_p.clone().exp() * (log_p - log_q) * m
}

fn given(layer: &NormalizedLayer, statistics: Statistics) -> Option<[Tensor<1>; 2]> {
    (statistics == Statistics::Running).then(|| layer.running())
}

/// The K nearest of every row in its own features, by cloud; the row itself included, ties by index.
fn dynamic_graph(features: &Tensor<2>, graph: &BatchGraph) -> BatchGraph {
    let channels = features.dims()[1];
    let values: Vec<f32> = features.clone().into_data().iter::<f32>().collect();
    let clouds: Vec<upcr::net::Graph> = (0..graph.clouds())
        .map(|cloud| {
            let rows = graph.cloud(cloud);
            upcr::net::Graph::of_features(
                &values[rows.start * channels..rows.end * channels],
                channels,
                graph.k,
            )
        })
        .collect();
    BatchGraph::new(&clouds, graph.k)
}
