//! The maximum over all points of a cloud, channel by channel (f in the paper).

use rayon::prelude::*;

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
