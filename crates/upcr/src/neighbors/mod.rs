//! k-nearest and radius search.

mod kdtree;
pub use kdtree::KdTree;

/// A neighbour: its index in the indexed points and its squared distance to the query.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(8))]
pub struct Neighbor {
    /// Index into the points the index was built from.
    pub index: u32,
    /// Squared Euclidean distance.
    pub distance_sq: f32,
}

impl Neighbor {
    /// Orders by distance, then by index: non-negative floats order as their bits do.
    #[inline(always)]
    pub(crate) fn rank(self) -> u64 {
        u64::from(self.distance_sq.to_bits()) << 32 | u64::from(self.index)
    }
}

/// The neighbour lists of many points, one after the other (compressed rows).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Neighborhoods {
    /// Row `i` is `neighbors[offsets[i]..offsets[i + 1]]`; one more entry than rows.
    pub offsets: Vec<u32>,
    /// All rows' neighbours, nearest first within a row; equal distances by index.
    pub neighbors: Vec<Neighbor>,
}

impl Neighborhoods {
    /// Number of rows.
    pub fn len(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Neighbours of point `i`, nearest first, the point itself included.
    pub fn row(&self, i: usize) -> &[Neighbor] {
        &self.neighbors[self.offsets[i] as usize..self.offsets[i + 1] as usize]
    }
}
