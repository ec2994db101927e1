//! The operations in the framework's own tensors, for devices without kernels of ours.
//!
//! The graph layer has two products a point and no product an edge here too, but its gathered edges are a tensor.

// Tensors are handles, which the framework passes by value.
#![allow(clippy::needless_pass_by_value)]

use burn::tensor::activation::{leaky_relu, softmax};
use burn::tensor::{Device, Int, Tensor, TensorData};

use super::batch::BatchGraph;
use super::canonical_chamfer::PairPoints;
use super::edge_embed::EdgeInputs;
use super::graph_layer::EPSILON;
use super::normalized::{Normalized, NormalizedMap};
use super::rows::DEVIATION_EPSILON;

/// Rows of the edges' neighbours, counted over the batch.
fn neighbor_rows(graph: &BatchGraph, device: &Device) -> Tensor<1, Int> {
    let mut rows = Vec::with_capacity(graph.edges());
    for cloud in 0..graph.clouds() {
        let first = graph.cloud(cloud).start as i32;
        rows.extend(graph.view(cloud).neighbors.iter().map(|&j| first + j as i32));
    }
    let edges = rows.len();
    Tensor::from_data(TensorData::new(rows, [edges]), device)
}

/// Norm and rectifier of edge values `[rows, k, outputs]`, then the maximum over k. The norm's statistics are those of
/// all edges.
fn reduce_edges(v: Tensor<3>, map: &NormalizedMap, statistics: Option<[Tensor<1>; 2]>) -> Normalized {
    let [rows, k, outputs] = v.dims();
    let [mean, variance] = statistics.unwrap_or_else(|| {
        let edges = v.clone().reshape([rows * k, outputs]);
        let mean = edges.clone().mean_dim(0);
        let variance = (edges - mean.clone()).square().mean_dim(0);
        [mean.reshape([outputs]), variance.reshape([outputs])]
    });
    let [gamma, beta] = [&map.gamma, &map.beta].map(|tensor| tensor.clone().reshape([1, outputs]));
    // The maximum of what rises with v is that of v; where the scale is negative, of -v.
    let sign = (gamma.clone().detach().greater_equal_elem(0.0).float() * 2.0 - 1.0).reshape([1, 1, outputs]);
    let largest = (v * sign.clone()).max_dim(1) * sign;
    let scale = (variance.clone().reshape([1, outputs]) + EPSILON).sqrt().recip() * gamma;
    let y = (largest.reshape([rows, outputs]) - mean.clone().reshape([1, outputs])) * scale + beta;
    Normalized {
        values: leaky_relu(y, f64::from(map.negative_slope)),
        statistics: [mean.detach(), variance.detach()],
    }
}

pub(super) fn graph_layer(
    features: Tensor<2>,
    map: NormalizedMap,
    graph: &BatchGraph,
    statistics: Option<[Tensor<1>; 2]>,
) -> Normalized {
    let [rows, inputs] = features.dims();
    let outputs = map.gamma.dims()[0];
    let own = map.weight.clone().narrow(0, 0, inputs);
    let difference = map.weight.clone().narrow(0, inputs, inputs);
    let a = features.clone().matmul(own - difference.clone());
    let b = features.matmul(difference);
    let gathered = b.clone().select(0, neighbor_rows(graph, &b.device()));
    let v = gathered.reshape([rows, graph.k, outputs]) + a.reshape([rows, 1, outputs]);
    reduce_edges(v, &map, statistics)
}

pub(super) fn edge_embed(
    inputs: &EdgeInputs,
    map: NormalizedMap,
    graph: &BatchGraph,
    statistics: Option<[Tensor<1>; 2]>,
) -> Normalized {
    let device = map.weight.device();
    let (edge_dim, point_dim) = (inputs.phi.edge_dim, inputs.phi.point_dim);
    let outputs = map.gamma.dims()[0];
    let mut v = Tensor::zeros([graph.edges(), outputs], &device);
    if edge_dim > 0 {
        let edges = TensorData::new(inputs.phi.edges.clone(), [graph.edges(), edge_dim]);
        v = v + Tensor::from_data(edges, &device).matmul(map.weight.clone().narrow(0, 0, edge_dim));
    }
    if point_dim > 0 {
        let points = TensorData::new(inputs.phi.points.clone(), [graph.rows(), point_dim]);
        let points =
            Tensor::from_data(points, &device).matmul(map.weight.clone().narrow(0, edge_dim, point_dim));
        v = v + points.select(0, neighbor_rows(graph, &device));
    }
    reduce_edges(v.reshape([graph.rows(), graph.k, outputs]), &map, statistics)
}

pub(super) fn pool_max(features: Tensor<2>, graph: &BatchGraph) -> Tensor<2> {
    let clouds = (0..graph.clouds()).map(|cloud| {
        let rows = graph.cloud(cloud);
        features.clone().narrow(0, rows.start, rows.len()).max_dim(0)
    });
    Tensor::cat(clouds.collect(), 0)
}

pub(super) fn canonical_chamfer(
    rotations: Tensor<2>,
    translations: Tensor<2>,
    clouds: &PairPoints,
) -> Tensor<1> {
    let device = rotations.device();
    let canonical = |cloud: usize| -> Tensor<2> {
        let points = clouds.cloud(cloud);
        let points = TensorData::new(points.as_flattened().to_vec(), [points.len(), 3]);
        let rotation = rotations.clone().narrow(0, cloud, 1).reshape([3, 3]);
        (Tensor::from_data(points, &device) - translations.clone().narrow(0, cloud, 1)).matmul(rotation)
    };
    let pairs = (0..clouds.pairs()).map(|pair| {
        let (x, y) = (canonical(pair), canonical(clouds.pairs() + pair));
        let (nx, ny) = (x.dims()[0], y.dims()[0]);
        let differences = x.reshape([nx, 1, 3]) - y.reshape([1, ny, 3]);
        let distances_sq: Tensor<2> = differences.square().sum_dim(2).reshape([nx, ny]);
        distances_sq.clone().min_dim(1).mean() + distances_sq.min_dim(0).mean()
    });
    Tensor::cat(pairs.collect(), 0)
}

pub(super) fn attention(
    queries: Tensor<3>,
    keys: Tensor<3>,
    values: Tensor<3>,
    heads: usize,
    scale: f32,
) -> Tensor<3> {
    let split = |x: Tensor<3>| -> Tensor<4> {
        let [batch, points, channels] = x.dims();
        x.reshape([batch, points, heads, channels / heads]).swap_dims(1, 2)
    };
    let ([batch, points, _], [.., width]) = (queries.dims(), values.dims());
    let shares = softmax(split(queries).matmul(split(keys).transpose()) * scale, 3);
    shares.matmul(split(values)).swap_dims(1, 2).reshape([batch, points, width])
}

/// What a rectifier with that slope for negative values makes of rows.
fn rectified(x: Tensor<2>, slope: f32) -> Tensor<2> {
    if slope == 1.0 { x } else { leaky_relu(x, f64::from(slope)) }
}

pub(super) fn dense(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, slope: f32) -> Tensor<2> {
    rectified(x.matmul(weight.transpose()) + bias.unsqueeze(), slope)
}

pub(super) fn batch_norm(x: Tensor<2>, gamma: Tensor<1>, beta: Tensor<1>, slope: f32) -> Normalized {
    let channels = x.dims()[1];
    let mean = x.clone().mean_dim(0);
    let variance = (x.clone() - mean.clone()).square().mean_dim(0);
    let scale: Tensor<2> = (variance.clone() + EPSILON).sqrt().recip() * gamma.unsqueeze();
    Normalized {
        values: rectified((x - mean.clone()) * scale + beta.unsqueeze(), slope),
        statistics: [mean, variance].map(|tensor| tensor.detach().reshape([channels])),
    }
}

pub(super) fn layer_norm(x: Tensor<2>, scale: Tensor<1>, shift: Tensor<1>) -> Tensor<2> {
    let channels = x.dims()[1] as f64;
    let epsilon = f64::from(DEVIATION_EPSILON);
    let centered = x.clone() - x.mean_dim(1);
    let variance = centered.clone().square().sum_dim(1) / (channels - 1.0).max(1.0);
    let deviation = (variance + epsilon * epsilon).sqrt() + epsilon;
    centered / deviation * scale.unsqueeze() + shift.unsqueeze()
}

pub(super) fn group_max(x: Tensor<2>, size: usize) -> Tensor<2> {
    let [rows, channels] = x.dims();
    x.reshape([rows / size, size, channels]).max_dim(1).reshape([rows / size, channels])
}
