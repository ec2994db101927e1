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

/// A graph's rows two by two: what neighbours bring is looked up once for two points that share them. Where near points
/// follow each other, gathering takes a third less time.
#[derive(Debug, Default)]
pub(super) struct PairedRows {
    /// Neighbours a point.
    k: usize,
    /// 2k places a pair: what both rows hold, what the first holds alone; at the end what the second holds alone.
    neighbors: Vec<u32>,
    /// How many of each a pair has.
    counts: Vec<[usize; 3]>,
    /// Scratch: the last pair whose first row held a point, and not the second.
    held_by: Vec<usize>,
}

impl PairedRows {
    /// The rows of `graph`.
    pub fn fill(&mut self, graph: &Graph) {
        const NONE: usize = usize::MAX;
        let k = graph.k;
        self.k = k;
        self.counts.clear();
        self.neighbors.resize(graph.len().next_multiple_of(2) * k, 0);
        self.held_by.clear();
        self.held_by.resize(graph.len(), NONE);
        let held_by = &mut self.held_by;
        let rows = graph.neighbors.chunks(2 * k.max(1));
        for (pair, (rows, places)) in rows.zip(self.neighbors.chunks_exact_mut(2 * k.max(1))).enumerate() {
            let (first, second) = rows.split_at(k);
            for &j in first {
                held_by[j as usize] = pair;
            }
            // Written in any case, counted where it belongs: there is no branch to guess.
            let [mut both, mut firsts, mut seconds] = [0; 3];
            for &j in second {
                let held = &mut held_by[j as usize];
                let shared = *held == pair;
                *held = if shared { NONE } else { *held };
                places[both] = j;
                places[2 * k - 1 - seconds] = j;
                both += usize::from(shared);
                seconds += usize::from(!shared);
            }
            for &j in first {
                places[both + firsts] = j;
                firsts += usize::from(held_by[j as usize] == pair);
            }
            self.counts.push([both, firsts, seconds]);
        }
    }

    /// What both rows of a pair hold, what the first holds alone, what the second.
    #[inline(always)]
    pub fn pairs(&self) -> impl Iterator<Item = [&[u32]; 3]> {
        let places = self.neighbors.chunks_exact(2 * self.k.max(1));
        places.zip(&self.counts).map(|(places, &[both, firsts, seconds])| {
            let first = &places[both..][..firsts];
            [&places[..both], first, &places[places.len() - seconds..]]
        })
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn paired_rows_hold_what_the_rows_hold(
            points in 1..40_usize,
            k in 1..9_usize,
            draws in proptest::collection::vec(any::<u32>(), 40 * 9),
        ) {
            let neighbors = draws[..points * k].iter().map(|d| d % points as u32).collect();
            let graph = Graph { k, neighbors };
            let mut paired = PairedRows::default();
            // One of another size before.
            paired.fill(&Graph { k: 2, neighbors: vec![0, 1, 1, 0, 2, 1] });
            paired.fill(&graph);
            let set = |lists: &[&[u32]]| {
                lists.concat().into_iter().collect::<std::collections::BTreeSet<u32>>()
            };
            prop_assert_eq!(paired.pairs().count(), points.div_ceil(2));
            for (pair, [both, first, second]) in paired.pairs().enumerate() {
                prop_assert_eq!(set(&[both, first]), set(&[graph.row(2 * pair)]));
                if 2 * pair + 1 < points {
                    prop_assert_eq!(set(&[both, second]), set(&[graph.row(2 * pair + 1)]));
                } else {
                    prop_assert!(both.is_empty() && second.is_empty());
                }
            }
        }
    }
}
