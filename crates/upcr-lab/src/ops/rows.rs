//! Layers of single rows `[rows, channels]`: maps, norms and rectifiers, each in as few passes as it needs.
//!
//! Sums over rows are formed in parts of fixed size, whatever the number of threads.

use multiversion::multiversion;
use rayon::prelude::*;

use super::buffer::Buffer;
use super::graph_layer::{EPSILON, normalize};
use super::product::{Matrix, product};

/// Rows that are worked on together.
const BLOCK: usize = 256;
/// Sums of matrices over rows are formed in so many parts.
const PARTS: usize = 16;
/// What a layer norm adds to a standard deviation.
pub const DEVIATION_EPSILON: f32 = 1e-6;

/// `x` `[rows, inputs]` through the map `weight` `[outputs, inputs]`, shifted by `bias`, and a rectifier with that slope
/// for negative values (1: none).
pub fn dense(x: &[f32], weight: &[f32], bias: &[f32], slope: f32) -> Vec<f32> {
    let outputs = bias.len();
    let inputs = weight.len() / outputs;
    let mut out = vec![0.0; x.len() / inputs * outputs];
    let map = Matrix::rows(weight, inputs).transposed();
    out.par_chunks_mut(BLOCK * outputs).zip(x.par_chunks(BLOCK * inputs)).for_each(|(out, x)| {
        product([out.len() / outputs, inputs, outputs], Matrix::rows(x, inputs), map, out, false);
        shift(out, bias, slope);
    });
    out
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn shift(rows: &mut [f32], bias: &[f32], slope: f32) {
    for row in rows.chunks_exact_mut(bias.len()) {
        for (value, bias) in row.iter_mut().zip(bias) {
            let y = *value + bias;
            *value = if y > 0.0 { y } else { slope * y };
        }
    }
}

/// Gradients of `x` (empty where not wanted), weight and bias, from those of the values `out`.
pub fn dense_backward(
    x: &[f32],
    weight: &[f32],
    out: &[f32],
    slope: f32,
    grad_out: &[f32],
    outputs: usize,
    wants_x: bool,
) -> [Vec<f32>; 3] {
    let inputs = weight.len() / outputs;
    let rows = x.len() / inputs;
    let mut grad_x = vec![0.0; if wants_x { x.len() } else { 0 }];
    let rows_a_part = rows.div_ceil(PARTS).next_multiple_of(BLOCK);
    let mut parts: Vec<&mut [f32]> = if wants_x {
        grad_x.chunks_mut(rows_a_part * inputs).collect()
    } else {
        (0..rows.div_ceil(rows_a_part)).map(|_| Default::default()).collect()
    };
    let found: Vec<[Vec<f32>; 2]> = parts
        .par_iter_mut()
        .enumerate()
        .with_max_len(1)
        .map(|(part, grad_x)| {
            let (mut grad_weight, mut grad_bias) = (vec![0.0; weight.len()], vec![0.0; outputs]);
            let mut gradient = Buffer::new(BLOCK * outputs);
            let first = part * rows_a_part;
            let last = rows.min(first + rows_a_part);
            for row in (first..last).step_by(BLOCK) {
                let count = BLOCK.min(last - row);
                let of = |width: usize| row * width..(row + count) * width;
                let gradient = &mut gradient[..count * outputs];
                through_shift(&out[of(outputs)], &grad_out[of(outputs)], slope, gradient, &mut grad_bias);
                let gradient = Matrix::rows(gradient, outputs);
                if wants_x {
                    let at = (row - first) * inputs;
                    let map = Matrix::rows(weight, inputs);
                    let grad_x = &mut grad_x[at..at + count * inputs];
                    product([count, outputs, inputs], gradient, map, grad_x, false);
                }
                let x = Matrix::rows(&x[of(inputs)], inputs);
                product([outputs, count, inputs], gradient.transposed(), x, &mut grad_weight, true);
            }
            [grad_weight, grad_bias]
        })
        .collect();
    let [grad_weight, grad_bias] = ordered_sum(found);
    [grad_x, grad_weight, grad_bias]
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn through_shift(out: &[f32], grad_out: &[f32], slope: f32, gradient: &mut [f32], sums: &mut [f32]) {
    let outputs = sums.len();
    let rows = out.chunks_exact(outputs).zip(grad_out.chunks_exact(outputs));
    for (gradient, (out, grad_out)) in gradient.chunks_exact_mut(outputs).zip(rows) {
        for c in 0..outputs {
            let g = grad_out[c] * if out[c] > 0.0 { 1.0 } else { slope };
            gradient[c] = g;
            sums[c] += g;
        }
    }
}

/// Sums of parts, in their order.
fn ordered_sum<const N: usize>(parts: Vec<[Vec<f32>; N]>) -> [Vec<f32>; N] {
    let add = |mut sum: [Vec<f32>; N], part: [Vec<f32>; N]| {
        for (sum, part) in sum.iter_mut().zip(part) {
            sum.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
        }
        sum
    };
    parts.into_iter().reduce(add).unwrap_or_else(|| std::array::from_fn(|_| Vec::new()))
}

/// A batch norm as its gradients need it, by channel.
#[derive(Debug, Clone, Default)]
pub struct BatchNorm {
    /// Of the batch.
    pub mean: Vec<f32>,
    /// Of the batch, that of the population.
    pub variance: Vec<f32>,
    deviation_inverse: Vec<f32>,
    scale: Vec<f32>,
    shift: Vec<f32>,
}

/// `x` normalised by its own mean and variance, scaled by `gamma`, shifted by `beta`, and rectified.
pub fn batch_norm(x: &[f32], gamma: &[f32], beta: &[f32], slope: f32) -> (Vec<f32>, BatchNorm) {
    let channels = gamma.len();
    let blocks: Vec<[Vec<f32>; 2]> =
        x.par_chunks(BLOCK * channels).map(|x| block_moments(x, channels)).collect();
    let rows = (x.len() / channels.max(1)) as f64;
    let counts = || x.chunks(BLOCK * channels).map(|x| (x.len() / channels) as f64).zip(&blocks);
    let mut norm = BatchNorm::default();
    for c in 0..channels {
        let mean = counts().map(|(count, block)| count * f64::from(block[0][c])).sum::<f64>() / rows;
        let about = counts().map(|(count, [block_mean, squares])| {
            f64::from(squares[c]) + count * (f64::from(block_mean[c]) - mean).powi(2)
        });
        let variance = about.sum::<f64>() / rows;
        let inverse = 1.0 / (variance + EPSILON).sqrt();
        let scale = inverse * f64::from(gamma[c]);
        norm.mean.push(mean as f32);
        norm.variance.push(variance as f32);
        norm.deviation_inverse.push(inverse as f32);
        norm.scale.push(scale as f32);
        norm.shift.push((f64::from(beta[c]) - mean * scale) as f32);
    }
    let mut out = vec![0.0; x.len()];
    out.par_chunks_mut(BLOCK * channels)
        .zip(x.par_chunks(BLOCK * channels))
        .for_each(|(out, x)| normalize(x, &norm.scale, &norm.shift, slope, out));
    (out, norm)
}

/// Means of a block's channels, and their sums of squares about these.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn block_moments(x: &[f32], channels: usize) -> [Vec<f32>; 2] {
    let (mut mean, mut squares) = (vec![0.0; channels], vec![0.0; channels]);
    for row in x.chunks_exact(channels) {
        mean.iter_mut().zip(row).for_each(|(mean, x)| *mean += x);
    }
    let share = channels as f32 / x.len() as f32;
    for mean in &mut mean {
        *mean *= share;
    }
    for row in x.chunks_exact(channels) {
        for ((squares, x), mean) in squares.iter_mut().zip(row).zip(&mean) {
            *squares += (x - mean) * (x - mean);
        }
    }
    [mean, squares]
}

/// Gradients of `x`, γ and β from those of the values.
pub fn batch_norm_backward(x: &[f32], norm: &BatchNorm, slope: f32, grad_out: &[f32]) -> [Vec<f32>; 3] {
    let channels = norm.mean.len();
    let block = BLOCK * channels;
    let totals: Vec<Vec<f32>> =
        x.par_chunks(block).zip(grad_out.par_chunks(block)).map(|(x, g)| totals(x, g, norm, slope)).collect();
    let rows = (x.len() / channels.max(1)) as f64;
    let total = |at: usize| totals.iter().map(|part| f64::from(part[at])).sum::<f64>();
    // Every row's gradient has, from mean and variance, -(share + rise · x).
    let (mut grad_gamma, mut grad_beta) = (Vec::with_capacity(channels), Vec::with_capacity(channels));
    let (mut share, mut rise) = (Vec::with_capacity(channels), Vec::with_capacity(channels));
    for c in 0..channels {
        let (sum, product) = (total(c), total(channels + c));
        let (scale, inverse) = (f64::from(norm.scale[c]), f64::from(norm.deviation_inverse[c]));
        let slope = scale * inverse * inverse * product / rows;
        share.push((scale * sum / rows - slope * f64::from(norm.mean[c])) as f32);
        rise.push(slope as f32);
        grad_gamma.push((product * inverse) as f32);
        grad_beta.push(sum as f32);
    }
    let mut grad_x = vec![0.0; x.len()];
    grad_x
        .par_chunks_mut(block)
        .zip(x.par_chunks(block).zip(grad_out.par_chunks(block)))
        .for_each(|(grad_x, (x, grad_out))| through_norm(x, grad_out, norm, slope, [&share, &rise], grad_x));
    [grad_x, grad_gamma, grad_beta]
}

/// Sums of the gradients of the normalised values, and of these times the values' distances from the mean.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn totals(x: &[f32], grad_out: &[f32], norm: &BatchNorm, slope: f32) -> Vec<f32> {
    let channels = norm.mean.len();
    let mut totals = vec![0.0; 2 * channels];
    let (sums, products) = totals.split_at_mut(channels);
    let (scale, shift, mean) = (&norm.scale[..channels], &norm.shift[..channels], &norm.mean[..channels]);
    for (x, grad_out) in x.chunks_exact(channels).zip(grad_out.chunks_exact(channels)) {
        for c in 0..channels {
            let gradient = grad_out[c] * if x[c] * scale[c] + shift[c] > 0.0 { 1.0 } else { slope };
            sums[c] += gradient;
            products[c] += gradient * (x[c] - mean[c]);
        }
    }
    totals
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn through_norm(
    x: &[f32],
    grad_out: &[f32],
    norm: &BatchNorm,
    slope: f32,
    [share, rise]: [&[f32]; 2],
    grad_x: &mut [f32],
) {
    let channels = norm.mean.len();
    let (scale, shift) = (&norm.scale[..channels], &norm.shift[..channels]);
    let (share, rise) = (&share[..channels], &rise[..channels]);
    let rows = x.chunks_exact(channels).zip(grad_out.chunks_exact(channels));
    for (grad_x, (x, grad_out)) in grad_x.chunks_exact_mut(channels).zip(rows) {
        for c in 0..channels {
            let gradient = grad_out[c] * if x[c] * scale[c] + shift[c] > 0.0 { 1.0 } else { slope };
            grad_x[c] = gradient * scale[c] - (share[c] + rise[c] * x[c]);
        }
    }
}

/// Each row about its mean, by its (unbiased) standard deviation, scaled and shifted by channel.
pub fn layer_norm(x: &[f32], scale: &[f32], shift: &[f32]) -> Vec<f32> {
    let channels = scale.len();
    let mut out = vec![0.0; x.len()];
    out.par_chunks_mut(BLOCK * channels)
        .zip(x.par_chunks(BLOCK * channels))
        .for_each(|(out, x)| normalize_rows(x, scale, shift, out));
    out
}

/// A row's mean, and the standard deviation that its norm divides by, before and after what is added.
#[inline(always)]
fn row_moments(row: &[f32]) -> (f32, f32, f32) {
    let channels = row.len() as f32;
    let mean = sum(row, |_, x| x) / channels;
    let variance = sum(row, |_, x| (x - mean) * (x - mean)) / (channels - 1.0).max(1.0);
    // The square root of zero has no gradient.
    let deviation = (variance + DEVIATION_EPSILON * DEVIATION_EPSILON).sqrt();
    (mean, deviation, deviation + DEVIATION_EPSILON)
}

/// A sum over a row, in an order that vectors of any length keep; values come with their places.
#[inline(always)]
fn sum(row: &[f32], value: impl Fn(usize, f32) -> f32) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0.0; LANES];
    let whole = row.len() / LANES * LANES;
    for first in (0..whole).step_by(LANES) {
        for lane in 0..LANES {
            sums[lane] += value(first + lane, row[first + lane]);
        }
    }
    for at in whole..row.len() {
        sums[at - whole] += value(at, row[at]);
    }
    sums.iter().sum()
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn normalize_rows(x: &[f32], scale: &[f32], shift: &[f32], out: &mut [f32]) {
    let channels = scale.len();
    for (out, x) in out.chunks_exact_mut(channels).zip(x.chunks_exact(channels)) {
        let (mean, _, deviation) = row_moments(x);
        let inverse = deviation.recip();
        for (((out, x), scale), shift) in out.iter_mut().zip(x).zip(scale).zip(shift) {
            *out = (x - mean) * inverse * scale + shift;
        }
    }
}

/// Gradients of `x`, scale and shift from those of the values.
pub fn layer_norm_backward(x: &[f32], scale: &[f32], grad_out: &[f32]) -> [Vec<f32>; 3] {
    let channels = scale.len();
    let block = BLOCK * channels;
    let mut grad_x = vec![0.0; x.len()];
    let found: Vec<[Vec<f32>; 2]> = grad_x
        .par_chunks_mut(block)
        .zip(x.par_chunks(block).zip(grad_out.par_chunks(block)))
        .map(|(grad_x, (x, grad_out))| through_rows(x, grad_out, scale, grad_x))
        .collect();
    let [grad_scale, grad_shift] = ordered_sum(found);
    [grad_x, grad_scale, grad_shift]
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn through_rows(x: &[f32], grad_out: &[f32], scale: &[f32], grad_x: &mut [f32]) -> [Vec<f32>; 2] {
    let channels = scale.len();
    let (mut grad_scale, mut grad_shift) = (vec![0.0; channels], vec![0.0; channels]);
    let rows = x.chunks_exact(channels).zip(grad_out.chunks_exact(channels));
    for (grad_x, (x, grad_out)) in grad_x.chunks_exact_mut(channels).zip(rows) {
        let (mean, root, deviation) = row_moments(x);
        let inverse = deviation.recip();
        let total = sum(grad_out, |c, gradient| gradient * scale[c]);
        let along = sum(grad_out, |c, gradient| gradient * scale[c] * (x[c] - mean));
        let rise = along * inverse * inverse / ((channels as f32 - 1.0).max(1.0) * root);
        let share = total * inverse / channels as f32;
        for c in 0..channels {
            let about = x[c] - mean;
            grad_x[c] = grad_out[c] * scale[c] * inverse - share - rise * about;
            grad_scale[c] += grad_out[c] * about * inverse;
            grad_shift[c] += grad_out[c];
        }
    }
    [grad_scale, grad_shift]
}
