//! Neighbour graphs of the clouds that networks see: small, and searched as a whole.

use multiversion::{multiversion, target::match_target};

use super::Graph;
use super::aligned::Aligned;
use super::kernel::{self, places};
use super::lanes::{BLOCK, Lanes, whole_tiles};
use super::layer::Features;
#[cfg(target_arch = "x86_64")]
use super::simd;

/// Points a leaf.
const LEAF: usize = 16;
/// Leaves whose boxes are looked at together.
const GROUP: usize = 16;
/// Guesses at a radius before it is halved.
const GUESSES: u32 = 8;

/// A point and its index.
type Entry = ([f32; 3], u32);

/// What a search needs room for.
#[derive(Debug, Default)]
pub(super) struct SearchRoom {
    entries: Vec<Entry>,
    leaves: Vec<Leaf>,
    boxes: Vec<Boxes>,
    /// Leaves near a point, and the squared distances of their points.
    near: Vec<u32>,
    distances_sq: Vec<[f32; LEAF]>,
    /// Of a block of features the columns, of all features their inner products with those and their squared lengths.
    panel: Aligned<Lanes>,
    inner: Aligned<Lanes>,
    squares: Vec<f32>,
    /// A row a point, as they rank.
    ranks: Vec<u64>,
}

/// Points by coordinate; infinite where there is none.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Leaf {
    position: [[f32; LEAF]; 3],
}

/// Lowest and highest corners of some leaves' bounding boxes, by coordinate; infinite where there is none.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Boxes {
    min: [[f32; GROUP]; 3],
    max: [[f32; GROUP]; 3],
}

/// Puts `points` into an order in which near ones are near each other, and finds each one's `k` nearest, itself
/// included (all where there are fewer). Rows of the graph are in no order; equal distances go by the index before.
/// `order` gets the indices before.
pub(super) fn nearest(
    points: &mut [[f32; 3]],
    k: usize,
    order: &mut Vec<u32>,
    graph: &mut Graph,
    room: &mut SearchRoom,
) {
    room.entries.clear();
    room.entries.extend(points.iter().copied().zip(0..));
    sort(&mut room.entries);
    order.clear();
    order.extend(room.entries.iter().map(|e| e.1));
    for (point, entry) in points.iter_mut().zip(&room.entries) {
        *point = entry.0;
    }
    room.leaves.clear();
    room.boxes.clear();
    for (g, group) in points.chunks(LEAF * GROUP).enumerate() {
        room.boxes.push(Boxes { min: [[f32::INFINITY; GROUP]; 3], max: [[f32::INFINITY; GROUP]; 3] });
        for (b, points) in group.chunks(LEAF).enumerate() {
            let mut leaf = Leaf { position: [[f32::INFINITY; LEAF]; 3] };
            for a in 0..3 {
                for (value, point) in leaf.position[a].iter_mut().zip(points) {
                    *value = point[a];
                }
                room.boxes[g].min[a][b] = points.iter().map(|p| p[a]).fold(f32::INFINITY, f32::min);
                room.boxes[g].max[a][b] = points.iter().map(|p| p[a]).fold(f32::NEG_INFINITY, f32::max);
            }
            room.leaves.push(leaf);
        }
    }
    graph.k = k.min(points.len());
    graph.neighbors.clear();
    fill(points, order, graph, room);
}

/// Orders points so that every leaf of them is compact, and within it every pair: halves at the median of the widest
/// coordinate, leaves and pairs full.
fn sort(entries: &mut [Entry]) {
    if entries.len() <= 2 {
        entries.sort_unstable_by_key(|e| e.1);
        return;
    }
    let extent = |a: usize| {
        let (min, max) = entries
            .iter()
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(min, max), e| (min.min(e.0[a]), max.max(e.0[a])));
        max - min
    };
    let extents = [0, 1, 2].map(extent);
    let axis = (1..3).fold(0, |widest, a| if extents[a] > extents[widest] { a } else { widest });
    let unit = if entries.len() > LEAF { LEAF } else { 2 };
    let half = entries.len().div_ceil(unit).div_ceil(2) * unit;
    entries.select_nth_unstable_by(half, |a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
    let (below, above) = entries.split_at_mut(half);
    sort(below);
    sort(above);
}

/// Fills the rows of the graph.
#[multiversion(targets("x86_64+avx512f+avx512vl+popcnt+bmi1", "x86_64+avx2+popcnt+bmi1"))]
fn fill(points: &[[f32; 3]], order: &[u32], graph: &mut Graph, room: &mut SearchRoom) {
    let at_most = |values: &[f32; 16], most: f32| -> u32 {
        match_target! {
            "x86_64+avx512f" => simd::at_most_avx512(values, most),
            "x86_64+avx2" => simd::at_most_avx2(values, most),
            _ => kernel::at_most(values, most),
        }
    };
    let SearchRoom { leaves, boxes, near, distances_sq, .. } = room;
    let k = graph.k;
    let mut last: Option<([f32; 3], f32)> = None;
    for (i, &query) in points.iter().enumerate() {
        // A ball that holds k points about the last point serves this one as well when it grows by what lies between
        // them. The slack is for rounding, relative and (underflow) absolute.
        let bound = last.map_or(f32::MAX, |(center, r_sq)| {
            let between = [0, 1, 2].map(|a| query[a] - center[a]);
            let reach = r_sq.sqrt() + (between.iter().map(|d| d * d).sum::<f32>()).sqrt();
            (reach * reach * (1.0 + 1e-5) + f32::MIN_POSITIVE).min(f32::MAX)
        });
        near.clear();
        for (start, group) in (0..).step_by(GROUP).zip(boxes.iter()) {
            near.extend(places(at_most(&group.distances_sq(query), bound)).map(|leaf| start + leaf as u32));
        }
        distances_sq.clear();
        distances_sq.extend(near.iter().map(|&leaf| leaves[leaf as usize].distances_sq(query)));
        let count = |most: f32| distances_sq.iter().map(|d| at_most(d, most).count_ones() as usize).sum();
        let radius_sq = radius_sq(count, k, bound);
        for (&leaf, distances_sq) in near.iter().zip(distances_sq.iter()) {
            let within = places(at_most(distances_sq, radius_sq));
            graph.neighbors.extend(within.map(|place| leaf * LEAF as u32 + place as u32));
        }
        let row = &mut graph.neighbors[i * k..];
        if row.len() > k {
            // Some are as far as the k-th.
            row.select_nth_unstable_by_key(k - 1, |&j| {
                let between = [0, 1, 2].map(|a| points[j as usize][a] - query[a]);
                (between.iter().map(|d| d * d).sum::<f32>().to_bits(), order[j as usize])
            });
        }
        last = (row.len() >= k).then_some((query, radius_sq));
        // Distances that overflow leave a row short.
        graph.neighbors.resize((i + 1) * k, i as u32);
    }
}

/// A radius within which `count` finds `k`, more only where several are as far as the last; `bound` where there are
/// fewer within that.
#[inline(always)]
fn radius_sq(count: impl Fn(f32) -> usize, k: usize, bound: f32) -> f32 {
    // Numbers grow as their bits do. Below `low` there are too few, up to `high` enough.
    let (mut low, mut low_count) = (0, 0);
    let (mut high, mut high_count) = (bound.to_bits(), count(bound));
    let mut step = 0;
    while high_count > k && low < high {
        // Points on a surface are about as many as their squared distance is large.
        let share = (k as f32 + 0.5 - low_count as f32) / (high_count - low_count) as f32;
        let (from, to) = (f32::from_bits(low), f32::from_bits(high));
        let middle = if step < GUESSES { (from + share * (to - from)).to_bits() } else { low.midpoint(high) };
        let middle = middle.clamp(low, high - 1);
        let found = count(f32::from_bits(middle));
        if found < k {
            (low, low_count) = (middle + 1, found);
        } else {
            (high, high_count) = (middle, found);
        }
        step += 1;
    }
    f32::from_bits(high)
}

impl Boxes {
    /// Squared distances from `query`, infinite or NaN where there is no box.
    #[inline(always)]
    fn distances_sq(&self, query: [f32; 3]) -> [f32; GROUP] {
        let mut distances_sq = [0.0; GROUP];
        for a in 0..3 {
            for b in 0..GROUP {
                let (below, above) = (self.min[a][b] - query[a], query[a] - self.max[a][b]);
                let outside = if below > above { below } else { above };
                let outside = if outside > 0.0 { outside } else { 0.0 };
                distances_sq[b] += outside * outside;
            }
        }
        distances_sq
    }
}

impl Leaf {
    /// Squared distances from `query`, infinite where there is no point.
    #[inline(always)]
    fn distances_sq(&self, query: [f32; 3]) -> [f32; LEAF] {
        let mut distances_sq = [0.0; LEAF];
        for a in 0..3 {
            for l in 0..LEAF {
                let d = self.position[a][l] - query[a];
                distances_sq[l] += d * d;
            }
        }
        distances_sq
    }
}

/// Finds the `k` points (all where there are fewer) whose first `channels` features are nearest to each point's, itself
/// included; equal distances go by `order`.
pub(super) fn nearest_features(
    features: &Features,
    channels: usize,
    k: usize,
    order: &[u32],
    graph: &mut Graph,
    room: &mut SearchRoom,
) {
    let points = order.len();
    let SearchRoom { panel, inner, squares, ranks, .. } = room;
    let row = |i: usize| &features.values[i * features.stride..][..channels];
    squares.clear();
    squares.extend((0..points).map(|i| row(i).iter().map(|v| v * v).sum::<f32>()));
    ranks.resize(points * points, 0);
    panel.resize(channels, [0.0; BLOCK]);
    inner.resize(whole_tiles(points), [0.0; BLOCK]);
    for start in (0..points).step_by(BLOCK) {
        for (c, panel) in panel.iter_mut().enumerate() {
            *panel = std::array::from_fn(|l| row((start + l).min(points - 1))[c]);
        }
        kernel::multiply(&features.values, features.stride, panel, &[0.0; BLOCK], inner);
        for (i, (ranks, inner)) in ranks.chunks_exact_mut(points).zip(inner.iter()).enumerate() {
            for (j, (rank, inner)) in (start..).zip(ranks[start..].iter_mut().zip(inner)) {
                // Rounding may put others nearer than itself.
                let distance_sq = if i == j { 0.0 } else { squares[i] + squares[j] - 2.0 * inner };
                *rank = u64::from(distance_sq.max(0.0).to_bits()) << 32 | j as u64;
            }
        }
    }
    graph.k = k.min(points);
    graph.neighbors.clear();
    for ranks in ranks.chunks_exact_mut(points.max(1)) {
        let index = |rank: u64| rank as u32;
        let rank = |rank: &u64| (rank >> 32, order[index(*rank) as usize]);
        ranks.select_nth_unstable_by_key(graph.k - 1, rank);
        graph.neighbors.extend(ranks[..graph.k].iter().map(|rank| index(*rank)));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::neighbors::KdTree;

    /// Clouds scattered, or on a coarse grid and hence full of duplicates and ties.
    fn clouds() -> impl Strategy<Value = Vec<[f32; 3]>> {
        let scattered = prop::collection::vec(prop::array::uniform3(-1.0_f32..1.0), 1..700);
        let gridded = prop::collection::vec(prop::array::uniform3((0..5_i8).prop_map(f32::from)), 1..300);
        prop_oneof![scattered, gridded]
    }

    fn sorted(mut row: Vec<u32>) -> Vec<u32> {
        row.sort_unstable();
        row
    }

    proptest! {
        #[test]
        fn the_nearest_are_those_that_the_tree_finds(cloud in clouds(), k in 1..30_usize) {
            let (mut points, mut order, mut graph) = (cloud.clone(), Vec::new(), Graph::default());
            let mut room = SearchRoom::default();
            // Room that has been used before.
            nearest(&mut [[0.5; 3]; 40], 3, &mut order, &mut graph, &mut room);
            nearest(&mut points, k, &mut order, &mut graph, &mut room);
            let truth = KdTree::new(&cloud).knn_graph(k);
            prop_assert_eq!(graph.len(), cloud.len());
            for (i, &before) in order.iter().enumerate() {
                prop_assert_eq!(points[i], cloud[before as usize]);
                let row = sorted(graph.row(i).iter().map(|&j| order[j as usize]).collect());
                let expected = truth.row(before as usize).iter().map(|n| n.index).collect();
                prop_assert_eq!(row, sorted(expected));
            }
        }

        #[test]
        fn the_nearest_features_are_those_that_a_plain_search_finds(mut cloud in clouds(), k in 1..30_usize) {
            cloud.truncate(150);
            // Coordinates of few bits: distances are exact.
            let rows: Vec<[f32; 3]> = cloud.iter().map(|p| p.map(|v| (v * 16.0).round())).collect();
            let mut features = Features::default();
            features.copy_from(rows.as_flattened(), 3);
            let order: Vec<u32> = (0..rows.len() as u32).rev().collect();
            let (mut graph, mut room) = (Graph::default(), SearchRoom::default());
            nearest_features(&features, 3, k, &order, &mut graph, &mut room);
            for i in 0..rows.len() {
                let distance_sq = |j: usize| (0..3).map(|a| (rows[i][a] - rows[j][a]).powi(2)).sum::<f32>();
                let mut expected: Vec<u32> = (0..rows.len() as u32).collect();
                expected.sort_by_key(|&j| (distance_sq(j as usize) as u32, order[j as usize]));
                expected.truncate(k);
                prop_assert_eq!(sorted(graph.row(i).to_vec()), sorted(expected));
            }
        }
    }

    #[test]
    fn distances_that_overflow_end_in_no_panic() {
        let far: Vec<[f32; 3]> = (0..50).map(|i| [1e30 * i as f32, -1e35, 3.0]).collect();
        let (mut order, mut graph) = (Vec::new(), Graph::default());
        nearest(&mut far.clone(), 8, &mut order, &mut graph, &mut SearchRoom::default());
        assert_eq!((graph.len(), graph.k), (50, 8));
        assert!(graph.neighbors.iter().all(|&j| j < 50));
    }
}
