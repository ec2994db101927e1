//! A static k-d tree over 3-D points.

use super::{Neighbor, Neighborhoods};

/// Exact nearest-neighbour search over a fixed set of points.
///
/// Ties are broken by index, so a result never depends on the tree's shape or on the number of threads.
#[derive(Debug, Clone)]
pub struct KdTree {
    points: Vec<[f32; 3]>,
}

impl KdTree {
    /// Indexes `points` (all finite).
    pub fn new(points: &[[f32; 3]]) -> Self {
        Self { points: points.to_vec() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The nearest point within `max_distance_sq`, if any.
    pub fn nearest(&self, query: [f32; 3], max_distance_sq: f32) -> Option<Neighbor> {
        let _ = (query, max_distance_sq);
        None
    }

    /// The `k` nearest points, nearest first, into `found` (cleared first; fewer where the tree holds fewer).
    pub fn knn(&self, query: [f32; 3], k: usize, found: &mut Vec<Neighbor>) {
        let _ = (query, k);
        found.clear();
    }

    /// The nearest points with squared distance at most `radius_sq`, nearest first, at most `max` of them.
    pub fn radius(&self, query: [f32; 3], radius_sq: f32, max: usize, found: &mut Vec<Neighbor>) {
        let _ = (query, radius_sq, max);
        found.clear();
    }

    /// k-nearest lists of every indexed point (itself included), in parallel.
    pub fn knn_graph(&self, k: usize) -> Neighborhoods {
        let _ = k;
        Neighborhoods::default()
    }

    /// Radius lists of every indexed point (itself included), at most `max` each, in parallel.
    pub fn radius_graph(&self, radius: f32, max: usize) -> Neighborhoods {
        let _ = (radius, max);
        Neighborhoods::default()
    }
}
