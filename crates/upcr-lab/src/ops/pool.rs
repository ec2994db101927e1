//! The maximum over all points of a cloud (f in the paper), or over groups of rows, channel by channel.

use multiversion::multiversion;
use rayon::prelude::*;

/// Rows that are worth a thread's while.
const MANY: usize = 256;

/// Values `[clouds, channels]` and the rows they come from. Cloud `c` has the rows `offsets[c]..offsets[c + 1]`, at
/// least one.
pub fn forward(features: &[f32], channels: usize, offsets: &[usize]) -> (Vec<f32>, Vec<u32>) {
    let clouds = offsets.len() - 1;
    let (mut largest, mut winners) = (vec![f32::NEG_INFINITY; clouds * channels], vec![0; clouds * channels]);
    largest
        .par_chunks_mut(channels)
        .zip(winners.par_chunks_mut(channels))
        .zip(offsets.par_windows(2))
        .for_each(|((largest, winners), rows)| {
            for row in rows[0]..rows[1] {
                let values = &features[row * channels..(row + 1) * channels];
                for c in 0..channels {
                    let larger = values[c] > largest[c];
                    largest[c] = if larger { values[c] } else { largest[c] };
                    winners[c] = if larger { row as u32 } else { winners[c] };
                }
            }
        });
    (largest, winners)
}

/// Gradients of the `rows` × `channels` features.
pub fn backward(grad_out: &[f32], winners: &[u32], channels: usize, rows: usize) -> Vec<f32> {
    let mut grad_features = vec![0.0; rows * channels];
    for (at, (&row, gradient)) in winners.iter().zip(grad_out).enumerate() {
        grad_features[row as usize * channels + at % channels] += gradient;
    }
    grad_features
}

/// The largest values `[groups, channels]` of groups of `size` rows, one after the other, and the rows in their groups
/// that have them.
pub fn groups(features: &[f32], channels: usize, size: usize) -> (Vec<f32>, Vec<u32>) {
    let count = features.len() / (channels * size);
    let (mut found, mut winners) = (vec![0.0; count * channels], vec![0; count * channels]);
    found
        .par_chunks_mut(channels)
        .zip(winners.par_chunks_mut(channels))
        .zip(features.par_chunks(size * channels))
        .with_min_len(MANY.div_ceil(size))
        .for_each(|((found, winners), features)| group(features, found, winners));
    (found, winners)
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2"))]
fn group(features: &[f32], found: &mut [f32], winners: &mut [u32]) {
    let channels = found.len();
    found.copy_from_slice(&features[..channels]);
    for (row, values) in features.chunks_exact(channels).enumerate().skip(1) {
        for ((found, winner), value) in found.iter_mut().zip(winners.iter_mut()).zip(values) {
            let larger = value > found;
            *found = if larger { *value } else { *found };
            *winner = if larger { row as u32 } else { *winner };
        }
    }
}

/// Gradients of the features from those of their groups' largest values.
pub fn groups_backward(grad_out: &[f32], winners: &[u32], channels: usize, size: usize) -> Vec<f32> {
    let mut grad_features = vec![0.0; grad_out.len() * size];
    grad_features
        .par_chunks_mut(size * channels)
        .zip(grad_out.par_chunks(channels).zip(winners.par_chunks(channels)))
        .with_min_len(MANY.div_ceil(size))
        .for_each(|(grad_features, (grad_out, winners))| {
            for (c, (gradient, &winner)) in grad_out.iter().zip(winners).enumerate() {
                grad_features[winner as usize * channels + c] = *gradient;
            }
        });
    grad_features
}
