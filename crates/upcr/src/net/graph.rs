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
