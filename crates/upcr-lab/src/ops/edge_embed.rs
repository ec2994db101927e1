//! The pose-invariant branch's first step (equation 4): a point-wise map of the edge feature φ, batch norm over the
//! edges, a leaky rectifier, and the maximum over a point's neighbours.
//!
//! φ is data, so the mean and variance of v = Wᵀφ over the edges come from φ's own first two moments.

use multiversion::multiversion;
use rayon::prelude::*;
use upcr::net::InvariantInputs;

use super::batch::BatchGraph;
use super::buffer::Buffer;
use super::graph_layer::{EdgeStatistics, Norm, Parameters, ordered_sum, signs, through_rectifier};
use super::product::{Matrix, product};

/// φ over the edges of a batch, with its moments.
#[derive(Debug, Clone, Default)]
pub struct EdgeInputs {
    /// Values an edge, then values that its neighbour brings.
    pub phi: InvariantInputs,
    /// Σ φ over all edges.
    sums: Vec<f64>,
    /// Σ φ φᵀ over all edges, row by row.
    products: Vec<f64>,
}

/// What the gradients need of the values.
#[derive(Debug, Default)]
pub struct Kept {
    largest: Buffer<f32>,
    winners: Buffer<u8>,
    /// The weight with signs turned.
    turned: Vec<f32>,
    norm: Norm,
}

/// Gradients of the parameters.
#[derive(Debug, Default)]
pub struct Gradients {
    /// With respect to the weight.
    pub weight: Vec<f32>,
    /// With respect to γ.
    pub gamma: Vec<f32>,
    /// With respect to β.
    pub beta: Vec<f32>,
}

impl EdgeInputs {
    /// Joins φ of single clouds, padding clouds of fewer than `graph.k` points as [`BatchGraph::new`] does.
    pub fn new<'a>(clouds: impl IntoIterator<Item = &'a InvariantInputs>, graph: &BatchGraph) -> Self {
        let mut phi = InvariantInputs::default();
        for (cloud, inputs) in clouds.into_iter().enumerate() {
            (phi.edge_dim, phi.point_dim) = (inputs.edge_dim, inputs.point_dim);
            phi.points.extend_from_slice(&inputs.points);
            let rows = graph.cloud(cloud).len();
            let row = inputs.edges.len() / rows.max(1);
            if row == graph.k * inputs.edge_dim {
                phi.edges.extend_from_slice(&inputs.edges);
                continue;
            }
            for row in inputs.edges.chunks_exact(row.max(1)) {
                let padding = row.chunks_exact(inputs.edge_dim).last().into_iter().cycle();
                let edges = row.chunks_exact(inputs.edge_dim).chain(padding).take(graph.k);
                edges.for_each(|edge| phi.edges.extend_from_slice(edge));
            }
        }
        let (sums, products) = moments(&phi, graph);
        Self { phi, sums, products }
    }

    /// Values of φ.
    pub fn dim(&self) -> usize {
        self.phi.edge_dim + self.phi.point_dim
    }
}

/// Σ φ and Σ φ φᵀ over all edges.
fn moments(phi: &InvariantInputs, graph: &BatchGraph) -> (Vec<f64>, Vec<f64>) {
    let (edge_dim, point_dim) = (phi.edge_dim, phi.point_dim);
    let dim = edge_dim + point_dim;
    let clouds: Vec<Vec<f64>> = (0..graph.clouds())
        .into_par_iter()
        .map(|cloud| {
            let rows = graph.cloud(cloud);
            let view = graph.view(cloud);
            let (mut sums, mut products) = (vec![0.0_f64; dim], vec![0.0_f64; dim * dim]);
            // Σ over the edges into a point of the edges' own values.
            let mut incoming = vec![0.0_f64; rows.len() * edge_dim];
            for (edge, &j) in view.neighbors.iter().enumerate() {
                let at = (rows.start * graph.k + edge) * edge_dim;
                let values = &phi.edges[at..at + edge_dim];
                for (a, &x) in values.iter().enumerate() {
                    let x = f64::from(x);
                    sums[a] += x;
                    incoming[j as usize * edge_dim + a] += x;
                    for (b, &y) in values[..=a].iter().enumerate() {
                        products[a * dim + b] += x * f64::from(y);
                    }
                }
            }
            for j in 0..rows.len() * usize::from(point_dim > 0) {
                let values = &phi.points[(rows.start + j) * point_dim..][..point_dim];
                let uses = view.sources(j).len() as f64;
                for (a, &x) in values.iter().enumerate().filter(|(_, x)| **x != 0.0) {
                    let (row, x) = (edge_dim + a, f64::from(x));
                    sums[row] += uses * x;
                    for (b, incoming) in incoming[j * edge_dim..][..edge_dim].iter().enumerate() {
                        products[row * dim + b] += x * incoming;
                    }
                    for (b, &y) in values[..=a].iter().enumerate() {
                        products[row * dim + edge_dim + b] += uses * x * f64::from(y);
                    }
                }
            }
            sums.extend(products);
            sums
        })
        .collect();
    let mut sums = vec![0.0; dim + dim * dim];
    for cloud in &clouds {
        sums.iter_mut().zip(cloud).for_each(|(t, c)| *t += c);
    }
    let mut products = sums.split_off(dim);
    for a in 0..dim {
        for b in 0..a {
            products[b * dim + a] = products[a * dim + b];
        }
    }
    (sums, products)
}

/// The values, `[rows, outputs]`. The weight is `[dim, outputs]`.
pub fn forward(
    inputs: &EdgeInputs,
    parameters: &Parameters,
    graph: &BatchGraph,
) -> (Vec<f32>, EdgeStatistics, Kept) {
    let (outputs, dim) = (parameters.gamma.len(), inputs.dim());
    let turned = turn(parameters);
    let edges = graph.edges() as f64;
    let (mut mean, mut variance) = (vec![0.0; outputs], vec![0.0; outputs]);
    for c in 0..outputs {
        let w = |a: usize| f64::from(turned[a * outputs + c]);
        mean[c] = (0..dim).map(|a| w(a) * inputs.sums[a]).sum::<f64>() / edges;
        let row = |a: usize| (0..dim).map(|b| w(b) * inputs.products[a * dim + b]).sum::<f64>();
        variance[c] = (0..dim).map(|a| w(a) * row(a)).sum::<f64>() / edges - mean[c] * mean[c];
    }
    let statistics = EdgeStatistics {
        mean: mean.iter().zip(signs(parameters.gamma)).map(|(&m, s)| m as f32 * s).collect(),
        variance: variance.iter().map(|&v| v as f32).collect(),
    };
    let norm = Norm::new(&mean, &variance, parameters);
    let (largest, winners) = gathered(inputs, &turned, outputs, graph);
    let mut out = vec![0.0; graph.rows() * outputs];
    norm.apply(&largest, parameters.negative_slope, &mut out);
    (out, statistics, Kept { largest, winners, turned, norm })
}

/// The values with given statistics in place of the batch's.
pub fn forward_with(
    inputs: &EdgeInputs,
    parameters: &Parameters,
    statistics: &EdgeStatistics,
    graph: &BatchGraph,
) -> Vec<f32> {
    let outputs = parameters.gamma.len();
    let mean: Vec<f64> =
        statistics.mean.iter().zip(signs(parameters.gamma)).map(|(m, s)| f64::from(m * s)).collect();
    let variance: Vec<f64> = statistics.variance.iter().map(|&v| f64::from(v)).collect();
    let norm = Norm::new(&mean, &variance, parameters);
    let (largest, _) = gathered(inputs, &turn(parameters), outputs, graph);
    let mut out = vec![0.0; graph.rows() * outputs];
    norm.apply(&largest, parameters.negative_slope, &mut out);
    out
}

/// Gradients from those of the values `out`.
pub fn backward(
    inputs: &EdgeInputs,
    parameters: &Parameters,
    graph: &BatchGraph,
    kept: &Kept,
    grad_out: &[f32],
) -> Gradients {
    let (outputs, dim) = (parameters.gamma.len(), inputs.dim());
    let (edge_dim, point_dim) = (inputs.phi.edge_dim, inputs.phi.point_dim);
    let norm = &kept.norm;
    // By cloud: the sums of `through_rectifier`, then the weight's gradient from the winners.
    let clouds: Vec<Vec<f32>> = (0..graph.clouds())
        .into_par_iter()
        .with_max_len(1)
        .map(|cloud| {
            let rows = graph.cloud(cloud);
            let of = |width: usize| rows.start * width..rows.end * width;
            let mut found = vec![0.0; (2 + dim) * outputs];
            let (totals, weight) = found.split_at_mut(2 * outputs);
            let mut winning = Buffer::new(rows.len() * outputs);
            let (largest, grad_out) = (&kept.largest[of(outputs)], &grad_out[of(outputs)]);
            through_rectifier(largest, grad_out, norm, parameters.negative_slope, &mut winning, totals);
            let winners = &kept.winners[of(outputs)];
            let (edge_weight, point_weight) = weight.split_at_mut(edge_dim * outputs);
            for (i, (winning, winners)) in
                winning.chunks_exact(outputs).zip(winners.chunks_exact(outputs)).enumerate()
            {
                let row = &inputs.phi.edges[(rows.start + i) * graph.k * edge_dim..];
                for a in 0..edge_dim {
                    let weight = &mut edge_weight[a * outputs..(a + 1) * outputs];
                    for c in 0..outputs {
                        weight[c] += winning[c] * row[winners[c] as usize * edge_dim + a];
                    }
                }
            }
            if point_dim > 0 {
                let view = graph.view(cloud);
                let mut by_neighbor = vec![0.0; rows.len() * outputs];
                for (i, (winning, winners)) in
                    winning.chunks_exact(outputs).zip(winners.chunks_exact(outputs)).enumerate()
                {
                    let row = view.row(i);
                    for c in 0..outputs {
                        by_neighbor[row[winners[c] as usize] as usize * outputs + c] += winning[c];
                    }
                }
                let points = Matrix::rows(&inputs.phi.points[of(point_dim)], point_dim).transposed();
                let sizes = [point_dim, rows.len(), outputs];
                product(sizes, points, Matrix::rows(&by_neighbor, outputs), point_weight, false);
            }
            found
        })
        .collect();
    let totals = ordered_sum(&clouds);
    let edges = graph.edges() as f64;
    let mut weight = vec![0.0; dim * outputs];
    for c in 0..outputs {
        let (scale, inverse) = (f64::from(norm.scale[c]), f64::from(norm.deviation_inverse[c]));
        // As in a graph layer, every edge's gradient has -(share + slope · v) from the norm.
        let slope = scale * inverse * inverse * totals[outputs + c] / edges;
        let share = scale * totals[c] / edges - slope * f64::from(norm.mean[c]);
        for a in 0..dim {
            let product = (0..dim)
                .map(|b| inputs.products[a * dim + b] * f64::from(kept.turned[b * outputs + c]))
                .sum::<f64>();
            let gradient = totals[(2 + a) * outputs + c] - share * inputs.sums[a] - slope * product;
            weight[a * outputs + c] = gradient as f32 * norm.signs[c];
        }
    }
    let gamma = (0..outputs)
        .map(|c| (totals[outputs + c] * f64::from(norm.deviation_inverse[c])) as f32 * norm.signs[c])
        .collect();
    Gradients { weight, gamma, beta: totals[..outputs].iter().map(|&t| t as f32).collect() }
}

/// The weight with the signs of negative scales turned.
fn turn(parameters: &Parameters) -> Vec<f32> {
    let signs = signs(parameters.gamma);
    parameters.weight.iter().zip(signs.iter().cycle()).map(|(w, s)| w * s).collect()
}

/// The largest v over every row's edges, and its place.
fn gathered(
    inputs: &EdgeInputs,
    turned: &[f32],
    outputs: usize,
    graph: &BatchGraph,
) -> (Buffer<f32>, Buffer<u8>) {
    let (edge_dim, point_dim) = (inputs.phi.edge_dim, inputs.phi.point_dim);
    let values = graph.rows() * outputs;
    let (mut largest, mut winners) = (Buffer::new(values), Buffer::new(values));
    graph
        .split_mut(&mut largest, outputs)
        .into_par_iter()
        .zip(graph.split_mut(&mut winners, outputs))
        .enumerate()
        .with_max_len(1)
        .for_each(|(cloud, (largest, winners))| {
            let rows = graph.cloud(cloud);
            let (edge_weight, point_weight) = turned.split_at(edge_dim * outputs);
            let mut by_neighbor = vec![0.0; rows.len() * outputs];
            if point_dim > 0 {
                let points = &inputs.phi.points[rows.start * point_dim..rows.end * point_dim];
                let (points, weight) = (Matrix::rows(points, point_dim), Matrix::rows(point_weight, outputs));
                product([rows.len(), point_dim, outputs], points, weight, &mut by_neighbor, false);
            }
            let edges = &inputs.phi.edges[rows.start * graph.k * edge_dim..rows.end * graph.k * edge_dim];
            gather(graph.view(cloud).neighbors, graph.k, edges, edge_weight, &by_neighbor, largest, winners);
        });
    (largest, winners)
}

/// For a cloud: the largest over the edges of every row of W·(edge's values) + (neighbour's row), and its place.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn gather(
    neighbors: &[u32],
    k: usize,
    edges: &[f32],
    weight: &[f32],
    by_neighbor: &[f32],
    largest: &mut [f32],
    winners: &mut [u8],
) {
    const N: usize = 16;
    let rows = neighbors.len() / k;
    let outputs = largest.len() / rows.max(1);
    let edge_dim = weight.len() / outputs.max(1);
    for first in (0..outputs).step_by(N) {
        let lanes = N.min(outputs - first);
        for i in 0..rows {
            let (mut best, mut winner) = ([f32::NEG_INFINITY; N], [0_i32; N]);
            for (place, &j) in (0_i32..).zip(&neighbors[i * k..(i + 1) * k]) {
                let mut v = [0.0; N];
                let b = &by_neighbor[j as usize * outputs + first..];
                match b.first_chunk() {
                    Some(b) => v = *b,
                    None => v[..lanes].copy_from_slice(&b[..lanes]),
                }
                let edge = &edges[(i * k + place as usize) * edge_dim..][..edge_dim];
                for (a, &x) in edge.iter().enumerate() {
                    let w = &weight[a * outputs + first..];
                    if let Some(w) = w.first_chunk::<N>() {
                        for c in 0..N {
                            v[c] += x * w[c];
                        }
                    } else {
                        v.iter_mut().zip(w).for_each(|(v, w)| *v += x * w);
                    }
                }
                let (mut next_best, mut next_winner) = ([0.0; N], [0; N]);
                for c in 0..N {
                    let larger = v[c] > best[c];
                    next_best[c] = if larger { v[c] } else { best[c] };
                    next_winner[c] = if larger { place } else { winner[c] };
                }
                (best, winner) = (next_best, next_winner);
            }
            let at = i * outputs + first;
            largest[at..at + lanes].copy_from_slice(&best[..lanes]);
            winners[at..at + lanes].iter_mut().zip(winner).for_each(|(w, place)| *w = place as u8);
        }
    }
}
