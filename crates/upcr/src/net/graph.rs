//! The neighbour graph over which a network's layers look.

use crate::neighbors::Neighborhoods;

/// The K nearest neighbours of every point of one cloud, itself included.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Graph {
    /// Neighbours a point.
    pub k: usize,
    /// Row after row of `k` indices into the cloud, nearest first.
    pub neighbors: Vec<u32>,
}

impl Graph {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.neighbors.len().checked_div(self.k).unwrap_or(0)
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.neighbors.is_empty()
    }

    /// The `min(k, n)` nearest of every one of n rows of `channels` features, the row itself included; equally near ones
    /// by index.
    pub fn of_features(features: &[f32], channels: usize, k: usize) -> Self {
        let rows = || features.chunks_exact(channels.max(1));
        let k = k.min(rows().len());
        let mut neighbors = Vec::with_capacity(k * rows().len());
        let mut ranked = Vec::new();
        for own in rows() {
            ranked.clear();
            ranked.extend((0_u32..).zip(rows()).map(|(index, other)| {
                let distance_sq: f32 = own.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum();
                // Non-negative floats order as their bits do.
                u64::from(distance_sq.to_bits()) << 32 | u64::from(index)
            }));
            if k < ranked.len() {
                ranked.select_nth_unstable(k);
                ranked.truncate(k);
            }
            ranked.sort_unstable();
            neighbors.extend(ranked.iter().map(|&rank| rank as u32));
        }
        Self { k, neighbors }
    }

    /// Neighbours of point `i`, nearest first.
    pub fn row(&self, i: usize) -> &[u32] {
        &self.neighbors[i * self.k..(i + 1) * self.k]
    }

    /// Every point's neighbours.
    #[inline(always)]
    pub(super) fn rows(&self) -> std::slice::ChunksExact<'_, u32> {
        self.neighbors.chunks_exact(self.k.max(1))
    }
}

/// A k-nearest search gives rows of one length.
impl From<&Neighborhoods> for Graph {
    fn from(neighborhoods: &Neighborhoods) -> Self {
        let points = neighborhoods.len();
        let k = neighborhoods.neighbors.len().checked_div(points).unwrap_or(0);
        Self { k, neighbors: neighborhoods.neighbors.iter().map(|neighbor| neighbor.index).collect() }
    }
}
