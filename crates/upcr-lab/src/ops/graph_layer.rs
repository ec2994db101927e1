//! A graph layer (equation 2) without an edge tensor.
//!
//! For the edge from point i to its neighbour j the layer has v = Wᵀ[Fᵢ ; Fⱼ - Fᵢ], batch norm over the edges, a leaky
//! rectifier, and the maximum over j. With W = [W₁ ; W₂], v = Aᵢ + Bⱼ where A = F(W₁ - W₂) and B = F·W₂: two products a
//! *point*. What follows them rises with v (falls, where the norm's scale γ is negative: W's sign is turned there), so
//! the maximum is Aᵢ + maxⱼ Bⱼ, and the edges' mean and variance are sums over the graph of what points have.

use multiversion::multiversion;
use rayon::prelude::*;

use super::batch::{BatchGraph, CloudGraph};
use super::buffer::Buffer;
use super::product::{Matrix, product};

/// Added to variances (as PyTorch and burn do by default).
pub const EPSILON: f64 = 1e-5;
/// Sums over clouds are formed in so many parts, whatever the number of threads.
const PARTS: usize = 16;

/// Parameters of a layer from `inputs` to `outputs` channels.
#[derive(Debug, Clone, Copy)]
pub struct Parameters<'a> {
    /// `[2 · inputs, outputs]`, row by row: first what multiplies Fᵢ, then what multiplies Fⱼ - Fᵢ.
    pub weight: &'a [f32],
    /// Scale of the batch norm.
    pub gamma: &'a [f32],
    /// Shift of the batch norm.
    pub beta: &'a [f32],
    /// Slope of the leaky rectifier for negative values.
    pub negative_slope: f32,
}

/// Mean and variance of a layer's values v over all edges, by channel.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EdgeStatistics {
    /// Mean.
    pub mean: Vec<f32>,
    /// Variance (of the population).
    pub variance: Vec<f32>,
}

/// What the gradients need of the values.
#[derive(Debug, Default)]
pub struct Kept {
    /// [A | B] of every row, signs turned.
    products: Buffer<f32>,
    /// Aᵢ + maxⱼ Bⱼ.
    largest: Buffer<f32>,
    /// Σⱼ v of every row.
    sums: Buffer<f32>,
    /// The neighbour, by its place in the row, that has the maximum.
    winners: Buffer<u8>,
    /// [W₁ - W₂ | W₂] with signs turned, `[inputs, 2 · outputs]`.
    folded: Vec<f32>,
    norm: Norm,
}

/// Gradients of a layer.
#[derive(Debug, Default)]
pub struct Gradients {
    /// With respect to the input features; empty where they were not wanted.
    pub features: Vec<f32>,
    /// With respect to the weight.
    pub weight: Vec<f32>,
    /// With respect to γ.
    pub gamma: Vec<f32>,
    /// With respect to β.
    pub beta: Vec<f32>,
}

/// Batch norm as one multiplication and one addition a value, for values with signs turned.
#[derive(Debug, Default)]
pub(super) struct Norm {
    pub mean: Vec<f32>,
    pub deviation_inverse: Vec<f32>,
    pub scale: Vec<f32>,
    pub shift: Vec<f32>,
    pub signs: Vec<f32>,
}

impl Norm {
    /// From the statistics of the values with signs turned.
    pub fn new(mean: &[f64], variance: &[f64], parameters: &Parameters) -> Self {
        let deviation_inverse: Vec<f64> =
            variance.iter().map(|v| 1.0 / (v.max(0.0) + EPSILON).sqrt()).collect();
        let scale: Vec<f64> =
            deviation_inverse.iter().zip(parameters.gamma).map(|(d, g)| d * f64::from(g.abs())).collect();
        let shift = (0..scale.len()).map(|c| (f64::from(parameters.beta[c]) - mean[c] * scale[c]) as f32);
        Self {
            shift: shift.collect(),
            mean: mean.iter().map(|&m| m as f32).collect(),
            deviation_inverse: deviation_inverse.iter().map(|&d| d as f32).collect(),
            scale: scale.iter().map(|&s| s as f32).collect(),
            signs: signs(parameters.gamma),
        }
    }

    /// Normalises and rectifies `values`, rows of as many values as there are channels.
    pub fn apply(&self, values: &[f32], negative_slope: f32, out: &mut [f32]) {
        let channels = self.scale.len();
        let rows = out.par_chunks_mut(64 * channels).zip(values.par_chunks(64 * channels));
        rows.for_each(|(out, values)| normalize(values, &self.scale, &self.shift, negative_slope, out));
    }
}

/// -1 where γ is negative, else 1.
pub(super) fn signs(gamma: &[f32]) -> Vec<f32> {
    gamma.iter().map(|&g| if g < 0.0 { -1.0 } else { 1.0 }).collect()
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn normalize(values: &[f32], scale: &[f32], shift: &[f32], negative_slope: f32, out: &mut [f32]) {
    let channels = scale.len();
    for (out, values) in out.chunks_exact_mut(channels).zip(values.chunks_exact(channels)) {
        for (((out, value), scale), shift) in out.iter_mut().zip(values).zip(scale).zip(shift) {
            let y = value * scale + shift;
            *out = if y > 0.0 { y } else { negative_slope * y };
        }
    }
}

/// The layer's values: `features` is `[rows, inputs]`, the result `[rows, outputs]`.
pub fn forward(
    features: &[f32],
    parameters: &Parameters,
    graph: &BatchGraph,
) -> (Vec<f32>, EdgeStatistics, Kept) {
    let outputs = parameters.gamma.len();
    let mut kept = Kept {
        products: Buffer::new(graph.rows() * 2 * outputs),
        largest: Buffer::new(graph.rows() * outputs),
        sums: Buffer::new(graph.rows() * outputs),
        winners: Buffer::new(graph.rows() * outputs),
        folded: fold(parameters),
        norm: Norm::default(),
    };
    let folded = &kept.folded;
    let totals: Vec<Vec<f32>> = graph
        .split_mut(&mut kept.products, 2 * outputs)
        .into_par_iter()
        .zip(graph.split_mut(&mut kept.largest, outputs))
        .zip(graph.split_mut(&mut kept.sums, outputs))
        .zip(graph.split_mut(&mut kept.winners, outputs))
        .enumerate()
        .with_max_len(1)
        .map(|(cloud, (((products, largest), sums), winners))| {
            point_products(features, graph, cloud, folded, products);
            let mut totals = vec![0.0; 2 * outputs];
            gather(&graph.view(cloud), products, largest, sums, winners, &mut totals);
            totals
        })
        .collect();
    let (mean, variance) = moments(&totals, graph.edges());
    let signs = signs(parameters.gamma);
    let statistics = EdgeStatistics {
        mean: mean.iter().zip(&signs).map(|(&m, s)| m as f32 * s).collect(),
        variance: variance.iter().map(|&v| v as f32).collect(),
    };
    kept.norm = Norm::new(&mean, &variance, parameters);
    let mut out = vec![0.0; graph.rows() * outputs];
    kept.norm.apply(&kept.largest, parameters.negative_slope, &mut out);
    (out, statistics, kept)
}

/// The layer's values with given statistics in place of the batch's.
pub fn forward_with(
    features: &[f32],
    parameters: &Parameters,
    statistics: &EdgeStatistics,
    graph: &BatchGraph,
) -> Vec<f32> {
    let outputs = parameters.gamma.len();
    let folded = fold(parameters);
    let signs = signs(parameters.gamma);
    let mean: Vec<f64> = statistics.mean.iter().zip(&signs).map(|(m, s)| f64::from(m * s)).collect();
    let variance: Vec<f64> = statistics.variance.iter().map(|&v| f64::from(v)).collect();
    let norm = Norm::new(&mean, &variance, parameters);
    let mut out = vec![0.0; graph.rows() * outputs];
    let clouds = graph.split_mut(&mut out, outputs);
    clouds.into_par_iter().enumerate().with_max_len(1).for_each(|(cloud, out)| {
        let rows = graph.cloud(cloud).len();
        let mut products = Buffer::new(rows * 2 * outputs);
        point_products(features, graph, cloud, &folded, &mut products);
        let mut largest = Buffer::new(rows * outputs);
        let (mut sums, mut winners) = (Buffer::new(rows * outputs), Buffer::new(rows * outputs));
        gather(
            &graph.view(cloud),
            &products,
            &mut largest,
            &mut sums,
            &mut winners,
            &mut vec![0.0; 2 * outputs],
        );
        normalize(&largest, &norm.scale, &norm.shift, parameters.negative_slope, out);
    });
    out
}

/// Gradients from those of the layer's values `out`.
pub fn backward(
    features: &[f32],
    parameters: &Parameters,
    graph: &BatchGraph,
    kept: &Kept,
    grad_out: &[f32],
    wants_features: bool,
) -> Gradients {
    let outputs = parameters.gamma.len();
    let inputs = parameters.weight.len() / (2 * outputs);
    let norm = &kept.norm;
    let mut winning = Buffer::new(graph.rows() * outputs);
    let totals: Vec<Vec<f32>> = graph
        .split_mut(&mut winning, outputs)
        .into_par_iter()
        .enumerate()
        .with_max_len(1)
        .map(|(cloud, winning)| {
            let rows = graph.cloud(cloud);
            let values = rows.start * outputs..rows.end * outputs;
            let mut totals = vec![0.0; 2 * outputs];
            let slope = parameters.negative_slope;
            through_rectifier(
                &kept.largest[values.clone()],
                &grad_out[values],
                norm,
                slope,
                winning,
                &mut totals,
            );
            totals
        })
        .collect();
    let totals = ordered_sum(&totals);
    let edges = graph.edges() as f64;
    // Every edge's gradient has, from the norm's mean and variance, -(share + slope · v).
    let slope: Vec<f32> = (0..outputs)
        .map(|c| {
            let inverse = f64::from(norm.deviation_inverse[c]);
            (f64::from(norm.scale[c]) * inverse * inverse * totals[outputs + c] / edges) as f32
        })
        .collect();
    let share: Vec<f32> = (0..outputs)
        .map(|c| (f64::from(norm.scale[c]) * totals[c] / edges) as f32 - slope[c] * norm.mean[c])
        .collect();

    let mut grad_features = vec![0.0; if wants_features { graph.rows() * inputs } else { 0 }];
    let parts = if wants_features { graph.split_mut(&mut grad_features, inputs) } else { Vec::new() };
    let mut parts: Vec<Option<&mut [f32]>> = parts.into_iter().map(Some).collect();
    parts.resize_with(graph.clouds(), || None);
    let clouds_a_part = graph.clouds().div_ceil(PARTS).max(1);
    let grad_folded: Vec<Vec<f32>> = parts
        .par_chunks_mut(clouds_a_part)
        .enumerate()
        .map(|(part, clouds)| {
            let mut grad_folded = vec![0.0; inputs * 2 * outputs];
            for (cloud, grad_features) in clouds.iter_mut().enumerate() {
                let cloud = part * clouds_a_part + cloud;
                let rows = graph.cloud(cloud);
                let of = |width: usize| rows.start * width..rows.end * width;
                let mut grad_products = Buffer::new(rows.len() * 2 * outputs);
                scatter(
                    &graph.view(cloud),
                    &kept.products[of(2 * outputs)],
                    &kept.sums[of(outputs)],
                    &kept.winners[of(outputs)],
                    &winning[of(outputs)],
                    &share,
                    &slope,
                    &mut grad_products,
                );
                let gradient = Matrix::rows(&grad_products, 2 * outputs);
                if let Some(grad_features) = grad_features {
                    let folded = Matrix::rows(&kept.folded, 2 * outputs).transposed();
                    product([rows.len(), 2 * outputs, inputs], gradient, folded, grad_features, false);
                }
                let features = Matrix::rows(&features[of(inputs)], inputs).transposed();
                product([inputs, rows.len(), 2 * outputs], features, gradient, &mut grad_folded, true);
            }
            grad_folded
        })
        .collect();
    let mut folded = grad_folded.into_iter();
    let mut total = folded.next().unwrap_or_default();
    for part in folded {
        total.iter_mut().zip(&part).for_each(|(t, p)| *t += p);
    }
    let mut weight = vec![0.0; 2 * inputs * outputs];
    let (own, difference) = weight.split_at_mut(inputs * outputs);
    for ((own, difference), grad) in own
        .chunks_exact_mut(outputs)
        .zip(difference.chunks_exact_mut(outputs))
        .zip(total.chunks_exact(2 * outputs))
    {
        for c in 0..outputs {
            own[c] = grad[c] * norm.signs[c];
            difference[c] = (grad[outputs + c] - grad[c]) * norm.signs[c];
        }
    }
    let gamma = (0..outputs)
        .map(|c| (totals[outputs + c] * f64::from(norm.deviation_inverse[c])) as f32 * norm.signs[c])
        .collect();
    Gradients {
        features: grad_features,
        weight,
        gamma,
        beta: totals[..outputs].iter().map(|&t| t as f32).collect(),
    }
}

/// [W₁ - W₂ | W₂] with the signs of negative scales turned, `[inputs, 2 · outputs]`.
fn fold(parameters: &Parameters) -> Vec<f32> {
    let outputs = parameters.gamma.len();
    let signs = signs(parameters.gamma);
    let (own, difference) = parameters.weight.split_at(parameters.weight.len() / 2);
    let mut folded = vec![0.0; parameters.weight.len()];
    for ((folded, own), difference) in folded
        .chunks_exact_mut(2 * outputs)
        .zip(own.chunks_exact(outputs))
        .zip(difference.chunks_exact(outputs))
    {
        for c in 0..outputs {
            folded[c] = (own[c] - difference[c]) * signs[c];
            folded[outputs + c] = difference[c] * signs[c];
        }
    }
    folded
}

/// [A | B] of a cloud.
fn point_products(features: &[f32], graph: &BatchGraph, cloud: usize, folded: &[f32], products: &mut [f32]) {
    let rows = graph.cloud(cloud);
    let inputs = features.len() / graph.rows();
    let width = folded.len() / inputs;
    let features = Matrix::rows(&features[rows.start * inputs..rows.end * inputs], inputs);
    product([rows.len(), inputs, width], features, Matrix::rows(folded, width), products, false);
}

/// Sums of all clouds, in their order.
pub(super) fn ordered_sum(parts: &[Vec<f32>]) -> Vec<f64> {
    let mut total = vec![0.0; parts.first().map_or(0, Vec::len)];
    for part in parts {
        total.iter_mut().zip(part).for_each(|(t, &p)| *t += f64::from(p));
    }
    total
}

/// Mean and variance from the clouds' sums of values and of squares.
fn moments(totals: &[Vec<f32>], edges: usize) -> (Vec<f64>, Vec<f64>) {
    let totals = ordered_sum(totals);
    let (sums, squares) = totals.split_at(totals.len() / 2);
    let mean: Vec<f64> = sums.iter().map(|s| s / edges as f64).collect();
    let variance = squares.iter().zip(&mean).map(|(q, m)| q / edges as f64 - m * m).collect();
    (mean, variance)
}

/// For a cloud's [A | B]: the largest v of every row, its place, and Σ v; `totals` are Σ v and Σ v² over all edges.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn gather(
    graph: &CloudGraph,
    products: &[f32],
    largest: &mut [f32],
    sums: &mut [f32],
    winners: &mut [u8],
    totals: &mut [f32],
) {
    let outputs = totals.len() / 2;
    let mut first = 0;
    while first + 32 <= outputs {
        gather_block::<32>(graph, products, first, largest, sums, winners, totals);
        first += 32;
    }
    while first + 16 <= outputs {
        gather_block::<16>(graph, products, first, largest, sums, winners, totals);
        first += 16;
    }
    while first + 8 <= outputs {
        gather_block::<8>(graph, products, first, largest, sums, winners, totals);
        first += 8;
    }
    while first < outputs {
        gather_block::<1>(graph, products, first, largest, sums, winners, totals);
        first += 1;
    }
}

/// The `N` values from `at` on.
#[inline(always)]
fn lanes<const N: usize>(values: &[f32], at: usize) -> &[f32; N] {
    match values[at..].first_chunk() {
        Some(lanes) => lanes,
        None => &[0.0; N],
    }
}

#[inline(always)]
fn gather_block<const N: usize>(
    graph: &CloudGraph,
    products: &[f32],
    first: usize,
    largest: &mut [f32],
    sums: &mut [f32],
    winners: &mut [u8],
    totals: &mut [f32],
) {
    let outputs = totals.len() / 2;
    let width = 2 * outputs;
    let k = graph.k as f32;
    let (mut total, mut total_sq) = ([0.0; N], [0.0; N]);
    for i in 0..graph.rows() {
        let mut best = [f32::NEG_INFINITY; N];
        let mut winner = [0_i32; N];
        let mut sum = [0.0; N];
        for (place, &j) in (0_i32..).zip(graph.row(i)) {
            let b = lanes::<N>(products, j as usize * width + outputs + first);
            // New arrays: written in place, `best` would go through memory and be five times slower.
            let (mut next_best, mut next_winner) = ([0.0; N], [0; N]);
            for c in 0..N {
                let larger = b[c] > best[c];
                next_best[c] = if larger { b[c] } else { best[c] };
                next_winner[c] = if larger { place } else { winner[c] };
                sum[c] += b[c];
            }
            (best, winner) = (next_best, next_winner);
        }
        let a = lanes::<N>(products, i * width + first);
        let b = lanes::<N>(products, i * width + outputs + first);
        let uses = graph.sources(i).len() as f32;
        let at = i * outputs + first;
        for c in 0..N {
            let edge_sum = k * a[c] + sum[c];
            total[c] += edge_sum;
            // Σⱼ (Aᵢ + Bⱼ)² = Aᵢ (Σⱼ v + Σⱼ Bⱼ) + Σⱼ Bⱼ², the last counted where the neighbour stands.
            total_sq[c] += a[c] * (edge_sum + sum[c]) + uses * b[c] * b[c];
            largest[at + c] = a[c] + best[c];
            sums[at + c] = edge_sum;
            winners[at + c] = winner[c] as u8;
        }
    }
    totals[first..first + N].copy_from_slice(&total);
    totals[outputs + first..outputs + first + N].copy_from_slice(&total_sq);
}

/// Gradients of a cloud's largest values, back through rectifier and norm's scale; `totals` are the sums, over the
/// cloud, of the gradients of the normalised values, and of these times the values' distances from the mean.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
pub(super) fn through_rectifier(
    largest: &[f32],
    grad_out: &[f32],
    norm: &Norm,
    negative_slope: f32,
    winning: &mut [f32],
    totals: &mut [f32],
) {
    let outputs = norm.scale.len();
    let mut first = 0;
    while first + 16 <= outputs {
        rectifier_block::<16>(largest, grad_out, norm, negative_slope, first, winning, totals);
        first += 16;
    }
    while first < outputs {
        rectifier_block::<1>(largest, grad_out, norm, negative_slope, first, winning, totals);
        first += 1;
    }
}

#[inline(always)]
fn rectifier_block<const N: usize>(
    largest: &[f32],
    grad_out: &[f32],
    norm: &Norm,
    negative_slope: f32,
    first: usize,
    winning: &mut [f32],
    totals: &mut [f32],
) {
    let outputs = norm.scale.len();
    let (scale, shift) = (*lanes::<N>(&norm.scale, first), *lanes::<N>(&norm.shift, first));
    let mean = *lanes::<N>(&norm.mean, first);
    let (mut sums, mut products) = ([0.0; N], [0.0; N]);
    for (i, winning) in winning.chunks_exact_mut(outputs).enumerate() {
        let value = lanes::<N>(largest, i * outputs + first);
        let grad_out = lanes::<N>(grad_out, i * outputs + first);
        let Some(winning) = winning[first..].first_chunk_mut::<N>() else { continue };
        for c in 0..N {
            let positive = value[c] * scale[c] + shift[c] > 0.0;
            let gradient = grad_out[c] * if positive { 1.0 } else { negative_slope };
            sums[c] += gradient;
            products[c] += gradient * (value[c] - mean[c]);
            winning[c] = gradient * scale[c];
        }
    }
    totals[first..first + N].copy_from_slice(&sums);
    totals[outputs + first..outputs + first + N].copy_from_slice(&products);
}

/// Gradients of a cloud's [A | B]: to the winner what its maximum is worth, to every edge -(share + slope · v).
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
#[allow(clippy::too_many_arguments)] // slices of one cloud and one layer
fn scatter(
    graph: &CloudGraph,
    products: &[f32],
    sums: &[f32],
    winners: &[u8],
    winning: &[f32],
    share: &[f32],
    slope: &[f32],
    grad_products: &mut [f32],
) {
    let outputs = share.len();
    let mut first = 0;
    while first + 32 <= outputs {
        spread_block::<32>(graph, products, first, share, slope, grad_products);
        first += 32;
    }
    while first + 16 <= outputs {
        spread_block::<16>(graph, products, first, share, slope, grad_products);
        first += 16;
    }
    while first + 8 <= outputs {
        spread_block::<8>(graph, products, first, share, slope, grad_products);
        first += 8;
    }
    while first < outputs {
        spread_block::<1>(graph, products, first, share, slope, grad_products);
        first += 1;
    }
    let k = graph.k as f32;
    // Where the rows of B of a point's neighbours start; a place among the neighbours is a byte.
    let mut starts = [0_usize; 256];
    for i in 0..graph.rows() {
        let at = i * outputs..(i + 1) * outputs;
        let (sums, winning, winners) = (&sums[at.clone()], &winning[at.clone()], &winners[at]);
        let own = &mut grad_products[i * 2 * outputs..i * 2 * outputs + outputs];
        for c in 0..outputs {
            own[c] = winning[c] - k * share[c] - slope[c] * sums[c];
        }
        for (start, &j) in starts.iter_mut().zip(graph.row(i)) {
            *start = j as usize * 2 * outputs + outputs;
        }
        for (c, (&winner, gradient)) in winners.iter().zip(winning).enumerate() {
            grad_products[starts[winner as usize] + c] += gradient;
        }
    }
}

/// The share of B's gradient that comes from the norm's mean and variance.
#[inline(always)]
fn spread_block<const N: usize>(
    graph: &CloudGraph,
    products: &[f32],
    first: usize,
    share: &[f32],
    slope: &[f32],
    grad_products: &mut [f32],
) {
    let outputs = share.len();
    let width = 2 * outputs;
    let (share, slope) = (*lanes::<N>(share, first), *lanes::<N>(slope, first));
    for j in 0..graph.rows() {
        let sources = graph.sources(j);
        let mut sum = [0.0; N];
        for &i in sources {
            let a = lanes::<N>(products, i as usize * width + first);
            for c in 0..N {
                sum[c] += a[c];
            }
        }
        let uses = sources.len() as f32;
        let at = j * width + outputs + first;
        let b = lanes::<N>(products, at);
        for c in 0..N {
            let edge_sum = uses * b[c] + sum[c];
            grad_products[at + c] = -(uses * share[c]) - slope[c] * edge_sum;
        }
    }
}
