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
use super::product::{Matrix, product, product_with_stride};

/// Added to variances (as PyTorch and burn do by default).
pub const EPSILON: f64 = 1e-5;
/// Values between two rows of [A | B]. Channels are worked on in blocks, over all rows: rows a power of two apart would
/// share few places in the cache.
const GAP: usize = 16;
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
    /// Aᵢ + maxⱼ Bⱼ of every row, signs turned.
    largest: Buffer<f32>,
    /// Σ v over the edges that leave a row, and over those that come to it.
    leaving: Buffer<f32>,
    coming: Buffer<f32>,
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
pub(super) fn normalize(values: &[f32], scale: &[f32], shift: &[f32], negative_slope: f32, out: &mut [f32]) {
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
        largest: Buffer::new(graph.rows() * outputs),
        leaving: Buffer::new(graph.rows() * outputs),
        coming: Buffer::new(graph.rows() * outputs),
        winners: Buffer::new(graph.rows() * outputs),
        folded: fold(parameters),
        norm: Norm::default(),
    };
    let folded = &kept.folded;
    let totals: Vec<Vec<f32>> = graph
        .split_mut(&mut kept.largest, outputs)
        .into_par_iter()
        .zip(graph.split_mut(&mut kept.leaving, outputs))
        .zip(graph.split_mut(&mut kept.coming, outputs))
        .zip(graph.split_mut(&mut kept.winners, outputs))
        .enumerate()
        .with_max_len(1)
        .map(|(cloud, (((largest, leaving), coming), winners))| {
            let mut totals = vec![0.0; 2 * outputs];
            let gathered = Gathered { largest, leaving, coming, winners, totals: &mut totals };
            gather(&graph.view(cloud), &point_products(features, graph, cloud, folded), gathered);
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
        let products = point_products(features, graph, cloud, &folded);
        let mut largest = Buffer::new(out.len());
        gather_largest(&graph.view(cloud), &products, outputs, &mut largest);
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
                let mut grad_products = Buffer::new(rows.len() * stride(outputs));
                spread(
                    &graph.view(cloud),
                    [&kept.leaving[of(outputs)], &kept.coming[of(outputs)]],
                    [&share, &slope],
                    &mut grad_products,
                );
                let (winners, winning) = (&kept.winners[of(outputs)], &winning[of(outputs)]);
                award(&graph.view(cloud), winners, winning, outputs, &mut grad_products);
                let gradient = Matrix::rows(&grad_products, stride(outputs));
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

/// From a row of [A | B] to the next.
#[inline(always)]
fn stride(outputs: usize) -> usize {
    2 * outputs + GAP
}

/// [A | B] of a cloud.
fn point_products(features: &[f32], graph: &BatchGraph, cloud: usize, folded: &[f32]) -> Buffer<f32> {
    let rows = graph.cloud(cloud);
    let inputs = features.len() / graph.rows();
    let width = folded.len() / inputs;
    let features = Matrix::rows(&features[rows.start * inputs..rows.end * inputs], inputs);
    let mut products = Buffer::new(rows.len() * stride(width / 2));
    let sizes = [rows.len(), inputs, width];
    product_with_stride(
        sizes,
        features,
        Matrix::rows(folded, width),
        &mut products,
        stride(width / 2),
        false,
    );
    products
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

/// Places for what is gathered over a cloud's edges.
struct Gathered<'a> {
    largest: &'a mut [f32],
    leaving: &'a mut [f32],
    coming: &'a mut [f32],
    winners: &'a mut [u8],
    /// Σ v and Σ v² over all edges.
    totals: &'a mut [f32],
}

/// Gathers over the edges of a cloud with the products [A | B].
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn gather(graph: &CloudGraph, products: &[f32], mut gathered: Gathered) {
    let outputs = gathered.totals.len() / 2;
    let mut first = 0;
    while first + 32 <= outputs {
        gather_block::<32>(graph, products, first, &mut gathered);
        first += 32;
    }
    while first + 16 <= outputs {
        gather_block::<16>(graph, products, first, &mut gathered);
        first += 16;
    }
    while first + 8 <= outputs {
        gather_block::<8>(graph, products, first, &mut gathered);
        first += 8;
    }
    while first < outputs {
        gather_block::<1>(graph, products, first, &mut gathered);
        first += 1;
    }
}

/// The largest values alone.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn gather_largest(graph: &CloudGraph, products: &[f32], outputs: usize, largest: &mut [f32]) {
    let mut first = 0;
    while first + 16 <= outputs {
        largest_block::<16>(graph, products, outputs, first, largest);
        first += 16;
    }
    while first < outputs {
        largest_block::<1>(graph, products, outputs, first, largest);
        first += 1;
    }
}

#[inline(always)]
fn largest_block<const N: usize>(
    graph: &CloudGraph,
    products: &[f32],
    outputs: usize,
    first: usize,
    largest: &mut [f32],
) {
    for i in 0..graph.rows() {
        let mut best = [f32::NEG_INFINITY; N];
        for &j in graph.row(i) {
            let b = lanes::<N>(products, j as usize * stride(outputs) + outputs + first);
            let mut next = [0.0; N];
            for c in 0..N {
                next[c] = if b[c] > best[c] { b[c] } else { best[c] };
            }
            best = next;
        }
        store(add(lanes(products, i * stride(outputs) + first), best), largest, i * outputs + first);
    }
}

/// The `N` values from `at` on.
#[inline(always)]
fn lanes<const N: usize>(values: &[f32], at: usize) -> [f32; N] {
    values[at..].first_chunk().copied().unwrap_or([0.0; N])
}

/// Writes the `N` values from `at` on.
#[inline(always)]
fn store<const N: usize, T: Copy>(lanes: [T; N], values: &mut [T], at: usize) {
    if let Some(place) = values[at..].first_chunk_mut() {
        *place = lanes;
    }
}

/// New arrays throughout: what is written in place goes through memory and is several times slower.
#[inline(always)]
fn add<const N: usize>(a: [f32; N], b: [f32; N]) -> [f32; N] {
    let mut sum = [0.0; N];
    for c in 0..N {
        sum[c] = a[c] + b[c];
    }
    sum
}

#[inline(always)]
fn gather_block<const N: usize>(graph: &CloudGraph, products: &[f32], first: usize, gathered: &mut Gathered) {
    let outputs = gathered.totals.len() / 2;
    let width = stride(outputs);
    let k = graph.k as f32;
    let (mut total, mut total_sq) = ([0.0; N], [0.0; N]);
    for i in 0..graph.rows() {
        let (mut best, mut winner, mut sum) = ([f32::NEG_INFINITY; N], [0_i32; N], [0.0; N]);
        for (place, &j) in (0_i32..).zip(graph.row(i)) {
            let b = lanes::<N>(products, j as usize * width + outputs + first);
            let (mut next_best, mut next_winner) = ([0.0; N], [0; N]);
            for c in 0..N {
                let larger = b[c] > best[c];
                next_best[c] = if larger { b[c] } else { best[c] };
                next_winner[c] = if larger { place } else { winner[c] };
            }
            (best, winner, sum) = (next_best, next_winner, add(sum, b));
        }
        let sources = graph.sources(i);
        let mut from = [0.0; N];
        for &i in sources {
            from = add(from, lanes(products, i as usize * width + first));
        }
        let uses = sources.len() as f32;
        let a = lanes::<N>(products, i * width + first);
        let b = lanes::<N>(products, i * width + outputs + first);
        let (mut leaving, mut coming) = ([0.0; N], [0.0; N]);
        let (mut squares, mut places) = ([0.0; N], [0_u8; N]);
        for c in 0..N {
            leaving[c] = k * a[c] + sum[c];
            coming[c] = uses * b[c] + from[c];
            // Σⱼ (Aᵢ + Bⱼ)² = Aᵢ (Σⱼ v + Σⱼ Bⱼ) + Σⱼ Bⱼ², the last counted where the neighbour stands.
            squares[c] = a[c] * (leaving[c] + sum[c]) + uses * b[c] * b[c];
            places[c] = winner[c] as u8;
        }
        (total, total_sq) = (add(total, leaving), add(total_sq, squares));
        let at = i * outputs + first;
        store(add(a, best), gathered.largest, at);
        store(leaving, gathered.leaving, at);
        store(coming, gathered.coming, at);
        store(places, gathered.winners, at);
    }
    store(total, gathered.totals, first);
    store(total_sq, gathered.totals, outputs + first);
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
    let (sums, products) = totals.split_at_mut(outputs);
    let rows = largest.chunks_exact(outputs).zip(grad_out.chunks_exact(outputs));
    for (winning, (largest, grad_out)) in winning.chunks_exact_mut(outputs).zip(rows) {
        let (scale, shift, mean) = (&norm.scale[..outputs], &norm.shift[..outputs], &norm.mean[..outputs]);
        for c in 0..outputs {
            let positive = largest[c] * scale[c] + shift[c] > 0.0;
            let gradient = grad_out[c] * if positive { 1.0 } else { negative_slope };
            sums[c] += gradient;
            products[c] += gradient * (largest[c] - mean[c]);
            winning[c] = gradient * scale[c];
        }
    }
}

/// What every edge's gradient has from the norm, -(share + slope · v), summed for A and B of a cloud's rows.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn spread(
    graph: &CloudGraph,
    [leaving, coming]: [&[f32]; 2],
    [share, slope]: [&[f32]; 2],
    grad_products: &mut [f32],
) {
    let outputs = share.len();
    for (j, row) in grad_products.chunks_exact_mut(stride(outputs)).enumerate() {
        let (own, other) = row[..2 * outputs].split_at_mut(outputs);
        let sums = j * outputs..(j + 1) * outputs;
        for (grad, sums, edges) in
            [(own, &leaving[sums.clone()], graph.k), (other, &coming[sums], graph.sources(j).len())]
        {
            for (((grad, sum), share), slope) in grad.iter_mut().zip(sums).zip(share).zip(slope) {
                *grad = -(edges as f32 * share) - slope * sum;
            }
        }
    }
}

/// Adds the gradients of a cloud's largest values, where A and the winner's B take part.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn award(graph: &CloudGraph, winners: &[u8], winning: &[f32], outputs: usize, grad_products: &mut [f32]) {
    // Where the rows of B of a point's neighbours start; a place among the neighbours is a byte.
    let mut starts = [0_usize; 256];
    for i in 0..graph.rows() {
        for (start, &j) in starts.iter_mut().zip(graph.row(i)) {
            *start = j as usize * stride(outputs) + outputs;
        }
        let at = i * outputs;
        let own = &mut grad_products[i * stride(outputs)..][..outputs];
        own.iter_mut().zip(&winning[at..]).for_each(|(own, winning)| *own += winning);
        for first in (0..outputs).step_by(16) {
            let range = at + first..at + outputs.min(first + 16);
            let (winning, winners) = (&winning[range.clone()], &winners[range]);
            // Behind a maximum over all points, most points have nothing to give.
            if winning.iter().fold(0, |bits, w| bits | w.to_bits()) << 1 == 0 {
                continue;
            }
            for (c, (&winner, gradient)) in (first..).zip(winners.iter().zip(winning)) {
                grad_products[starts[winner as usize] + c] += gradient;
            }
        }
    }
}
