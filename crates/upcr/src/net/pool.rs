//! The last graph layer and the maximum of its values over all points, of which only those are computed that may be the
//! maximum.
//!
//! Every value is bounded from above first, by products in bytes at a fraction of the cost. With a point's features as
//! F = μ + s·q + r about a mean and a channel's weights as w = t·v + u, where q and v are bytes,
//! `w·F = w·μ + s·t·q·v + s·q·u + w·r ≤ w·μ + s·t·q·v + ‖s·q‖‖u‖ + ‖w‖‖r‖`. A value whose bound does not exceed one that
//! is known cannot be larger: the result is that of computing all. Bounds are whole numbers of a unit.

use multiversion::multiversion;

use super::Graph;
use super::aligned::Aligned;
use super::graph::PairedRows;
use super::kernel::{self, dot, larger, leaky, places, prefetch};
use super::lanes::{BLOCK, Bounds, Hit, Lanes, Quad, QuadLanes, Sums, TILE, whole_tiles};
use super::layer::{Features, blocks};
use super::weights::Affine;

/// Points that share a mean: where near points are near each other, their features differ less than those of all.
const GROUP: usize = 64 * TILE;
/// Largest byte of a centred feature, which is stored with `ZERO` added.
const HIGHEST: f32 = 127.0;
const ZERO: i32 = 128;
/// Largest bound of a product: two of them add up within 16 bits.
const TOP: i16 = 16_383;
/// Added to a number, it leaves the nearest integer in the last bits.
const ROUND: f32 = 12_582_912.0;
/// Beyond products of this size nothing is bounded: sums of them might overflow.
const BOUNDED: f32 = 1e30;
/// What squares that underflow may hide from a length, for each root of their number.
const UNDERFLOW: f32 = 1.1e-19;

/// The last layer, packed for inference.
#[derive(Debug, Clone)]
pub(super) struct PooledLayer {
    inputs: usize,
    outputs: usize,
    slope: f32,
    blocks: Vec<Block>,
}

/// One block of channels.
#[derive(Debug, Clone)]
struct Block {
    /// The center's weights in bytes, then the neighbour's.
    panel: Aligned<QuadLanes>,
    center: Map,
    neighbor: Map,
}

/// A block's map of points, and what its weights in bytes say about it.
#[derive(Debug, Clone)]
struct Map {
    /// A row a channel.
    weights: Aligned<f32>,
    shift: Lanes,
    /// ‖w‖, ‖u‖ and t, the first two rounded up.
    length: Lanes,
    lost: Lanes,
    unit: Lanes,
    /// What `ZERO` adds to products.
    offset: [i32; BLOCK],
}

/// What pooling needs room for.
#[derive(Debug, Default)]
pub(super) struct PoolRoom {
    features: Quantized,
    /// Of a group.
    sums: Aligned<Sums>,
    /// Bounds of products, and of values.
    center: Aligned<Bounds>,
    neighbor: Aligned<Bounds>,
    upper: Aligned<Bounds>,
    hits: Vec<Hit>,
    candidates: Vec<Candidate>,
    /// The neighbour's products, where a point's bits say that they are known.
    products: Vec<Lanes>,
    known: Vec<u32>,
}

/// A point and a channel of it that may have the largest value.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    point: usize,
    channel: usize,
    /// The center's value.
    center: f32,
    /// The highest bound of a neighbour's product, and the neighbour that has it.
    highest: i16,
    first: usize,
}

/// Features as bytes about the means of their groups.
#[derive(Debug, Default)]
struct Quantized {
    quads: Vec<Quad>,
    rows: Vec<Row>,
    /// A row a group.
    means: Aligned<f32>,
    /// Scratch: a row's distance from its mean, then r.
    rest: Aligned<f32>,
}

/// s, ‖s·q‖ and ‖r‖ of a point, the lengths rounded up.
#[derive(Debug, Clone, Copy)]
struct Row {
    unit: f32,
    length: f32,
    lost: f32,
}

/// Bounds of the lengths of features and means, and of what sets these apart.
#[derive(Debug, Clone, Copy)]
struct Reach {
    features: f32,
    rest: f32,
}

/// Of features that are too long to be bounded.
const UNBOUNDED: Reach = Reach { features: f32::INFINITY, rest: f32::INFINITY };

impl PooledLayer {
    /// From the map over `[Fᵢ ; Fⱼ − Fᵢ]`.
    pub fn new(map: &Affine, slope: f32) -> Self {
        let inputs = map.inputs / 2;
        let blocks = blocks(map.outputs)
            .map(|block| {
                let w2: Vec<Lanes> = (0..inputs).map(|k| block.of(map.row(inputs + k))).collect();
                let center = (0..inputs).zip(&w2).map(|(k, w2)| {
                    let w1 = block.of(map.row(k));
                    std::array::from_fn(|l| w1[l] - w2[l])
                });
                let center: Vec<Lanes> = center.collect();
                let mut panel = Aligned::default();
                panel.resize(inputs.div_ceil(4), [[0; 4]; 2 * BLOCK]);
                let center = Map::new(&center, block.of(&map.shift), &mut panel, 0);
                let neighbor = Map::new(&w2, [0.0; BLOCK], &mut panel, BLOCK);
                Block { panel, center, neighbor }
            })
            .collect();
        Self { inputs, outputs: map.outputs, slope, blocks }
    }

    /// The maximum over all points of the layer's features.
    pub fn apply(
        &self,
        input: &Features,
        graph: &Graph,
        rows: &PairedRows,
        room: &mut PoolRoom,
        gamma: &mut Vec<f32>,
    ) {
        let reach = quantize(input, self.inputs, graph.len(), &mut room.features);
        self.apply_within(reach, input, graph, rows, room, gamma);
    }

    /// [`Self::apply`] to quantized features; where they are [`UNBOUNDED`], every value is computed.
    fn apply_within(
        &self,
        reach: Reach,
        input: &Features,
        graph: &Graph,
        rows: &PairedRows,
        room: &mut PoolRoom,
        gamma: &mut Vec<f32>,
    ) {
        let points = graph.len();
        room.sums.resize(GROUP, [0; 2 * BLOCK]);
        room.center.resize(points, [0; BLOCK]);
        room.neighbor.resize(points, [0; BLOCK]);
        room.upper.resize(points, [0; BLOCK]);
        room.products.resize(points, [0.0; BLOCK]);
        gamma.clear();
        for block in &self.blocks {
            let units = block.bound(reach, room);
            let most = gather(&room.center, &room.neighbor, rows, &mut room.upper);
            let values = block.search(&units, &most, input, graph, room);
            gamma.extend(values.map(|v| leaky(v, self.slope)));
        }
        gamma.truncate(self.outputs);
    }
}

impl Block {
    /// Bounds the products; returns the bounds' units.
    fn bound(&self, reach: Reach, room: &mut PoolRoom) -> Lanes {
        let PoolRoom { features, sums, center, neighbor, .. } = room;
        let longest = self.center.length.iter().chain(&self.neighbor.length).copied().fold(0.0, f32::max);
        if longest * (reach.features + reach.rest) < BOUNDED {
            let tops = [self.center.tops(reach), self.neighbor.tops(reach)];
            let units = std::array::from_fn(|l| tops[0][l].max(tops[1][l]) / f32::from(TOP));
            let groups = features.groups(self.panel.len(), self.center.inputs());
            let bounds = center.chunks_mut(GROUP).zip(neighbor.chunks_mut(GROUP));
            for ((quads, rows, mean), (center, neighbor)) in groups.zip(bounds) {
                kernel::multiply_quads(quads, self.panel.len(), &self.panel, sums);
                bound::<0>(&self.center, reach, &units, mean, rows, sums, center);
                bound::<1>(&self.neighbor, reach, &units, mean, rows, sums, neighbor);
            }
            units
        } else {
            center.fill([TOP; BLOCK]);
            neighbor.fill([TOP; BLOCK]);
            [f32::INFINITY; BLOCK]
        }
    }

    /// The largest value of each channel before the rectifier, of which `room.upper` holds bounds, `most` the highest.
    fn search(
        &self,
        units: &Lanes,
        most: &Bounds,
        input: &Features,
        graph: &Graph,
        room: &mut PoolRoom,
    ) -> Lanes {
        let PoolRoom { center: centers, neighbor, upper, hits, candidates, products, known, .. } = room;
        let features = |i: usize| &input.values[i * input.stride..][..self.center.inputs()];
        let fetch = |i: usize| prefetch(features(i).as_ptr(), self.center.inputs());
        known.clear();
        known.resize(graph.len(), 0);
        let mut best = [f32::NEG_INFINITY; BLOCK];
        let mut bars = [i16::MIN; BLOCK];
        // The points of the highest bounds first, then those of high ones: they leave few others.
        for stage in [Stage::Highest, Stage::High, Stage::All] {
            kernel::above(upper, &std::array::from_fn(|l| stage.bar(bars[l], most[l])), hits);
            // Inner products that do not wait for each other, while the features of later ones come into cache.
            candidates.clear();
            for (at, &Hit { point, channels }) in hits.iter().enumerate() {
                if let Some(later) = hits.get(at + 2) {
                    fetch(later.point as usize);
                }
                let i = point as usize;
                for l in places(channels) {
                    let center = dot(self.center.row(l), features(i)) + self.center.shift[l];
                    let highest = upper[i][l] - centers[i][l];
                    // Later stages need not look at it again.
                    upper[i][l] = i16::MIN;
                    if center + f32::from(highest) * units[l] > best[l] {
                        let row = graph.row(i);
                        let first = row.iter().find(|&&j| neighbor[j as usize][l] == highest);
                        let first = first.map_or(i, |&j| j as usize);
                        fetch(first);
                        candidates.push(Candidate { point: i, channel: l, center, highest, first });
                    }
                }
            }
            for &Candidate { point, channel: l, center, highest, first } in candidates.iter() {
                let mut visit = |j: usize, best: f32| {
                    if known[j] & 1 << l == 0 {
                        known[j] |= 1 << l;
                        products[j][l] = dot(self.neighbor.row(l), features(j));
                    }
                    larger(center + products[j][l], best)
                };
                if center + f32::from(highest) * units[l] <= best[l] {
                    continue;
                }
                let mut most = visit(first, best[l]);
                let mut least = bar(most - center, units[l]);
                for &j in graph.row(point) {
                    let j = j as usize;
                    if neighbor[j][l] > least && j != first {
                        most = visit(j, most);
                        least = bar(most - center, units[l]);
                    }
                }
                best[l] = most;
                bars[l] = bar(most, units[l]);
            }
        }
        best
    }
}

/// Which of the points that may be the maximum are looked at.
#[derive(Clone, Copy)]
enum Stage {
    Highest,
    High,
    All,
}

impl Stage {
    /// What bounds have to exceed, between what the best value asks for and the highest of them.
    fn bar(self, least: i16, most: i16) -> i16 {
        match self {
            Self::Highest => most - 1,
            Self::High => least.midpoint(most),
            Self::All => least,
        }
    }
}

/// Values whose bounds do not exceed it are not larger than `best`.
fn bar(best: f32, unit: f32) -> i16 {
    // Towards zero, which is up by less than one where it is negative.
    ((best / unit) as i16).saturating_sub(2)
}

impl Map {
    /// From a row an input; writes the weights in bytes to the panel's channels from `at`.
    fn new(rows: &[Lanes], shift: Lanes, panel: &mut [QuadLanes], at: usize) -> Self {
        let highest = kernel::highest_weight();
        let mut map = Self {
            weights: (0..BLOCK).flat_map(|l| rows.iter().map(move |row| row[l])).collect(),
            shift,
            length: [0.0; BLOCK],
            lost: [0.0; BLOCK],
            unit: [0.0; BLOCK],
            offset: [0; BLOCK],
        };
        for l in 0..BLOCK {
            let weights = rows.iter().map(|row| row[l]);
            let most = weights.clone().map(f32::abs).fold(0.0, f32::max);
            let unit = (f64::from(most) / highest) as f32;
            let (mut length_sq, mut lost_sq) = (0.0, 0.0);
            for (k, w) in weights.clone().map(f64::from).enumerate() {
                let byte =
                    if unit > 0.0 { (w / f64::from(unit)).round().clamp(-highest, highest) } else { 0.0 };
                length_sq += w * w;
                lost_sq += (w - byte * f64::from(unit)).powi(2);
                panel[k / 4][at + l][k % 4] = byte as i8;
                map.offset[l] += ZERO * byte as i32;
            }
            map.length[l] = rounded_up(length_sq.sqrt());
            map.lost[l] = rounded_up(lost_sq.sqrt());
            map.unit[l] = unit;
        }
        map
    }

    fn inputs(&self) -> usize {
        self.weights.len() / BLOCK
    }

    fn row(&self, channel: usize) -> &[f32] {
        &self.weights[channel * self.inputs()..][..self.inputs()]
    }

    /// What rounding may change: in two inner products, and in some sixty steps of the bounds and the lengths.
    fn slack(&self, reach: Reach) -> Lanes {
        let steps = (self.inputs() + 64) as f32;
        std::array::from_fn(|l| {
            let size = 2.0 * self.length[l] * reach.features + self.shift[l].abs();
            steps * f32::EPSILON * size + f32::MIN_POSITIVE
        })
    }

    /// What no bound exceeds, with one in a thousand to spare.
    fn tops(&self, reach: Reach) -> Lanes {
        let slack = self.slack(reach);
        std::array::from_fn(|l| {
            let product = self.length[l] * (reach.features + reach.rest) + 2.0 * self.lost[l] * reach.rest;
            (1.001 * (product + self.shift[l].abs() + slack[l])).max(1e-30)
        })
    }
}

/// Not less than `value`.
fn rounded_up(value: f64) -> f32 {
    (value * (1.0 + 1e-6)) as f32 + f32::MIN_POSITIVE
}

/// Bounds of a map's products, in `units`, from those in bytes, of which the map's are half number `HALF`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+avx512bw+fma", "x86_64+avx2+fma"))]
fn bound<const HALF: usize>(
    map: &Map,
    reach: Reach,
    units: &Lanes,
    mean: &[f32],
    rows: &[Row],
    sums: &[Sums],
    bounds: &mut [Bounds],
) {
    let slack = map.slack(reach);
    let scale = units.map(|unit| 1.0 / unit);
    let base: Lanes = std::array::from_fn(|l| dot(map.row(l), mean) + map.shift[l] + slack[l]);
    for ((row, sums), bounds) in rows.iter().zip(sums).zip(bounds) {
        let mut rounded = [0; BLOCK];
        for l in 0..BLOCK {
            let product = (sums[HALF * BLOCK + l] - map.offset[l]) as f32 * row.unit * map.unit[l];
            let bound = base[l] + product + (row.lost * map.length[l] + row.length * map.lost[l]);
            // At least half a unit is left for what is rounded from here on.
            rounded[l] = (bound * scale[l] + ROUND).to_bits() as i16 + 1;
        }
        *bounds = rounded;
    }
}

impl Quantized {
    /// Bytes, rows and mean of every group.
    fn groups(&self, quads: usize, inputs: usize) -> impl Iterator<Item = (&[Quad], &[Row], &[f32])> {
        let groups = self.quads.chunks(GROUP * quads).zip(self.rows.chunks(GROUP));
        groups.zip(self.means.chunks_exact(inputs)).map(|((quads, rows), mean)| (quads, rows, mean))
    }
}

/// Writes features as bytes.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+avx512bw+fma", "x86_64+avx2+fma"))]
fn quantize(input: &Features, inputs: usize, points: usize, quantized: &mut Quantized) -> Reach {
    let Quantized { quads, rows, means, rest } = quantized;
    let floor = UNDERFLOW * (inputs as f32).sqrt();
    let rounding = 1.0 + inputs as f32 * f32::EPSILON;
    let length = |v: &[f32]| dot(v, v).sqrt() * rounding + floor;
    let quads_a_row = inputs.div_ceil(4);
    // What a row has beyond its inputs meets no weight.
    quads.resize(whole_tiles(points) * quads_a_row, [0; 4]);
    rows.clear();
    rest.resize(inputs, 0.0);
    means.resize(points.div_ceil(GROUP) * inputs, 0.0);
    means.fill(0.0);
    let mut reach = Reach { features: 0.0, rest: 0.0 };
    let features = input.values[..points * input.stride].chunks(GROUP * input.stride);
    let groups = features.zip(quads.chunks_mut(GROUP * quads_a_row)).zip(means.chunks_exact_mut(inputs));
    for ((features, quads), mean) in groups {
        let features = || features.chunks_exact(input.stride).map(|row| &row[..inputs]);
        for row in features() {
            for (mean, v) in mean.iter_mut().zip(row) {
                *mean += v;
            }
        }
        let share = 1.0 / features().len() as f32;
        for mean in mean.iter_mut() {
            *mean *= share;
        }
        // Where a feature is no number, the mean is none either.
        reach.features = larger(reach.features, length(mean));
        for (row, quads) in features().zip(quads.chunks_exact_mut(quads_a_row)) {
            reach.features = larger(length(row), reach.features);
            if !reach.features.is_finite() {
                return UNBOUNDED;
            }
            for ((rest, v), mean) in rest.iter_mut().zip(row).zip(mean.iter()) {
                *rest = v - mean;
            }
            // Non-negative floats order as their bits do.
            let most = f32::from_bits(rest.iter().map(|v| v.abs().to_bits()).fold(0, u32::max));
            let (unit, steps) = if most > 1e-30 { (most / HIGHEST, HIGHEST / most) } else { (0.0, 0.0) };
            let mut length_sq = 0;
            for (byte, rest) in quads.as_flattened_mut().iter_mut().zip(rest.iter_mut()) {
                let rounded = *rest * steps + ROUND;
                let whole = rounded.to_bits() as i32 - ROUND.to_bits() as i32;
                *byte = (whole + ZERO) as u8;
                *rest -= (rounded - ROUND) * unit;
                length_sq += whole * whole;
            }
            let row = Row { unit, length: (length_sq as f32).sqrt() * unit * rounding, lost: length(rest) };
            reach.rest = larger(row.length + row.lost, reach.rest);
            rows.push(row);
        }
    }
    reach
}

/// Bounds of the values at every point, and the highest of each channel.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw", "x86_64+avx2"))]
fn gather(center: &[Bounds], neighbor: &[Bounds], rows: &PairedRows, upper: &mut [Bounds]) -> Bounds {
    let larger_of = |mut most: Bounds, row: &[u32]| {
        for &j in row {
            let bounds = &neighbor[j as usize];
            for l in 0..BLOCK {
                most[l] = most[l].max(bounds[l]);
            }
        }
        most
    };
    let mut highest = [i16::MIN; BLOCK];
    let pairs = rows.pairs().zip(center.chunks(2)).zip(upper.chunks_mut(2));
    for (([both, first, second], center), upper) in pairs {
        let shared = larger_of([i16::MIN; BLOCK], both);
        for ((center, upper), alone) in center.iter().zip(upper).zip([first, second]) {
            let mut most = larger_of(shared, alone);
            for l in 0..BLOCK {
                most[l] += center[l];
                highest[l] = highest[l].max(most[l]);
            }
            *upper = most;
        }
    }
    highest
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A layer and the features it sees.
    struct Case {
        layer: PooledLayer,
        features: Features,
        graph: Graph,
    }

    impl Case {
        /// `feature` and `weight` give values by row and column.
        fn new(
            [points, k, inputs, outputs]: [usize; 4],
            mut feature: impl FnMut(usize, usize) -> f32,
            mut weight: impl FnMut(usize, usize) -> f32,
        ) -> Self {
            let mut features = Features::default();
            features.reserve(points, inputs.next_multiple_of(BLOCK));
            for (i, row) in features.values.chunks_exact_mut(features.stride).take(points).enumerate() {
                for (c, value) in row[..inputs].iter_mut().enumerate() {
                    *value = feature(i, c);
                }
            }
            let values = (0..2 * inputs).flat_map(|k| (0..outputs).map(move |c| (k, c)));
            let weight = values.map(|(k, c)| weight(k, c)).collect();
            let shift = (0..outputs).map(|c| (c as f32).sin()).collect();
            let map = Affine { inputs: 2 * inputs, outputs, weight, shift };
            let k = k.min(points);
            let neighbors = (0..points).flat_map(|i| (0..k).map(move |s| ((i + s * s) % points) as u32));
            let graph = Graph { k, neighbors: neighbors.collect() };
            Self { layer: PooledLayer::new(&map, 0.2), features, graph }
        }

        fn apply(&self, reach: Option<Reach>) -> Vec<f32> {
            let (mut room, mut gamma) = <(PoolRoom, Vec<f32>)>::default();
            let Self { layer, features, graph } = self;
            let found = quantize(features, layer.inputs, graph.len(), &mut room.features);
            let reach = reach.unwrap_or(found);
            let mut rows = PairedRows::default();
            rows.fill(graph);
            layer.apply_within(reach, features, graph, &rows, &mut room, &mut gamma);
            gamma
        }

        /// The same bits as where nothing is left out.
        fn assert_exact(&self) {
            let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            assert_eq!(bits(self.apply(None)), bits(self.apply(Some(UNBOUNDED))));
        }
    }

    fn random(seed: u64, reach: f32) -> impl FnMut(usize, usize) -> f32 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        move |_, _| rng.random_range(-reach..reach)
    }

    /// Features that vary slowly from point to point, as those of layers before.
    fn smooth(i: usize, c: usize) -> f32 {
        (i as f32 * 0.02 + c as f32 * 1.7).sin() + (c % 7) as f32
    }

    proptest! {
        #[test]
        fn bounds_change_no_bit(
            points in 1..120_usize,
            k in 1..12_usize,
            inputs in 1..150_usize,
            outputs in 1..80_usize,
            seed in any::<u64>(),
            exponent in -30..30_i32,
        ) {
            let scale = 2.0_f32.powi(exponent);
            let shape = [points, k, inputs, outputs];
            Case::new(shape, random(seed, scale), random(seed ^ 1, 0.2)).assert_exact();
            Case::new(shape, |i, c| scale * smooth(i, c), random(seed, 0.2)).assert_exact();
        }
    }

    #[test]
    fn bounds_change_no_bit_where_they_are_of_no_use() {
        let shape = [200, 8, 64, 64];
        let weight = || random(3, 0.2);
        let huge = |scale: f32| move |i: usize, c: usize| scale * smooth(i, c);
        Case::new(shape, |_, _| 0.7, weight()).assert_exact();
        Case::new(shape, |_, _| 0.0, weight()).assert_exact();
        Case::new(shape, smooth, |_, _| 0.0).assert_exact();
        // Ties.
        Case::new(shape, |i, c| smooth(i % 5, c), weight()).assert_exact();
        Case::new(shape, |i, c| f32::from(u8::from((i + c) % 2 == 0)), |k, c| ((k + c) % 3) as f32 - 1.0)
            .assert_exact();
        // One point, and one value, far from all others.
        Case::new(shape, |i, c| smooth(i, c) * if i == 17 { 1e6 } else { 1.0 }, weight()).assert_exact();
        Case::new(shape, |i, c| smooth(i, c) * if c == 17 { 1e6 } else { 1.0 }, weight()).assert_exact();
        for scale in [1e-44, 1e-38, 1e-25, 1e-18, 1e15, 1e19, 1e30, 1e37] {
            Case::new(shape, huge(scale), weight()).assert_exact();
        }
        Case::new(shape, |i, _| if i == 3 { f32::INFINITY } else { 1.0 }, weight()).assert_exact();
        Case::new(shape, |i, _| if i == 3 { f32::NAN } else { 1.0 }, weight()).assert_exact();
        Case::new(shape, smooth, |_, _| f32::MAX).assert_exact();
    }

    #[test]
    fn values_are_those_of_the_definition() {
        let [points, k, inputs, outputs] = [90, 7, 50, 40];
        // Small integers: sums are exact.
        let feature = |i: usize, c: usize| ((i * 7 + c * 13) % 17) as f32 - 8.0;
        let weight = |k: usize, c: usize| ((k * 5 + c * 3) % 11) as f32 - 5.0;
        let case = Case::new([points, k, inputs, outputs], feature, weight);
        let value = |i: usize, j: usize, c: usize| {
            let edge =
                |k| feature(i, k) * weight(k, c) + (feature(j, k) - feature(i, k)) * weight(inputs + k, c);
            (0..inputs).map(edge).sum::<f32>()
        };
        let most = (0..outputs).map(|c| {
            let edges = (0..points).flat_map(|i| case.graph.row(i).iter().map(move |&j| (i, j as usize)));
            let most = edges.map(|(i, j)| value(i, j, c)).fold(f32::NEG_INFINITY, f32::max);
            leaky(most + (c as f32).sin(), 0.2)
        });
        for (c, (ours, expected)) in case.apply(None).into_iter().zip(most).enumerate() {
            assert!((ours - expected).abs() <= 1e-5 * expected.abs(), "{c}: {ours} {expected}");
        }
    }
}
