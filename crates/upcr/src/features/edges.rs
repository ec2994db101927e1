//! Features that are a few values for every edge from a point to a neighbour.

use rayon::prelude::*;

use super::{Descriptors, FeatureInput, IsOver};
use crate::neighbors::Neighbor;

/// Calls `edge` with every point and each of its neighbours, and puts the values in a row a point, neighbour
/// after neighbour. A row with fewer neighbours than the longest repeats its last.
pub(super) fn per_edge<const N: usize>(
    input: &FeatureInput,
    is_over: IsOver,
    edge: impl Fn(usize, &Neighbor) -> [f32; N] + Sync,
) -> Descriptors {
    let rows = 0..input.neighborhoods.len();
    let k = rows.map(|i| input.neighborhoods.row(i).len()).max().unwrap_or(0);
    let dim = N * k;
    let mut values = vec![0.0; dim * input.points.len()];
    if dim > 0 {
        values.par_chunks_mut(dim).enumerate().for_each(|(i, row)| {
            let neighbors = input.neighborhoods.row(i);
            let Some(last) = neighbors.last() else { return };
            if is_over() {
                return;
            }
            let padded = neighbors.iter().chain(std::iter::repeat(last));
            for (values, neighbor) in row.chunks_exact_mut(N).zip(padded) {
                values.copy_from_slice(&edge(i, neighbor));
            }
        });
    }
    Descriptors { dim, values }
}
