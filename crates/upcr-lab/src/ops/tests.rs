//! Each operation in three forms: the kernels, the generic tensors, and the plainest form with an edge tensor.

use std::sync::Arc;

use burn::tensor::activation::leaky_relu;
use burn::tensor::{Device, Gradients, Int, Tensor, TensorData};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use upcr::neighbors::KdTree;
use upcr::net::{Graph, Invariant, InvariantInputs};

use super::canonical_chamfer::PairPoints;
use super::edge_embed::EdgeInputs;
use super::normalized::{Normalized, NormalizedMap};
use super::{BatchGraph, extension, generic, layers, nearest_features};
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

/// An input's gradient.
type Slope<'a> = &'a dyn Fn(&Gradients) -> Vec<f32>;

/// Values of an operation, and the gradients of a weighted sum of them with respect to its inputs.
fn slopes<const D: usize>(out: Tensor<D>, gradients: &[Slope]) -> Vec<Vec<f32>> {
    let shape = out.dims();
    let weights = uniform(&mut random::stream(99, 0), shape.iter().product());
    let found = (out.clone() * tensor(weights, shape)).sum().backward();
    let mut all = vec![values(out)];
    all.extend(gradients.iter().map(|gradient| gradient(&found)));
    all
}

fn of<const D: usize>(input: &Tensor<D>) -> impl Fn(&Gradients) -> Vec<f32> {
    let input = input.clone();
    move |gradients| values(input.grad(gradients).unwrap())
}

#[track_caller]
fn assert_all_close(what: &str, found: &[Vec<f32>], expected: &[Vec<f32>]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (found, expected) in found.iter().zip(expected) {
        assert_close(what, found, expected);
    }
}

fn leaf<const D: usize>(shape: [usize; D], rng: &mut ChaCha8Rng) -> Tensor<D> {
    tensor(uniform(rng, shape.iter().product()), shape).require_grad()
}

#[test]
fn attention_is_its_tensor_form() {
    let mut rng = random::stream(31, 0);
    // One block and several, one head and several, a block of one row.
    for (batch, points, others, channels, width, heads, scale) in
        [(3, 20, 33, 12, 8, 4, 0.7), (2, 513, 130, 16, 16, 2, 3.0), (2, 40, 7, 5, 3, 1, 20.0)]
    {
        let queries = leaf([batch, points, channels], &mut rng);
        let keys = leaf([batch, others, channels], &mut rng);
        let sought = leaf([batch, others, width], &mut rng);
        let gradients: [Slope; 3] = [&of(&queries), &of(&keys), &of(&sought)];
        let inputs = || (queries.clone(), keys.clone(), sought.clone());
        let (q, k, v) = inputs();
        let found = slopes(layers::attention(q, k, v, heads, scale), &gradients);
        let (q, k, v) = inputs();
        let expected = slopes(generic::attention(q, k, v, heads, scale), &gradients);
        assert_all_close("attention", &found, &expected);
    }
}

#[test]
fn maps_and_norms_of_rows_are_their_tensor_forms() {
    let mut rng = random::stream(32, 0);
    for (rows, inputs, outputs, slope) in [(2, 3, 5, 0.0), (300, 6, 16, 0.2), (2100, 16, 40, 1.0)] {
        let x = leaf([rows, inputs], &mut rng);
        let weight = leaf([outputs, inputs], &mut rng);
        let [scale, shift] = [outputs, outputs].map(|length| leaf([length], &mut rng));
        let gradients: [Slope; 3] = [&of(&x), &of(&weight), &of(&shift)];
        let inputs = || (x.clone(), weight.clone(), shift.clone());
        let (a, b, c) = inputs();
        let found = slopes(layers::dense(a, b, c, slope), &gradients);
        let (a, b, c) = inputs();
        assert_all_close("dense", &found, &slopes(generic::dense(a, b, c, slope), &gradients));

        // Far from zero, where squares alone would tell little of the variance.
        let x = tensor(uniform(&mut rng, rows * outputs).iter().map(|v| v + 30.0).collect(), [rows, outputs]);
        let x = x.require_grad();
        let gradients: [Slope; 3] = [&of(&x), &of(&scale), &of(&shift)];
        let inputs = || (x.clone(), scale.clone(), shift.clone());
        if rows > 2 {
            let (a, b, c) = inputs();
            let norm = layers::batch_norm(a, b, c, slope);
            let (a, b, c) = inputs();
            let expected = generic::batch_norm(a, b, c, slope);
            for (found, expected) in norm.statistics.into_iter().zip(expected.statistics) {
                assert_close("statistics", &values(found), &values(expected));
            }
            let found = slopes(norm.values, &gradients);
            assert_all_close("batch norm", &found, &slopes(expected.values, &gradients));
        }
        let (a, b, c) = inputs();
        let found = slopes(layers::layer_norm(a, b, c), &gradients);
        let (a, b, c) = inputs();
        assert_all_close("layer norm", &found, &slopes(generic::layer_norm(a, b, c), &gradients));
    }
}

#[test]
fn groups_have_their_largest_values() {
    let mut rng = random::stream(33, 0);
    for (groups, size, channels) in [(7, 1, 4), (90, 8, 17), (3, 500, 32)] {
        let x = leaf([groups * size, channels], &mut rng);
        let found = slopes(layers::group_max(x.clone(), size), &[&of(&x)]);
        assert_eq!(found, slopes(generic::group_max(x.clone(), size), &[&of(&x)]));
    }
}

#[test]
fn neighbours_by_features_are_the_nearest() {
    let mut rng = random::stream(34, 0);
    let (count, channels, k) = (60, 5, 7);
    let features = uniform(&mut rng, 3 * count * channels);
    let graph = nearest_features(&features, count, channels, k);
    for (cloud, features) in features.chunks_exact(count * channels).enumerate() {
        for (i, point) in features.chunks_exact(channels).enumerate() {
            let distance =
                |other: &[f32]| -> f32 { point.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum() };
            let distances: Vec<f32> = features.chunks_exact(channels).map(distance).collect();
            let mut order: Vec<u32> = (0..count as u32).collect();
            order.sort_by(|&a, &b| distances[a as usize].total_cmp(&distances[b as usize]));
            assert_eq!(graph.view(cloud).row(i), &order[..k]);
        }
    }
    // Of equal points the first come first.
    let graph = nearest_features(&[1.0; 12], 4, 3, 2);
    assert_eq!(graph.neighbors, [0, 1, 0, 1, 0, 1, 0, 1]);
    assert_eq!(nearest_features(&[1.0, 2.0], 2, 1, 9).k, 2);
}

#[test]
fn rows_give_the_same_bits_on_any_number_of_threads() {
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let mut rng = random::stream(35, 0);
            let x = leaf([8 * 300, 16], &mut rng);
            let weight = leaf([24, 16], &mut rng);
            let [scale, shift] = [24, 24].map(|length| leaf([length], &mut rng));
            let y = layers::dense(x.clone(), weight.clone(), shift.clone(), 0.2);
            let y = layers::batch_norm(y, scale.clone(), shift.clone(), 0.0).values;
            let y = layers::layer_norm(y, scale.clone(), shift.clone()).reshape([8, 300, 24]);
            let y = layers::attention(y.clone(), y.clone(), y, 2, 0.3);
            slopes(y, &[&of(&x), &of(&weight), &of(&scale), &of(&shift)])
        })
    };
    assert_eq!(run(1), run(3));
}
