//! Each operation in three forms: the kernels, the generic tensors, and the plainest form with an edge tensor.

use std::sync::Arc;

use burn::tensor::activation::leaky_relu;
use burn::tensor::{Device, Int, Tensor, TensorData};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use upcr::neighbors::KdTree;
use upcr::net::{Graph, Invariant, InvariantInputs};

use super::canonical_chamfer::PairPoints;
use super::edge_embed::EdgeInputs;
use super::normalized::{Normalized, NormalizedMap};
use super::{BatchGraph, extension, generic};
use crate::random;

const SLOPE: f32 = 0.2;

fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), &Device::flex().autodiff())
}

fn uniform(rng: &mut ChaCha8Rng, count: usize) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
}

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap()
}

/// With `--nocapture` tells how far off it is.
#[track_caller]
#[allow(clippy::print_stderr)]
fn assert_close(what: &str, found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1e-3_f32, |s, v| s.max(v.abs()));
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    eprintln!("{what}: {:e}", worst / scale);
    assert!(worst <= 1e-4 * scale, "{what}: {worst} off of {scale}");
}

/// Clouds of given sizes with their graphs and distance features.
fn clouds(
    sizes: &[usize],
    k: usize,
    kind: Invariant,
    rng: &mut ChaCha8Rng,
) -> (Arc<BatchGraph>, Arc<EdgeInputs>) {
    let (graphs, inputs): (Vec<Graph>, Vec<InvariantInputs>) = sizes
        .iter()
        .map(|&size| {
            let points: Vec<[f32; 3]> = (0..size).map(|_| std::array::from_fn(|_| rng.random())).collect();
            let neighborhoods = KdTree::new(&points).knn_graph(k);
            (Graph::from(&neighborhoods), kind.inputs(&points, &neighborhoods).unwrap())
        })
        .unzip();
    let graph = BatchGraph::new(&graphs, k);
    let phi = EdgeInputs::new(&inputs, &graph);
    (Arc::new(graph), Arc::new(phi))
}

/// Rows of every edge's point and of its neighbour.
fn edge_rows(graph: &BatchGraph) -> [Tensor<1, Int>; 2] {
    let mut rows = [Vec::new(), Vec::new()];
    for cloud in 0..graph.clouds() {
        let first = graph.cloud(cloud).start;
        for (edge, &j) in graph.view(cloud).neighbors.iter().enumerate() {
            rows[0].push((first + edge / graph.k) as i32);
            rows[1].push((first + j as usize) as i32);
        }
    }
    rows.map(|rows| {
        let edges = rows.len();
        Tensor::from_data(TensorData::new(rows, [edges]), &Device::flex().autodiff())
    })
}

/// A map of an edge tensor `[edges, inputs]`, batch norm over all edges, the rectifier, the maximum over k edges.
fn plain(edges: Tensor<2>, map: NormalizedMap, k: usize) -> Tensor<2> {
    let v = edges.matmul(map.weight);
    let mean = v.clone().mean_dim(0);
    let variance = (v.clone() - mean.clone()).square().mean_dim(0);
    let y = (v - mean) / (variance + 1e-5).sqrt() * map.gamma.unsqueeze() + map.beta.unsqueeze();
    let [edges, outputs] = y.dims();
    leaky_relu(y, f64::from(SLOPE)).reshape([edges / k, k, outputs]).max_dim(1).reshape([edges / k, outputs])
}

fn random_map(inputs: usize, outputs: usize, rng: &mut ChaCha8Rng) -> NormalizedMap {
    NormalizedMap {
        weight: tensor(uniform(rng, inputs * outputs), [inputs, outputs]).require_grad(),
        gamma: tensor(uniform(rng, outputs), [outputs]).require_grad(),
        beta: tensor(uniform(rng, outputs), [outputs]).require_grad(),
        negative_slope: SLOPE,
    }
}

/// Values, and the gradients of a weighted sum of them with respect to the map's parameters and `features`.
fn with_gradients(
    out: Tensor<2>,
    map: &NormalizedMap,
    features: Option<&Tensor<2>>,
) -> Vec<(&'static str, Vec<f32>)> {
    let shape = out.dims();
    let weights = uniform(&mut random::stream(99, 0), shape[0] * shape[1]);
    let gradients = (out.clone() * tensor(weights, shape)).sum().backward();
    let mut found = vec![
        ("values", values(out)),
        ("weight", values(map.weight.grad(&gradients).unwrap())),
        ("gamma", values(map.gamma.grad(&gradients).unwrap())),
        ("beta", values(map.beta.grad(&gradients).unwrap())),
    ];
    found.extend(features.map(|features| ("features", values(features.grad(&gradients).unwrap()))));
    found
}

#[test]
fn a_graph_layer_is_its_edge_tensor_form() {
    let mut rng = random::stream(21, 0);
    for (k, inputs, outputs) in
        [(1, 3, 8), (2, 8, 16), (3, 5, 33), (7, 16, 70), (16, 4, 11), (24, 8, 64), (40, 6, 40)]
    {
        let (graph, _) = clouds(&[50, 73, 41, 64], k, Invariant::None, &mut rng);
        let rows = graph.rows();
        let features = tensor(uniform(&mut rng, rows * inputs), [rows, inputs]).require_grad();
        let map = random_map(2 * inputs, outputs, &mut rng);

        let [own, neighbor] = edge_rows(&graph).map(|rows| features.clone().select(0, rows));
        let edges = Tensor::cat(vec![own.clone(), neighbor - own], 1);
        let expected = with_gradients(plain(edges, map.clone(), k), &map, Some(&features));
        let fused = extension::graph_layer(features.clone(), map.clone(), &graph, None);
        let fused_values = with_gradients(fused.values, &map, Some(&features));
        let other = generic::graph_layer(features.clone(), map.clone(), &graph, None);
        let other_values = with_gradients(other.values, &map, Some(&features));
        for ((name, expected), (fused, other)) in expected.iter().zip(fused_values.iter().zip(&other_values))
        {
            assert_close(&format!("K = {k}: {name}"), &fused.1, expected);
            assert_close(&format!("K = {k}: generic {name}"), &other.1, expected);
        }
        for (fused, other) in fused.statistics.into_iter().zip(other.statistics) {
            assert_close("statistics", &values(fused), &values(other));
        }
    }
}

#[test]
fn a_cloud_smaller_than_k_has_all_its_points_as_neighbours() {
    let mut rng = random::stream(22, 0);
    let (graph, phi) = clouds(&[5, 30], 12, Invariant::Distance, &mut rng);
    assert_eq!((graph.edges(), phi.phi.edges.len()), (35 * 12, 35 * 12 * 3));
    let features = tensor(uniform(&mut rng, 35 * 4), [35, 4]).require_grad();
    let map = random_map(8, 16, &mut rng);
    let [own, neighbor] = edge_rows(&graph).map(|rows| features.clone().select(0, rows));
    let edges = Tensor::cat(vec![own.clone(), neighbor - own], 1);
    let expected = with_gradients(plain(edges, map.clone(), 12), &map, Some(&features));
    let fused = extension::graph_layer(features.clone(), map.clone(), &graph, None).values;
    for ((name, expected), (_, fused)) in expected.iter().zip(with_gradients(fused, &map, Some(&features))) {
        assert_close(name, &fused, expected);
    }
}

#[test]
fn the_invariant_embedding_is_its_edge_tensor_form() {
    let mut rng = random::stream(23, 0);
    for kind in [Invariant::Distance, Invariant::Spfh, Invariant::DistancePpfSpfh] {
        for (k, outputs) in [(3, 8), (9, 20)] {
            let (graph, phi) = clouds(&[40, 55], k, kind, &mut rng);
            let map = random_map(phi.dim(), outputs, &mut rng);
            let [_, neighbor] = edge_rows(&graph);
            let mut parts = Vec::new();
            if phi.phi.edge_dim > 0 {
                parts.push(tensor(phi.phi.edges.clone(), [graph.edges(), phi.phi.edge_dim]));
            }
            if phi.phi.point_dim > 0 {
                // A histogram's percentages are large beside the distances.
                let points = tensor(phi.phi.points.clone(), [graph.rows(), phi.phi.point_dim]);
                parts.push(points.select(0, neighbor));
            }
            let expected = with_gradients(plain(Tensor::cat(parts, 1), map.clone(), k), &map, None);
            let fused = extension::edge_embed(&phi, map.clone(), &graph, None).values;
            let fused = with_gradients(fused, &map, None);
            let other = generic::edge_embed(&phi, map.clone(), &graph, None).values;
            let other = with_gradients(other, &map, None);
            for ((name, expected), (fused, other)) in expected.iter().zip(fused.iter().zip(&other)) {
                assert_close(&format!("{kind:?} {name}"), &fused.1, expected);
                assert_close(&format!("{kind:?} generic {name}"), &other.1, expected);
            }
        }
    }
}

#[test]
fn given_statistics_take_the_place_of_the_batch() {
    let mut rng = random::stream(24, 0);
    let (graph, phi) = clouds(&[40, 30], 6, Invariant::Distance, &mut rng);
    let features = tensor(uniform(&mut rng, 70 * 4), [70, 4]);
    let given = || {
        let mut rng = random::stream(25, 0);
        Some(
            [uniform(&mut rng, 16), uniform(&mut rng, 16).iter().map(|v| v * v + 0.5).collect()]
                .map(|v| Tensor::from_data(TensorData::new(v, [16]), &Device::flex())),
        )
    };
    let inner = |map: &NormalizedMap| NormalizedMap {
        weight: map.weight.clone().inner(),
        gamma: map.gamma.clone().inner(),
        beta: map.beta.clone().inner(),
        negative_slope: SLOPE,
    };
    let pick = |normalized: Normalized| values(normalized.values);
    let map = inner(&random_map(8, 16, &mut rng));
    let features = features.inner();
    assert_close(
        "layer",
        &pick(extension::graph_layer(features.clone(), map.clone(), &graph, given())),
        &pick(generic::graph_layer(features, map, &graph, given())),
    );
    let map = inner(&random_map(3, 16, &mut rng));
    assert_close(
        "embedding",
        &pick(extension::edge_embed(&phi, map.clone(), &graph, given())),
        &pick(generic::edge_embed(&phi, map, &graph, given())),
    );
}

#[test]
fn pooling_takes_each_clouds_largest() {
    let mut rng = random::stream(26, 0);
    let (graph, _) = clouds(&[9, 20, 14], 3, Invariant::None, &mut rng);
    let features = tensor(uniform(&mut rng, 43 * 21), [43, 21]).require_grad();
    let weights = tensor(uniform(&mut rng, 3 * 21), [3, 21]);
    let found = [extension::pool_max(features.clone(), &graph), generic::pool_max(features.clone(), &graph)]
        .map(|out| {
            let gradients = (out.clone() * weights.clone()).sum().backward();
            (values(out), values(features.grad(&gradients).unwrap()))
        });
    assert_eq!(found[0], found[1]);
}

#[test]
fn the_loss_and_its_gradients_are_those_of_the_plain_form() {
    let mut rng = random::stream(27, 0);
    let sizes = [30, 41, 25, 57];
    let mut offsets = vec![0];
    offsets.extend(sizes.iter().scan(0, |sum, size| {
        *sum += size;
        Some(*sum)
    }));
    let points = (0..offsets[4]).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect();
    let clouds = Arc::new(PairPoints { points, offsets });
    // Any matrices serve: the loss does not know that they are rotations.
    let rotations = tensor(uniform(&mut rng, 4 * 9), [4, 9]).require_grad();
    let translations = tensor(uniform(&mut rng, 4 * 3), [4, 3]).require_grad();
    let found = [
        extension::canonical_chamfer(rotations.clone(), translations.clone(), &clouds),
        generic::canonical_chamfer(rotations.clone(), translations.clone(), &clouds),
    ]
    .map(|loss| {
        let weights = tensor(vec![0.3, 1.7], [2]);
        let gradients = (loss.clone() * weights).sum().backward();
        [
            values(loss),
            values(rotations.grad(&gradients).unwrap()),
            values(translations.grad(&gradients).unwrap()),
        ]
    });
    for (fused, plain) in found[0].iter().zip(&found[1]) {
        assert_close("loss", fused, plain);
    }
}

#[test]
fn layers_give_the_same_bits_on_any_number_of_threads() {
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let mut rng = random::stream(28, 0);
            let (graph, _) = clouds(&[50; 20], 6, Invariant::None, &mut rng);
            let features = tensor(uniform(&mut rng, 1000 * 16), [1000, 16]).require_grad();
            let map = random_map(32, 40, &mut rng);
            let out = extension::graph_layer(features.clone(), map.clone(), &graph, None).values;
            with_gradients(out, &map, Some(&features))
        })
    };
    assert_eq!(run(1), run(3));
}
