//! A static k-d tree over 3-D points.

use multiversion::multiversion;
use rayon::prelude::*;

use super::{Neighbor, Neighborhoods};
use crate::watch::IsOver;

/// Points a leaf. All leaves but the last are full.
const LEAF: usize = 16;
/// Leaves below which a subtree is built on one thread.
const SEQUENTIAL_LEAVES: usize = 128;
/// Leaves a parallel task of a graph query takes.
const GRAPH_LEAVES: usize = 8;
/// Depth of the deepest tree: the number of leaves fits 32 bits and halves at every level.
const MAX_DEPTH: usize = 32;

/// Exact nearest-neighbour search over a fixed set of points.
///
/// Ties are broken by index, so a result never depends on the tree's shape or on the number of threads.
///
/// A node over `m` leaves splits them into the first `⌈m/2⌉` and the rest, so leaves are full whatever the
/// points, and nodes in preorder need no pointers. Every query prunes with the distance to a node's cell
/// (Arya and Mount 1993), summed in the same order as a point's distance: rounding is monotone, hence the
/// computed bound is never above the computed distance of a point inside, and pruning is exact.
#[derive(Debug, Clone)]
pub struct KdTree {
    points: Vec<[f32; 3]>,
    /// Corners of the bounding box.
    min: [f32; 3],
    max: [f32; 3],
    /// Inner nodes in preorder.
    splits: Vec<Split>,
    leaves: Vec<Leaf>,
}

/// An inner node: no point left of it is above `at` along `axis`, none right of it below.
#[derive(Debug, Clone, Copy, Default)]
struct Split {
    axis: u32,
    at: f32,
}

/// Points by coordinate, in ascending order of index; NaN (near to nothing) where there is none.
#[derive(Debug, Clone)]
#[repr(align(64))]
struct Leaf {
    x: [f32; LEAF],
    y: [f32; LEAF],
    z: [f32; LEAF],
    index: [u32; LEAF],
}

/// A subtree on the way through the tree.
#[derive(Clone, Copy, Default)]
struct Cell {
    /// Its first inner node and first leaf.
    split: u32,
    leaf: u32,
    /// How many leaves it has.
    leaves: u32,
    /// From its nearest point to the query, and the square of that.
    offset: [f32; 3],
    distance_sq: f32,
}

/// A point and its index.
type Entry = ([f32; 3], u32);

impl Leaf {
    const EMPTY: Self =
        Self { x: [f32::NAN; LEAF], y: [f32::NAN; LEAF], z: [f32::NAN; LEAF], index: [u32::MAX; LEAF] };

    fn fill(&mut self, entries: &mut [Entry]) {
        entries.sort_unstable_by_key(|e| e.1);
        for (l, &([x, y, z], index)) in entries.iter().enumerate() {
            (self.x[l], self.y[l], self.z[l], self.index[l]) = (x, y, z, index);
        }
    }

    /// The points' squared distances to `query`, NaN where there is no point.
    #[inline(always)]
    fn distances_sq(&self, [x, y, z]: [f32; 3]) -> [f32; LEAF] {
        let mut distances_sq = [0.0; LEAF];
        for l in 0..LEAF {
            distances_sq[l] = norm_sq([x - self.x[l], y - self.y[l], z - self.z[l]]);
        }
        distances_sq
    }

    /// Indices of the points.
    fn indices(&self) -> impl Iterator<Item = u32> {
        self.index.iter().copied().take_while(|&i| i != u32::MAX)
    }
}

impl KdTree {
    /// Indexes `points` (all finite).
    pub fn new(points: &[[f32; 3]]) -> Self {
        Self::new_unless(points, &|| false)
    }

    /// As [`Self::new`]; of no use where `is_over`, asked now and then, said yes.
    pub(crate) fn new_unless(points: &[[f32; 3]], is_over: IsOver) -> Self {
        let mut entries: Vec<Entry> = points.iter().copied().zip(0..).collect();
        let mut leaves = vec![Leaf::EMPTY; points.len().div_ceil(LEAF)];
        let mut splits = vec![Split::default(); leaves.len().saturating_sub(1)];
        build(&mut entries, &mut splits, &mut leaves, is_over);
        let (min, max) = bounding_box(points.iter());
        Self { points: points.to_vec(), min, max, splits, leaves }
    }

    /// The indexed points, in their own order.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
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
        nearest(self, query, Neighbor { index: u32::MAX, distance_sq: max_distance_sq })
    }

    /// As [`Self::nearest`], and faster where the point at `hint` is near the query, such as the answer to a
    /// query close by.
    pub fn nearest_with_hint(&self, query: [f32; 3], max_distance_sq: f32, hint: u32) -> Option<Neighbor> {
        let distance_sq = self.points.get(hint as usize).map_or(f32::NAN, |&p| norm_sq(sub(query, p)));
        if distance_sq <= max_distance_sq {
            nearest(self, query, Neighbor { index: hint, distance_sq })
        } else {
            self.nearest(query, max_distance_sq)
        }
    }

    /// The `k` nearest points, nearest first, into `found` (cleared first; fewer where the tree holds fewer).
    pub fn knn(&self, query: [f32; 3], k: usize, found: &mut Vec<Neighbor>) {
        collect(self, query, f32::INFINITY, k, found);
    }

    /// The nearest points with squared distance at most `radius_sq`, nearest first, at most `max` of them,
    /// into `found` (cleared first).
    pub fn radius(&self, query: [f32; 3], radius_sq: f32, max: usize, found: &mut Vec<Neighbor>) {
        collect(self, query, radius_sq, max, found);
    }

    /// k-nearest lists of every indexed point (itself included), in parallel.
    pub fn knn_graph(&self, k: usize) -> Neighborhoods {
        self.graph(f32::INFINITY, k, &|| false)
    }

    /// Radius lists of every indexed point (itself included), at most `max` each, in parallel.
    pub fn radius_graph(&self, radius: f32, max: usize) -> Neighborhoods {
        self.radius_graph_unless(radius, max, &|| false)
    }

    /// As [`Self::radius_graph`]; lists stay empty once `is_over`, asked now and then, said yes.
    pub(crate) fn radius_graph_unless(&self, radius: f32, max: usize, is_over: IsOver) -> Neighborhoods {
        self.graph(radius * radius, max, is_over)
    }

    /// What `of` makes of each point's index and its `k` nearest points (itself included), nearest first, in parallel:
    /// the lists are not kept. Points are left out once `is_over`, asked now and then, said yes.
    pub(crate) fn map_nearest<T: Clone + Default + Send>(
        &self,
        k: usize,
        is_over: IsOver,
        of: impl Fn(usize, &[Neighbor]) -> T + Sync,
    ) -> Vec<T> {
        let part = |leaves: &[Leaf]| -> Vec<T> {
            if is_over() {
                return Vec::new();
            }
            let lists = graph_part(self, leaves, f32::INFINITY, k);
            let points = leaves.iter().flat_map(Leaf::indices);
            points.enumerate().map(|(r, i)| of(i as usize, lists.row(r))).collect()
        };
        let parts: Vec<Vec<T>> = self.leaves.par_chunks(GRAPH_LEAVES).map(part).collect();
        let mut all = vec![T::default(); self.len()];
        for (leaves, part) in self.leaves.chunks(GRAPH_LEAVES).zip(parts) {
            for (i, value) in leaves.iter().flat_map(Leaf::indices).zip(part) {
                all[i as usize] = value;
            }
        }
        all
    }

    fn graph(&self, radius_sq: f32, max: usize, is_over: IsOver) -> Neighborhoods {
        let parts: Vec<_> = self
            .leaves
            .par_chunks(GRAPH_LEAVES)
            .map(|leaves| graph_part(self, leaves, radius_sq, if is_over() { 0 } else { max }))
            .collect();

        let mut offsets = vec![0; self.len() + 1];
        let mut rows: Vec<&[Neighbor]> = vec![&[]; self.len()];
        for (leaves, part) in self.leaves.chunks(GRAPH_LEAVES).zip(&parts) {
            for (r, i) in leaves.iter().flat_map(Leaf::indices).enumerate() {
                rows[i as usize] = part.row(r);
            }
        }
        for (i, row) in rows.iter().enumerate() {
            offsets[i + 1] = offsets[i] + row.len() as u32;
        }
        Neighborhoods { offsets, neighbors: rows.concat() }
    }
}

/// A walk through the leaves that may hold a point within a bound, near ones first.
struct Walk<'a> {
    tree: &'a KdTree,
    query: [f32; 3],
    stack: [Cell; MAX_DEPTH],
    depth: usize,
}

impl<'a> Walk<'a> {
    #[inline(always)]
    fn new(tree: &'a KdTree, query: [f32; 3]) -> Self {
        let offset = std::array::from_fn(|a| query[a] - query[a].max(tree.min[a]).min(tree.max[a]));
        let root = Cell {
            offset,
            distance_sq: norm_sq(offset),
            leaves: tree.leaves.len() as u32,
            ..Cell::default()
        };
        let mut stack = [Cell::default(); MAX_DEPTH];
        stack[0] = root;
        Self { tree, query, stack, depth: usize::from(!tree.is_empty()) }
    }

    /// The next leaf that may hold a point within `bound`, a squared distance that must not grow.
    #[inline(always)]
    fn next(&mut self, bound: f32) -> Option<&'a Leaf> {
        while self.depth > 0 {
            self.depth -= 1;
            let mut cell = self.stack[self.depth];
            if cell.distance_sq <= bound {
                while cell.leaves > 1 {
                    let Split { axis, at } = self.tree.splits[cell.split as usize];
                    let left = cell.leaves.div_ceil(2);
                    let below = Cell { split: cell.split + 1, leaves: left, ..cell };
                    let above = Cell {
                        split: cell.split + left,
                        leaf: cell.leaf + left,
                        leaves: cell.leaves - left,
                        ..cell
                    };
                    let axis = axis as usize;
                    let to_split = self.query[axis] - at;
                    let (near, mut far) = if to_split < 0.0 { (below, above) } else { (above, below) };
                    far.offset[axis] = to_split;
                    far.distance_sq = norm_sq(far.offset);
                    if far.distance_sq <= bound {
                        self.stack[self.depth] = far;
                        self.depth += 1;
                    }
                    cell = near;
                }
                return Some(&self.tree.leaves[cell.leaf as usize]);
            }
        }
        None
    }
}

/// Sorts `entries` into `leaves`, all full but the last.
fn build(entries: &mut [Entry], splits: &mut [Split], leaves: &mut [Leaf], is_over: IsOver) {
    let [root, splits @ ..] = splits else {
        if let [leaf] = leaves {
            leaf.fill(entries);
        }
        return;
    };
    let (min, max) = bounding_box(entries.iter().map(|e| &e.0));
    let extent = sub(max, min);
    let axis = (1..3).fold(0, |widest, a| if extent[a] > extent[widest] { a } else { widest });

    let left = leaves.len().div_ceil(2);
    let (_, &mut (median, _), _) =
        entries.select_nth_unstable_by(left * LEAF, |a, b| a.0[axis].total_cmp(&b.0[axis]));
    *root = Split { axis: axis as u32, at: median[axis] };

    let parallel = leaves.len() > SEQUENTIAL_LEAVES;
    if parallel && is_over() {
        return;
    }
    let (entries_below, entries_above) = entries.split_at_mut(left * LEAF);
    let (splits_below, splits_above) = splits.split_at_mut(left - 1);
    let (leaves_below, leaves_above) = leaves.split_at_mut(left);
    let mut below = || build(entries_below, splits_below, leaves_below, is_over);
    let mut above = || build(entries_above, splits_above, leaves_above, is_over);
    if parallel {
        rayon::join(below, above);
    } else {
        below();
        above();
    }
}

/// The nearest point that beats `best`, or `best` if it is a point.
#[multiversion(targets("x86_64+avx2"))]
fn nearest(tree: &KdTree, query: [f32; 3], best: Neighbor) -> Option<Neighbor> {
    let mut best = best;
    let mut walk = Walk::new(tree, query);
    while let Some(leaf) = walk.next(best.distance_sq) {
        let distances_sq = leaf.distances_sq(query);
        // Non-negative floats order as their bits do, and NaN's bits are above all.
        let least = distances_sq.iter().fold(u32::MAX, |least, d| least.min(d.to_bits()));
        if f32::from_bits(least) <= best.distance_sq {
            // The first of equals has the lowest index.
            let lane = distances_sq.iter().position(|d| d.to_bits() == least).unwrap_or(0);
            let found = Neighbor { index: leaf.index[lane], distance_sq: distances_sq[lane] };
            if found.rank() < best.rank() {
                best = found;
            }
        }
    }
    (best.index != u32::MAX).then_some(best)
}

/// Fills `found` with the `max` nearest points within the bound (a squared distance), nearest first.
#[multiversion(targets("x86_64+avx2"))]
fn collect(tree: &KdTree, query: [f32; 3], bound: f32, max: usize, found: &mut Vec<Neighbor>) {
    collect_into(tree, query, bound, max, found);
}

#[inline(always)]
fn collect_into(tree: &KdTree, query: [f32; 3], bound: f32, max: usize, found: &mut Vec<Neighbor>) {
    const VACANT: Neighbor = Neighbor { index: u32::MAX, distance_sq: f32::NAN };
    found.clear();
    if max == 0 {
        return;
    }
    // Candidates gather in no order; when twice as many as wanted have come, the nearer half stays and the
    // bound shrinks.
    let room = max.min(tree.len()).saturating_mul(2) + LEAF;
    found.resize(room.min(256), VACANT);
    let mut len = 0;
    let mut bound = bound;
    let mut walk = Walk::new(tree, query);
    while let Some(leaf) = walk.next(bound) {
        if len + LEAF > found.len() {
            if found.len() < room {
                found.resize((2 * found.len()).min(room), VACANT);
            } else {
                let (_, kth, _) = found[..len].select_nth_unstable_by_key(max - 1, Neighbor::rank);
                bound = kth.distance_sq;
                len = max;
            }
        }
        let distances_sq = leaf.distances_sq(query);
        let slots = &mut found[len..len + LEAF];
        let mut hits = 0;
        for l in 0..LEAF {
            // `hits` is at most `l`: the remainder changes nothing and spares the bounds check.
            slots[hits % LEAF] = Neighbor { index: leaf.index[l], distance_sq: distances_sq[l] };
            hits += usize::from(distances_sq[l] <= bound);
        }
        len += hits;
    }
    found.truncate(len);
    if len > max {
        found.select_nth_unstable_by_key(max - 1, Neighbor::rank);
        found.truncate(max);
    }
    found.sort_unstable_by_key(Neighbor::rank);
}

/// The neighbours of the points in `leaves`, in the order of the leaves.
#[multiversion(targets("x86_64+avx2"))]
fn graph_part(tree: &KdTree, leaves: &[Leaf], radius_sq: f32, max: usize) -> Neighborhoods {
    let mut part = Neighborhoods { offsets: vec![0], neighbors: Vec::new() };
    let mut found = Vec::new();
    // A point whose `max` neighbours lie within r has a ball around it that serves a point at distance d as
    // well: its own `max` neighbours lie within r + d.
    let mut last: Option<([f32; 3], f32)> = None;
    for i in leaves.iter().flat_map(Leaf::indices) {
        let query = tree.points[i as usize];
        let bound = last.map_or(f32::INFINITY, |(center, r_sq)| {
            let reach = r_sq.sqrt() + norm_sq(sub(query, center)).sqrt();
            // Slack for rounding, relative and (underflow) absolute.
            reach * reach * (1.0 + 1e-5) + f32::MIN_POSITIVE
        });
        collect_into(tree, query, bound.min(radius_sq), max, &mut found);
        last = found.get(max.wrapping_sub(1)).map(|kth| (query, kth.distance_sq));
        part.neighbors.extend_from_slice(&found);
        part.offsets.push(part.neighbors.len() as u32);
    }
    part
}

/// Lowest and highest corner.
fn bounding_box<'a>(points: impl Iterator<Item = &'a [f32; 3]>) -> ([f32; 3], [f32; 3]) {
    points.fold(([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]), |(min, max), p| {
        (std::array::from_fn(|a| min[a].min(p[a])), std::array::from_fn(|a| max[a].max(p[a])))
    })
}

#[inline(always)]
fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn norm_sq([x, y, z]: [f32; 3]) -> f32 {
    x * x + y * y + z * z
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn brute_force(points: &[[f32; 3]], query: [f32; 3], radius_sq: f32, max: usize) -> Vec<Neighbor> {
        let mut all: Vec<_> = points
            .iter()
            .zip(0..)
            .map(|(&p, index)| Neighbor { index, distance_sq: norm_sq(sub(query, p)) })
            .filter(|n| n.distance_sq <= radius_sq)
            .collect();
        all.sort_by_key(Neighbor::rank);
        all.truncate(max);
        all
    }

    /// Clouds of 1 to 300 points: scattered, or on a coarse grid, hence full of duplicates and ties; flattened
    /// to a plane, a line or a point.
    fn clouds() -> impl Strategy<Value = Vec<[f32; 3]>> {
        let scattered = prop::collection::vec(prop::array::uniform3(-1.0_f32..1.0), 1..300);
        (scattered, prop::array::uniform3(0_u8..3)).prop_map(|(mut points, kind)| {
            for p in &mut points {
                for a in 0..3 {
                    match kind[a] {
                        0 => p[a] = 0.25,
                        1 => p[a] = (p[a] * 3.0).round(),
                        _ => {}
                    }
                }
            }
            points
        })
    }

    proptest! {
        #[test]
        fn agrees_with_brute_force(
            points in clouds(),
            query in prop::array::uniform3(-2.0_f32..2.0),
            radius in 0.0_f32..2.0,
            max in 0_usize..40,
        ) {
            let tree = KdTree::new(&points);
            let mut found = Vec::new();
            for query in [query, points[points.len() / 2]] {
                tree.knn(query, max, &mut found);
                prop_assert_eq!(&found, &brute_force(&points, query, f32::INFINITY, max));
                tree.radius(query, radius * radius, max, &mut found);
                prop_assert_eq!(&found, &brute_force(&points, query, radius * radius, max));
                let nearest = brute_force(&points, query, radius * radius, 1).first().copied();
                prop_assert_eq!(tree.nearest(query, radius * radius), nearest);
                for hint in [0, points.len() as u32 / 2, u32::MAX] {
                    prop_assert_eq!(tree.nearest_with_hint(query, radius * radius, hint), nearest);
                }
            }
        }

        #[test]
        fn graphs_hold_every_row(points in clouds(), radius in 0.0_f32..1.0, max in 0_usize..40) {
            let tree = KdTree::new(&points);
            let (knn, within) = (tree.knn_graph(max), tree.radius_graph(radius, max));
            prop_assert_eq!((knn.len(), within.len()), (points.len(), points.len()));
            for (i, &p) in points.iter().enumerate() {
                prop_assert_eq!(knn.row(i), &brute_force(&points, p, f32::INFINITY, max));
                prop_assert_eq!(within.row(i), &brute_force(&points, p, radius * radius, max));
            }
        }
    }

    #[test]
    fn an_empty_tree_finds_nothing() {
        let tree = KdTree::new(&[]);
        assert_eq!(tree.nearest([0.0; 3], f32::INFINITY), None);
        assert_eq!(tree.knn_graph(3).len(), 0);
    }

    #[test]
    fn large_clouds_are_built_in_parallel_and_alike() {
        let points: Vec<_> = (0..40_000_u32)
            .map(|i| [0x9e37_79b9_u32, 0x85eb_ca6b, 0xc2b2_ae35].map(|m| (i.wrapping_mul(m) >> 8) as f32))
            .collect();
        let graph = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| KdTree::new(&points).knn_graph(5))
        };
        let one = graph(1);
        assert_eq!(one, graph(3));
        for i in [0, 17, 39_999] {
            assert_eq!(one.row(i), brute_force(&points, points[i], f32::INFINITY, 5));
        }
    }

    #[test]
    fn tiny_distances_do_not_lose_neighbours() {
        let points: Vec<_> = (0..100).map(|i| [i as f32 * 1e-23, 0.0, 0.0]).collect();
        let graph = KdTree::new(&points).knn_graph(10);
        assert!((0..100).all(|i| graph.row(i).len() == 10));
    }
}
