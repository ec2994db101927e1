//! The inner loops of inference, for several instruction sets.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};

use multiversion::{multiversion, target::target_cfg_f};

use super::Graph;
use super::graph::PairedRows;
use super::lanes::{BLOCK, Bounds, Hit, Lanes, Quad, QuadLanes, Sums, TILE};
#[cfg(target_arch = "x86_64")]
use super::simd;

/// A row is brought into cache when the one so many before it is written: stores that wait for their lines one by one
/// took a quarter of the time of [`gather`].
const AHEAD: usize = 8;

/// Whether every processor that this is built for multiplies and adds in one step.
const FUSED: bool = cfg!(any(target_feature = "fma", target_arch = "aarch64"));

/// `out[i] = init + Σₖ rows[i·stride + k] · panel[k]`, for whole tiles of rows.
pub(super) fn multiply(rows: &[f32], stride: usize, panel: &[Lanes], init: &Lanes, out: &mut [Lanes]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the processor has what it needs.
        return unsafe { simd::multiply_avx512(rows, stride, panel, init, out) };
    } else if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: as above.
        return unsafe { simd::multiply_avx2(rows, stride, panel, init, out) };
    }
    multiply_portable(rows, stride, panel, init, out);
}

fn multiply_portable(rows: &[f32], stride: usize, panel: &[Lanes], init: &Lanes, out: &mut [Lanes]) {
    /// Two vectors of four for each row of a tile fill the registers.
    const WIDTH: usize = 8;
    for at in (0..BLOCK).step_by(WIDTH) {
        let mut start = [0.0; WIDTH];
        start.copy_from_slice(&init[at..at + WIDTH]);
        for (rows, out) in rows.chunks_exact(TILE * stride).zip(out.chunks_exact_mut(TILE)) {
            let row = |r: usize| rows[r * stride..][..panel.len()].iter();
            let columns = row(0).zip(row(1)).zip(row(2)).zip(row(3)).zip(row(4)).zip(row(5));
            let mut sums = [start; TILE];
            for (weights, (((((a, b), c), d), e), f)) in panel.iter().zip(columns) {
                let mut w = [0.0; WIDTH];
                w.copy_from_slice(&weights[at..at + WIDTH]);
                for (sums, &x) in sums.iter_mut().zip([a, b, c, d, e, f]) {
                    for l in 0..WIDTH {
                        sums[l] = multiply_add::<FUSED>(x, w[l], sums[l]);
                    }
                }
            }
            for (out, sums) in out.iter_mut().zip(&sums) {
                out[at..at + WIDTH].copy_from_slice(sums);
            }
        }
    }
}

/// `x·w + sum`; `FUSED` where the processor multiplies and adds in one step.
#[inline(always)]
fn multiply_add<const FUSED: bool>(x: f32, w: f32, sum: f32) -> f32 {
    if FUSED { x.mul_add(w, sum) } else { x * w + sum }
}

/// An inner product of two rows of one length: a block's lanes are summed apart, then added half to half.
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("fma") {
        // SAFETY: the processor has what it needs.
        return unsafe { simd::dot_avx512(a, b) };
    } else if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: as above.
        return unsafe { simd::dot_avx2(a, b) };
    }
    dot_portable(a, b)
}

fn dot_portable(a: &[f32], b: &[f32]) -> f32 {
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<BLOCK>(), b.as_chunks::<BLOCK>());
    let mut sums = [0.0; BLOCK];
    for (a, b) in a.iter().zip(b) {
        for l in 0..BLOCK {
            sums[l] = multiply_add::<FUSED>(a[l], b[l], sums[l]);
        }
    }
    for (sum, (a, b)) in sums.iter_mut().zip(rest_a.iter().zip(rest_b)) {
        *sum = multiply_add::<FUSED>(*a, *b, *sum);
    }
    let mut half = BLOCK / 2;
    while half > 0 {
        for l in 0..half {
            sums[l] += sums[l + half];
        }
        half /= 2;
    }
    sums[0]
}

/// `out[i] = Σₖ rows[i·stride + k] · panel[k]`, for whole tiles of rows, exactly: quads are inner products of four
/// bytes. Those of the panel lie within ±[`highest_weight`].
pub(super) fn multiply_quads(rows: &[Quad], stride: usize, panel: &[QuadLanes], out: &mut [Sums]) {
    #[cfg(target_arch = "x86_64")]
    if has_quads() {
        // SAFETY: the processor has what it needs.
        return unsafe { simd::multiply_quads_avx512(rows, stride, panel, out) };
    } else if is_x86_feature_detected!("avx2") {
        // SAFETY: as above.
        return unsafe { simd::multiply_quads_avx2(rows, stride, panel, out) };
    }
    multiply_quads_portable(rows, stride, panel, out);
}

/// The largest weight of a quad that this processor multiplies exactly.
pub(super) fn highest_weight() -> f64 {
    #[cfg(target_arch = "x86_64")]
    if !has_quads() && is_x86_feature_detected!("avx2") {
        // Two products with a byte have to fit into 16 bits.
        return 64.0;
    }
    127.0
}

#[cfg(target_arch = "x86_64")]
fn has_quads() -> bool {
    is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512f")
}

fn multiply_quads_portable(rows: &[Quad], stride: usize, panel: &[QuadLanes], out: &mut [Sums]) {
    for (row, out) in rows.chunks_exact(stride).zip(out) {
        let mut sums = [0; 2 * BLOCK];
        for (x, weights) in row.iter().zip(panel) {
            let x = x.map(i32::from);
            for (sum, w) in sums.iter_mut().zip(weights) {
                let w = w.map(i32::from);
                *sum += x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3];
            }
        }
        *out = sums;
    }
}

/// A layer's values of one block: `LeakyReLU(center[i] + max over neighbours j of neighbor[j])` for each point i,
/// written to `out[i·stride..]`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn gather(
    center: &[Lanes],
    neighbor: &[Lanes],
    rows: &PairedRows,
    slope: f32,
    out: &mut [f32],
    stride: usize,
) {
    let mut out = out.chunks_mut(stride).filter_map(<[f32]>::first_chunk_mut::<BLOCK>);
    for ([both, first, second], center) in rows.pairs().zip(center.chunks_exact(2)) {
        let shared = largest([f32::NEG_INFINITY; BLOCK], neighbor, both);
        for (center, alone) in center.iter().zip([first, second]) {
            // Whole tiles have a row beyond the last of an odd number of points.
            let Some(out) = out.next() else { break };
            prefetch(out.as_ptr().wrapping_add(AHEAD * stride), BLOCK);
            let mut values = largest(shared, neighbor, alone);
            for l in 0..BLOCK {
                values[l] = leaky(center[l] + values[l], slope);
            }
            *out = values;
        }
    }
}

/// Has `len` values brought into cache.
#[inline(always)]
#[cfg_attr(not(target_arch = "x86_64"), allow(unused_variables))]
pub(super) fn prefetch(values: *const f32, len: usize) {
    #[cfg(target_arch = "x86_64")]
    for line in (0..len).step_by(16) {
        // SAFETY: it is a hint, whatever the address.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(values.wrapping_add(line).cast()) };
    }
}

/// The channels' largest values of `most` and over the points in `row`.
#[inline(always)]
fn largest(mut most: Lanes, values: &[Lanes], row: &[u32]) -> Lanes {
    for &j in row {
        let values = &values[j as usize];
        for l in 0..BLOCK {
            most[l] = larger(most[l], values[l]);
        }
    }
    most
}

/// One instruction, unlike `f32::max`, which minds NaN.
#[inline(always)]
pub(super) fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The leaky rectifier of a slope from 0 to 1.
#[inline(always)]
pub(super) fn leaky(x: f32, slope: f32) -> f32 {
    larger(x, slope * x)
}

/// The values of one block of `LeakyReLU(max over the edges i → j of neighbor[j] + Σ edge value · weight)` for each
/// point i, written to `out[i·stride..]`. An edge has `weights.len()` values, which follow the graph's rows.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
pub(super) fn embed(
    edges: &[f32],
    weights: &[Lanes],
    neighbor: &[Lanes],
    graph: &Graph,
    slope: f32,
    out: &mut [f32],
    stride: usize,
) {
    const FUSED: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    embed_by::<FUSED>(edges, weights, neighbor, graph, slope, out, stride);
}

#[inline(always)]
fn embed_by<const FUSED: bool>(
    edges: &[f32],
    weights: &[Lanes],
    neighbor: &[Lanes],
    graph: &Graph,
    slope: f32,
    out: &mut [f32],
    stride: usize,
) {
    let dim = weights.len();
    let out = out.chunks_mut(stride).filter_map(<[f32]>::first_chunk_mut::<BLOCK>);
    for (i, (row, out)) in graph.rows().zip(out).enumerate() {
        prefetch(out.as_ptr().wrapping_add(AHEAD * stride), BLOCK);
        let mut most = [f32::NEG_INFINITY; BLOCK];
        for (slot, &j) in row.iter().enumerate() {
            let mut sums = neighbor[j as usize];
            let values = &edges[(i * graph.k + slot) * dim..][..dim];
            for (&x, w) in values.iter().zip(weights) {
                for l in 0..BLOCK {
                    sums[l] = multiply_add::<FUSED>(x, w[l], sums[l]);
                }
            }
            for l in 0..BLOCK {
                most[l] = larger(most[l], sums[l]);
            }
        }
        for value in &mut most {
            *value = leaky(*value, slope);
        }
        *out = most;
    }
}

/// Finds the points and channels whose bounds exceed `bar`.
pub(super) fn above(bounds: &[Bounds], bar: &Bounds, hits: &mut Vec<Hit>) {
    hits.clear();
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512bw") {
        // SAFETY: the processor has what it needs.
        return unsafe { simd::above_avx512(bounds, bar, hits) };
    } else if is_x86_feature_detected!("avx2") {
        // SAFETY: as above.
        return unsafe { simd::above_avx2(bounds, bar, hits) };
    }
    above_portable(bounds, bar, hits);
}

fn above_portable(bounds: &[Bounds], bar: &Bounds, hits: &mut Vec<Hit>) {
    for (point, bounds) in (0..).zip(bounds) {
        let above = (0..BLOCK).filter(|&l| bounds[l] > bar[l]);
        let channels = above.fold(0, |channels, l| channels | 1 << l);
        if channels != 0 {
            hits.push(Hit { point, channels });
        }
    }
}

/// A bit for each value that does not exceed `most`.
pub(super) fn at_most(values: &[f32; 16], most: f32) -> u32 {
    (0..16).filter(|&l| values[l] <= most).fold(0, |mask, l| mask | 1 << l)
}

/// The places of the ones in `mask`.
#[inline(always)]
pub(super) fn places(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let first = (mask != 0).then(|| mask.trailing_zeros() as usize);
        mask &= mask.wrapping_sub(1);
        first
    })
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const POINTS: usize = 5 * TILE;

    /// Rows of 1 to 70 values, of which products and sums are exact.
    fn rows(rng: &mut ChaCha8Rng) -> (usize, Vec<f32>) {
        let stride = rng.random_range(1..70);
        (stride, (0..POINTS * stride).map(|_| f32::from(rng.random_range(-20_i8..20))).collect())
    }

    #[test]
    fn products_are_the_same_in_every_instruction_set() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..50 {
            let (stride, rows) = rows(&mut rng);
            let panel: Vec<Lanes> =
                (0..stride).map(|k| std::array::from_fn(|l| ((k * 31 + l * 7) % 23) as f32 - 11.0)).collect();
            let init = std::array::from_fn(|l| l as f32);
            let mut expected = vec![[0.0; BLOCK]; POINTS];
            multiply_portable(&rows, stride, &panel, &init, &mut expected);
            let mut found = vec![[0.0; BLOCK]; POINTS];
            if is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has what it needs.
                unsafe { simd::multiply_avx512(&rows, stride, &panel, &init, &mut found) };
                assert_eq!(found, expected);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                found.fill([0.0; BLOCK]);
                // SAFETY: as above.
                unsafe { simd::multiply_avx2(&rows, stride, &panel, &init, &mut found) };
                assert_eq!(found, expected);
            }
        }
    }

    #[test]
    fn inner_products_are_the_same_in_every_instruction_set() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for _ in 0..50 {
            let (stride, rows) = rows(&mut rng);
            let (a, b) = (&rows[..stride], &rows[stride..2 * stride]);
            let expected = dot_portable(a, b);
            assert_eq!(expected, a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>());
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("fma") {
                // SAFETY: the processor has what it needs.
                assert_eq!(unsafe { simd::dot_avx512(a, b) }, expected);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                // SAFETY: as above.
                assert_eq!(unsafe { simd::dot_avx2(a, b) }, expected);
            }
        }
    }

    #[test]
    fn products_of_bytes_are_the_same_in_every_instruction_set() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let most = 64;
        for round in 0..50 {
            let stride = rng.random_range(1..40);
            // The last rounds are of extreme values alone.
            let mut byte = || if round < 40 { rng.random() } else { u8::MAX };
            let rows: Vec<Quad> = (0..POINTS * stride).map(|_| std::array::from_fn(|_| byte())).collect();
            let mut weight =
                || if round < 40 { rng.random_range(-most..=most) } else { [-most, most][round % 2] };
            let panel: Vec<QuadLanes> =
                (0..stride).map(|_| std::array::from_fn(|_| std::array::from_fn(|_| weight()))).collect();
            let mut expected = vec![[0; 2 * BLOCK]; POINTS];
            multiply_quads_portable(&rows, stride, &panel, &mut expected);
            let mut found = vec![[0; 2 * BLOCK]; POINTS];
            if has_quads() {
                // SAFETY: the processor has what it needs.
                unsafe { simd::multiply_quads_avx512(&rows, stride, &panel, &mut found) };
                assert_eq!(found, expected);
            }
            if is_x86_feature_detected!("avx2") {
                found.fill([0; 2 * BLOCK]);
                // SAFETY: as above.
                unsafe { simd::multiply_quads_avx2(&rows, stride, &panel, &mut found) };
                assert_eq!(found, expected);
            }
        }
    }

    #[test]
    fn points_above_a_bar_are_the_same_in_every_instruction_set() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut bounds = || -> Bounds { std::array::from_fn(|_| rng.random_range(-3..3) * 10_000) };
        for _ in 0..50 {
            let (rows, bar): (Vec<_>, _) = ((0..20).map(|_| bounds()).collect(), bounds());
            let [mut expected, mut found] = [vec![], vec![]];
            above_portable(&rows, &bar, &mut expected);
            if is_x86_feature_detected!("avx512bw") {
                // SAFETY: the processor has what it needs.
                unsafe { simd::above_avx512(&rows, &bar, &mut found) };
                assert_eq!(found, expected);
            }
            if is_x86_feature_detected!("avx2") {
                found.clear();
                // SAFETY: as above.
                unsafe { simd::above_avx2(&rows, &bar, &mut found) };
                assert_eq!(found, expected);
            }
        }
    }

    #[test]
    fn values_within_a_limit_are_the_same_in_every_instruction_set() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for _ in 0..50 {
            let mut value = || [-1.0, 0.0, 1.0, f32::INFINITY, f32::NAN][rng.random_range(0..5)];
            let (values, most) = (std::array::from_fn(|_| value()), value());
            let expected = at_most(&values, most);
            if is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has what it needs.
                assert_eq!(unsafe { simd::at_most_avx512(&values, most) }, expected);
            }
            if is_x86_feature_detected!("avx2") {
                // SAFETY: as above.
                assert_eq!(unsafe { simd::at_most_avx2(&values, most) }, expected);
            }
        }
    }
}
