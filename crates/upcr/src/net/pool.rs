//! The last graph layer and the maximum of its values over all points, of which only those are computed that may be the
//! maximum.
//!
//! Every value is bounded from above first, by products in bytes at a fraction of the cost. With a point's features as
//! F = μ + s·q + r and a channel's weights as w = t·v + u, where q and v are bytes,
//! `w·F = w·μ + s·t·q·v + s·q·u + w·r ≤ w·μ + s·t·q·v + ‖s·q‖‖u‖ + ‖w‖‖r‖`. A value whose bound does not exceed one that
//! is known cannot be larger: the result is that of computing all.

use multiversion::multiversion;

use super::Graph;
use super::kernel::{
    self, BLOCK, Lanes, MOST, Quad, QuadLanes, Sums, dot, larger, largest, leaky, whole_tiles,
};
use super::layer::{Features, Products, blocks};
use super::weights::Affine;

/// Beyond products of this size nothing is bounded: sums of them might overflow.
const BOUNDED: f32 = 1e30;
/// What squares that underflow may hide from a length, for each root of their number.
const UNDERFLOW: f32 = 1.1e-19;
/// Largest byte of a centred feature, which is stored with `ZERO` added.
const HIGHEST: f32 = 127.0;
const ZERO: i32 = 128;

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
    /// Of the center's map, then the neighbour's.
    panel: Vec<QuadLanes>,
    center: Map,
    neighbor: Map,
}

/// A block's map of points, and what its weights in bytes say about it.
#[derive(Debug, Clone)]
struct Map {
    /// A row a channel.
    weights: Vec<f32>,
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
    quads: Vec<Quad>,
    rows: Vec<Row>,
    mean: Vec<f32>,
    rest: Vec<f32>,
    sums: Vec<Sums>,
    upper: Vec<Lanes>,
}

/// s, ‖s·q‖ and ‖r‖ of a point, the lengths rounded up.
#[derive(Debug, Clone, Copy, Default)]
struct Row {
    unit: f32,
    length: f32,
    lost: f32,
}

impl PooledLayer {
    /// From the map over `[Fᵢ ; Fⱼ − Fᵢ]`.
    pub fn new(map: &Affine, slope: f32) -> Self {
        let inputs = map.inputs / 2;
        let blocks = blocks(map.outputs)
            .map(|block| {
                let w2: Vec<Lanes> = (0..inputs).map(|k| block.of(map.row(inputs + k))).collect();
                let center: Vec<Lanes> = (0..inputs)
                    .zip(&w2)
                    .map(|(k, w2)| {
                        let w1 = block.of(map.row(k));
                        std::array::from_fn(|l| w1[l] - w2[l])
                    })
                    .collect();
                let mut panel = vec![[[0; 4]; 2 * BLOCK]; inputs.div_ceil(4)];
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
        products: &mut Products,
        room: &mut PoolRoom,
        gamma: &mut Vec<f32>,
    ) {
        let reach = quantize(input, self.inputs, graph.len(), room);
        self.apply_within(reach, input, graph, products, room, gamma);
    }

    /// Features and their mean are no longer than half of `reach`; where that is infinite, every value is computed.
    fn apply_within(
        &self,
        reach: f32,
        input: &Features,
        graph: &Graph,
        products: &mut Products,
        room: &mut PoolRoom,
        gamma: &mut Vec<f32>,
    ) {
        products.reserve(graph.len());
        room.sums.resize(whole_tiles(graph.len()), [0; 2 * BLOCK]);
        room.upper.resize(graph.len(), [0.0; BLOCK]);
        gamma.clear();
        for block in &self.blocks {
            block.bound(reach, products, room);
            let most = gather_bounds(products, graph, &mut room.upper);
            let values = search(block, input, graph, &mut products.neighbor, &room.upper, &most);
            gamma.extend(values.map(|v| leaky(v, self.slope)));
        }
        gamma.truncate(self.outputs);
    }
}

impl Map {
    /// From a row an input; writes the weights in bytes to the panel's channels from `at`.
    fn new(rows: &[Lanes], shift: Lanes, panel: &mut [QuadLanes], at: usize) -> Self {
        let mut map = Self {
            weights: Vec::with_capacity(BLOCK * rows.len()),
            shift,
            length: [0.0; BLOCK],
            lost: [0.0; BLOCK],
            unit: [0.0; BLOCK],
            offset: [0; BLOCK],
        };
        for l in 0..BLOCK {
            let weights = rows.iter().map(|row| row[l]);
            let most = weights.clone().map(f32::abs).fold(0.0, f32::max);
            let unit = (f64::from(most) / MOST) as f32;
            let (mut length_sq, mut lost_sq) = (0.0, 0.0);
            for (k, w) in weights.clone().map(f64::from).enumerate() {
                let byte = if unit > 0.0 { (w / f64::from(unit)).round().clamp(-MOST, MOST) } else { 0.0 };
                length_sq += w * w;
                lost_sq += (w - byte * f64::from(unit)).powi(2);
                panel[k / 4][at + l][k % 4] = byte as i8;
                map.offset[l] += ZERO * byte as i32;
            }
            map.length[l] = rounded_up(length_sq.sqrt());
            map.lost[l] = rounded_up(lost_sq.sqrt());
            map.unit[l] = unit;
            map.weights.extend(weights);
        }
        map
    }

    fn row(&self, channel: usize) -> &[f32] {
        let inputs = self.weights.len() / BLOCK;
        &self.weights[channel * inputs..][..inputs]
    }
}

/// Not less than `value`.
fn rounded_up(value: f64) -> f32 {
    (value * (1.0 + 1e-6)) as f32 + f32::MIN_POSITIVE
}

impl Block {
    /// Puts upper bounds of the block's products in the place of the products.
    fn bound(&self, reach: f32, products: &mut Products, room: &mut PoolRoom) {
        let (center, neighbor) = (&mut products.center, &mut products.neighbor);
        let longest = self.center.length.iter().chain(&self.neighbor.length).copied().fold(0.0, f32::max);
        if longest * reach < BOUNDED {
            kernel::multiply_quads(&room.quads, self.panel.len(), &self.panel, &mut room.sums);
            bound::<0>(&self.center, reach, room, center);
            bound::<1>(&self.neighbor, reach, room, neighbor);
        } else {
            center.fill([f32::INFINITY; BLOCK]);
            neighbor.fill([f32::INFINITY; BLOCK]);
        }
    }
}

/// Upper bounds of a map's products from those in bytes, of which the map's are half number `HALF`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma"))]
fn bound<const HALF: usize>(map: &Map, reach: f32, room: &PoolRoom, bounds: &mut [Lanes]) {
    // Rounding: two inner products', and some sixty steps' here and in the lengths.
    let steps = (room.mean.len() + 64) as f32;
    let base: Lanes = std::array::from_fn(|l| {
        let slack = steps * f32::EPSILON * (2.0 * map.length[l] * reach + map.shift[l].abs());
        dot(map.row(l), &room.mean) + map.shift[l] + (slack + f32::MIN_POSITIVE)
    });
    for ((row, sums), bounds) in room.rows.iter().zip(&room.sums).zip(bounds) {
        for l in 0..BLOCK {
            let product = (sums[HALF * BLOCK + l] - map.offset[l]) as f32 * row.unit * map.unit[l];
            bounds[l] = base[l] + product + (row.lost * map.length[l] + row.length * map.lost[l]);
        }
    }
}

/// Writes features as bytes about their mean. Returns a bound of the sum of any two lengths among the features and
/// their mean, infinite where they are too long to be bounded.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+avx512bw+fma", "x86_64+avx2+fma"))]
fn quantize(input: &Features, inputs: usize, points: usize, room: &mut PoolRoom) -> f32 {
    /// Added to a number, it leaves the nearest integer in the last bits.
    const ROUND: f32 = 12_582_912.0;
    let PoolRoom { quads, rows, mean, rest, .. } = room;
    let features = || input.values.chunks_exact(input.stride).take(points);
    mean.clear();
    mean.resize(inputs, 0.0);
    for row in features() {
        for (mean, v) in mean.iter_mut().zip(row) {
            *mean += v;
        }
    }
    for mean in mean.iter_mut() {
        *mean /= points as f32;
    }
    let floor = UNDERFLOW * (inputs as f32).sqrt();
    let rounding = 1.0 + inputs as f32 * f32::EPSILON;
    let length = |v: &[f32]| dot(v, v).sqrt() * rounding + floor;
    let mut longest = length(mean);
    let stride = inputs.div_ceil(4);
    quads.clear();
    quads.resize(whole_tiles(points) * stride, [0; 4]);
    rows.clear();
    rest.resize(inputs, 0.0);
    for (row, quads) in features().zip(quads.chunks_exact_mut(stride)) {
        let row = &row[..inputs];
        // Where a feature is no number, the mean is none, and stays.
        longest = larger(length(row), longest);
        if !longest.is_finite() {
            return f32::INFINITY;
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
        let length_of_bytes = (length_sq as f32).sqrt() * unit * rounding;
        rows.push(Row { unit, length: length_of_bytes, lost: length(rest) });
    }
    2.0 * longest
}

/// Bounds of the values at every point, and the highest of each channel.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn gather_bounds(products: &Products, graph: &Graph, upper: &mut [Lanes]) -> Lanes {
    let mut most = [f32::NEG_INFINITY; BLOCK];
    for ((row, center), upper) in graph.rows().zip(&products.center).zip(upper) {
        let of_neighbors = largest(&products.neighbor, row);
        for l in 0..BLOCK {
            upper[l] = center[l] + of_neighbors[l];
            most[l] = larger(upper[l], most[l]);
        }
    }
    most
}

/// The largest value of each channel before the rectifier. Bounds of `neighbor` are replaced by what they bound.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn search(
    block: &Block,
    input: &Features,
    graph: &Graph,
    neighbor: &mut [Lanes],
    upper: &[Lanes],
    most: &Lanes,
) -> Lanes {
    let inputs = block.center.weights.len() / BLOCK;
    let features = |i: usize| &input.values[i * input.stride..][..inputs];
    let mut best = [f32::NEG_INFINITY; BLOCK];
    // The points of the highest bounds first: they leave few others.
    for least in [most.map(f32::next_down), best] {
        let mut bar: Lanes = std::array::from_fn(|l| larger(least[l], best[l]));
        for (i, upper) in upper.iter().enumerate() {
            let mut any = false;
            for l in 0..BLOCK {
                any |= upper[l] > bar[l];
            }
            if !any {
                continue;
            }
            for l in 0..BLOCK {
                if upper[l] <= bar[l] {
                    continue;
                }
                let center = dot(block.center.row(l), features(i)) + block.center.shift[l];
                for &j in graph.row(i) {
                    let bound = &mut neighbor[j as usize][l];
                    if center + *bound > best[l] {
                        *bound = dot(block.neighbor.row(l), features(j as usize));
                        best[l] = larger(center + *bound, best[l]);
                    }
                }
                bar[l] = larger(best[l], bar[l]);
            }
        }
    }
    best
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

        fn apply(&self, reach: Option<f32>) -> Vec<f32> {
            let (mut products, mut room, mut gamma) = <(Products, PoolRoom, Vec<f32>)>::default();
            let Self { layer, features, graph } = self;
            let found = quantize(features, layer.inputs, graph.len(), &mut room);
            let reach = reach.unwrap_or(found);
            layer.apply_within(reach, features, graph, &mut products, &mut room, &mut gamma);
            gamma
        }

        /// The same bits as where nothing is left out.
        fn assert_exact(&self) {
            let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            assert_eq!(bits(self.apply(None)), bits(self.apply(Some(f32::INFINITY))));
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
