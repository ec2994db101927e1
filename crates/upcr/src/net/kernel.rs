//! The inner loops of inference, for several instruction sets.

use multiversion::{multiversion, target::target_cfg_f};

use super::Graph;

/// Channels that are worked on together: their products over a cloud stay in cache until they are gathered.
pub(super) const BLOCK: usize = 32;
/// Points that are multiplied together.
pub(super) const TILE: usize = 6;

/// One value of a block's channels each.
pub(super) type Lanes = [f32; BLOCK];

/// The number of rows that hold `points` in whole tiles.
pub(super) fn whole_tiles(points: usize) -> usize {
    points.next_multiple_of(TILE)
}

/// `out[i] = init + Σₖ rows[i·stride + k] · panel[k]`, for whole tiles of rows.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
pub(super) fn multiply(rows: &[f32], stride: usize, panel: &[Lanes], init: &Lanes, out: &mut [Lanes]) {
    const WIDE: bool = target_cfg_f!(target_feature = "avx512f");
    const FUSED: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    // As many accumulators as the registers hold: two vectors for each row of a tile.
    match (WIDE, FUSED) {
        (true, _) => multiply_by::<32, true>(rows, stride, panel, init, out),
        (_, true) => multiply_by::<16, true>(rows, stride, panel, init, out),
        _ => multiply_by::<8, false>(rows, stride, panel, init, out),
    }
}

/// `WIDTH` channels at a time; `FUSED` where the processor multiplies and adds in one step.
#[inline(always)]
fn multiply_by<const WIDTH: usize, const FUSED: bool>(
    rows: &[f32],
    stride: usize,
    panel: &[Lanes],
    init: &Lanes,
    out: &mut [Lanes],
) {
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
                        sums[l] = if FUSED { x.mul_add(w[l], sums[l]) } else { x * w[l] + sums[l] };
                    }
                }
            }
            for (out, sums) in out.iter_mut().zip(&sums) {
                out[at..at + WIDTH].copy_from_slice(sums);
            }
        }
    }
}

/// A layer's values of one block: `LeakyReLU(center[i] + max over neighbours j of neighbor[j])` for each point i,
/// written to `out[i·stride..]`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn gather(
    center: &[Lanes],
    neighbor: &[Lanes],
    graph: &Graph,
    slope: f32,
    out: &mut [f32],
    stride: usize,
) {
    for ((row, center), out) in graph.rows().zip(center).zip(out.chunks_mut(stride)) {
        let most = largest(neighbor, row);
        for l in 0..BLOCK {
            out[l] = leaky(center[l] + most[l], slope);
        }
    }
}

/// The maximum over all points of what [`gather`] gives.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn gather_all(center: &[Lanes], neighbor: &[Lanes], graph: &Graph, slope: f32) -> Lanes {
    let mut all = [f32::NEG_INFINITY; BLOCK];
    for (row, center) in graph.rows().zip(center) {
        let most = largest(neighbor, row);
        for l in 0..BLOCK {
            all[l] = larger(all[l], center[l] + most[l]);
        }
    }
    // The rectifier grows: the largest value stays the largest.
    all.map(|v| leaky(v, slope))
}

/// The channels' largest values over the points in `row`.
#[inline(always)]
fn largest(values: &[Lanes], row: &[u32]) -> Lanes {
    let mut most = [f32::NEG_INFINITY; BLOCK];
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
fn larger(a: f32, b: f32) -> f32 {
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
    for (i, (row, out)) in graph.rows().zip(out.chunks_mut(stride)).enumerate() {
        let mut most = [f32::NEG_INFINITY; BLOCK];
        for (slot, &j) in row.iter().enumerate() {
            let mut sums = neighbor[j as usize];
            let values = &edges[(i * graph.k + slot) * dim..][..dim];
            for (&x, w) in values.iter().zip(weights) {
                for l in 0..BLOCK {
                    sums[l] = if FUSED { x.mul_add(w[l], sums[l]) } else { x * w[l] + sums[l] };
                }
            }
            for l in 0..BLOCK {
                most[l] = larger(most[l], sums[l]);
            }
        }
        for l in 0..BLOCK {
            out[l] = leaky(most[l], slope);
        }
    }
}
