//! Scaled dot-product attention (Vaswani et al., 2017) without a tensor of all points' shares in each other.
//!
//! The queries of one head are worked on in blocks: their likenesses to all keys stay in the cache. On the way back they
//! are formed again, which costs less than to keep them.

use multiversion::multiversion;
use rayon::prelude::*;

use super::buffer::Buffer;
use super::product::{Matrix, product, product_with_stride};

/// Queries that are worked on together.
const BLOCK: usize = 256;
/// Sums over a row are formed in so many parts, whatever the instruction set.
const LANES: usize = 16;

/// Sizes of an attention.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// Independent attentions.
    pub batch: usize,
    /// Points that ask, each.
    pub queries: usize,
    /// Points that are asked, each.
    pub keys: usize,
    /// Channels by which points are alike, of all heads.
    pub channels: usize,
    /// Channels of what is found, of all heads.
    pub values: usize,
    /// Heads, each with its part of the channels.
    pub heads: usize,
    /// By which likenesses are multiplied.
    pub scale: f32,
}

/// Queries `[batch, queries, channels]`, keys `[batch, keys, channels]`, values `[batch, keys, values]`.
pub type Inputs<'a> = [&'a [f32]; 3];

impl Shape {
    /// Lengths of one attention's queries, keys and values.
    fn lengths(&self) -> [usize; 3] {
        [self.queries * self.channels, self.keys * self.channels, self.keys * self.values]
    }

    /// One attention's part of the inputs.
    fn part<'a>(&self, inputs: Inputs<'a>, batch: usize) -> Inputs<'a> {
        let lengths = self.lengths();
        std::array::from_fn(|i| &inputs[i][batch * lengths[i]..(batch + 1) * lengths[i]])
    }

    /// Channels of a head.
    fn widths(&self) -> [usize; 2] {
        [self.channels / self.heads, self.values / self.heads]
    }

    fn blocks(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let queries = self.queries;
        (0..queries).step_by(BLOCK).map(move |first| (first, BLOCK.min(queries - first)))
    }

    /// Likenesses of a block of queries to all keys, not scaled.
    fn likenesses(
        &self,
        [queries, keys, _]: Inputs,
        head: usize,
        (first, rows): (usize, usize),
        out: &mut [f32],
    ) {
        let [width, _] = self.widths();
        let queries = Matrix::rows(&queries[first * self.channels + head * width..], self.channels);
        let keys = Matrix::rows(&keys[head * width..], self.channels).transposed();
        product([rows, width, self.keys], queries, keys, out, false);
    }
}

/// What each query finds, `[batch, queries, values]`, and the logarithm of its sum of exponentials by head: those of a
/// block of queries one head after the other.
pub fn forward(inputs: Inputs, shape: &Shape) -> (Vec<f32>, Vec<f32>) {
    let mut out = vec![0.0; shape.batch * shape.queries * shape.values];
    let mut logarithms = vec![0.0; shape.batch * shape.heads * shape.queries];
    let [_, width] = shape.widths();
    let attend = |inputs: Inputs, block: usize, out: &mut [f32], logarithms: &mut [f32]| {
        let rows = out.len() / shape.values;
        let mut shares = Buffer::new(rows * shape.keys);
        for (head, logarithms) in logarithms.chunks_exact_mut(rows).enumerate() {
            shape.likenesses(inputs, head, (block * BLOCK, rows), &mut shares);
            softmax(&mut shares, shape.scale, logarithms);
            let values = Matrix::rows(&inputs[2][head * width..], shape.values);
            let sizes = [rows, shape.keys, width];
            let shares = Matrix::rows(&shares, shape.keys);
            product_with_stride(sizes, shares, values, &mut out[head * width..], shape.values, false);
        }
    };
    out.par_chunks_mut(shape.queries * shape.values)
        .zip(logarithms.par_chunks_mut(shape.heads * shape.queries))
        .enumerate()
        .with_max_len(1)
        .for_each(|(batch, (out, logarithms))| {
            let inputs = shape.part(inputs, batch);
            out.par_chunks_mut(BLOCK * shape.values)
                .zip(logarithms.par_chunks_mut(BLOCK * shape.heads))
                .enumerate()
                .with_max_len(1)
                .for_each(|(block, (out, logarithms))| attend(inputs, block, out, logarithms));
        });
    (out, logarithms)
}

/// Gradients of queries, keys and values from those of what `forward` gave.
pub fn backward(
    inputs: Inputs,
    shape: &Shape,
    out: &[f32],
    logarithms: &[f32],
    grad_out: &[f32],
) -> [Vec<f32>; 3] {
    let lengths = shape.lengths();
    let mut found = lengths.map(|length| vec![0.0; shape.batch * length]);
    let [grad_queries, grad_keys, grad_values] = &mut found;
    let [width, value_width] = shape.widths();
    grad_queries
        .par_chunks_mut(lengths[0])
        .zip(grad_keys.par_chunks_mut(lengths[1]))
        .zip(grad_values.par_chunks_mut(lengths[2]))
        .enumerate()
        .with_max_len(1)
        .for_each(|(batch, ((grad_queries, grad_keys), grad_values))| {
            let inputs = shape.part(inputs, batch);
            let [queries, keys, values] = inputs;
            let outputs = batch * shape.queries * shape.values..(batch + 1) * shape.queries * shape.values;
            let (out, grad_out) = (&out[outputs.clone()], &grad_out[outputs]);
            let logarithms = &logarithms[batch * shape.heads * shape.queries..];
            let mut shares = Buffer::new(BLOCK.min(shape.queries) * shape.keys);
            let mut grads = Buffer::new(BLOCK.min(shape.queries) * shape.keys);
            for head in 0..shape.heads {
                let (at, value_at) = (head * width, head * value_width);
                for (first, rows) in shape.blocks() {
                    let shares = &mut shares[..rows * shape.keys];
                    let grads = &mut grads[..rows * shape.keys];
                    shape.likenesses(inputs, head, (first, rows), shares);
                    let row = first * shape.values + value_at;
                    let grad_out = Matrix::rows(&grad_out[row..], shape.values);
                    let values = Matrix::rows(&values[value_at..], shape.values).transposed();
                    product([rows, value_width, shape.keys], grad_out, values, grads, false);
                    let logarithms = &logarithms[first * shape.heads + head * rows..][..rows];
                    let found = Found { out: &out[row..], grad_out: grad_out.values, stride: shape.values };
                    through_softmax(shares, grads, shape.scale, logarithms, &found, value_width);
                    let (shares, grads) = (Matrix::rows(shares, shape.keys), Matrix::rows(grads, shape.keys));
                    let again = first > 0;
                    let columns = shape.channels;
                    product_with_stride(
                        [shape.keys, rows, value_width],
                        shares.transposed(),
                        grad_out,
                        &mut grad_values[value_at..],
                        shape.values,
                        again,
                    );
                    product_with_stride(
                        [shape.keys, rows, width],
                        grads.transposed(),
                        Matrix::rows(&queries[first * columns + at..], columns),
                        &mut grad_keys[at..],
                        columns,
                        again,
                    );
                    product_with_stride(
                        [rows, shape.keys, width],
                        grads,
                        Matrix::rows(&keys[at..], columns),
                        &mut grad_queries[first * columns + at..],
                        columns,
                        false,
                    );
                }
            }
        });
    found
}

/// Likenesses, a row for each of `logarithms`, become shares, which are 1 in sum.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2+fma"))]
fn softmax(rows: &mut [f32], scale: f32, logarithms: &mut [f32]) {
    let keys = rows.len() / logarithms.len();
    for (row, logarithm) in rows.chunks_exact_mut(keys).zip(logarithms) {
        let largest = lanes(row, f32::NEG_INFINITY, |value| value * scale, f32::max);
        for value in row.iter_mut() {
            *value = exponential(*value * scale - largest);
        }
        let sum = lanes(row, 0.0, |value| value, |a, b| a + b);
        let inverse = sum.recip();
        for value in row {
            *value *= inverse;
        }
        *logarithm = largest + sum.ln();
    }
}

/// What queries found, and its gradients, rows `stride` values apart.
struct Found<'a> {
    out: &'a [f32],
    grad_out: &'a [f32],
    stride: usize,
}

/// Likenesses become shares, and gradients of shares those of likenesses.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2+fma"))]
fn through_softmax(
    rows: &mut [f32],
    grads: &mut [f32],
    scale: f32,
    logarithms: &[f32],
    found: &Found,
    width: usize,
) {
    let keys = rows.len() / logarithms.len();
    let both = rows.chunks_exact_mut(keys).zip(grads.chunks_exact_mut(keys)).zip(logarithms);
    for (i, ((row, grads), logarithm)) in both.enumerate() {
        let at = i * found.stride..i * found.stride + width;
        let products = found.out[at.clone()].iter().zip(&found.grad_out[at]);
        let mean: f32 = products.map(|(value, gradient)| value * gradient).sum();
        for (share, gradient) in row.iter_mut().zip(grads) {
            *share = exponential(*share * scale - logarithm);
            *gradient = *share * (*gradient - mean) * scale;
        }
    }
}

/// Joins the values of a row, in an order that vectors of any length keep.
#[inline(always)]
fn lanes(row: &[f32], start: f32, value: impl Fn(f32) -> f32, join: impl Fn(f32, f32) -> f32) -> f32 {
    let mut joined = [start; LANES];
    let mut chunks = row.chunks_exact(LANES);
    for chunk in &mut chunks {
        for (joined, &v) in joined.iter_mut().zip(chunk) {
            *joined = join(*joined, value(v));
        }
    }
    for (joined, &v) in joined.iter_mut().zip(chunks.remainder()) {
        *joined = join(*joined, value(v));
    }
    joined.into_iter().fold(start, join)
}

/// eˣ, to one part in a million; 0 where it is smaller than a normal number.
#[inline(always)]
fn exponential(x: f32) -> f32 {
    /// Added to a number and taken off again, it leaves the nearest whole one.
    const WHOLE: f32 = 12_582_912.0;
    /// ln 2, and what single precision leaves of it.
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    let clamped = x.clamp(-87.0, 88.0);
    let shifted = clamped * std::f32::consts::LOG2_E + WHOLE;
    let whole = shifted - WHOLE;
    let rest = clamped - whole * LN_2[0] - whole * LN_2[1];
    let mut series = 1.0 / 720.0;
    for factor in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        series = series * rest + factor;
    }
    // The last bits of the shifted number are the whole one.
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0_f32.to_bits()));
    if x < -87.0 { 0.0 } else { series * power }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_as_exact_as_their_type_allows() {
        for i in -86_000..88_000 {
            let x = i as f32 * 1e-3;
            let expected = f64::from(x).exp();
            assert!((f64::from(exponential(x)) - expected).abs() < 5e-7 * expected, "{x}");
        }
        assert_eq!([exponential(-100.0), exponential(f32::NEG_INFINITY), exponential(0.0)], [0.0, 0.0, 1.0]);
    }
}
