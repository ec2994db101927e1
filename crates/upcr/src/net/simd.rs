//! The products of inference in the processor's own instructions. Left to the compiler they are as fast only where it
//! sees the whole program at once; where it does not, a pass took three times as long.

#[allow(clippy::wildcard_imports)]
use std::arch::x86_64::*;

use super::lanes::{BLOCK, Bounds, Hit, Lanes, Quad, QuadLanes, Sums, TILE};

/// [`multiply`](super::kernel::multiply) in vectors of 16.
#[target_feature(enable = "avx512f")]
pub(super) fn multiply_avx512(rows: &[f32], stride: usize, panel: &[Lanes], init: &Lanes, out: &mut [Lanes]) {
    let init = load_512(init);
    for (rows, out) in rows.chunks_exact(TILE * stride).zip(out.chunks_exact_mut(TILE)) {
        let mut sums = [init; TILE];
        for (weights, column) in panel.iter().zip(columns(rows, stride)) {
            let weights = load_512(weights);
            for (sums, x) in sums.iter_mut().zip(column) {
                let x = _mm512_set1_ps(x);
                for (sum, w) in sums.iter_mut().zip(weights) {
                    *sum = _mm512_fmadd_ps(x, w, *sum);
                }
            }
        }
        for (out, sums) in out.iter_mut().zip(sums) {
            for (out, sum) in out.as_chunks_mut::<16>().0.iter_mut().zip(sums) {
                // SAFETY: writes the 16 values that `out` refers to.
                unsafe { _mm512_storeu_ps(out.as_mut_ptr(), sum) };
            }
        }
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load_512(lanes: &Lanes) -> [__m512; BLOCK / 16] {
    let (low, high) = (lanes[..16].as_ptr(), lanes[16..].as_ptr());
    // SAFETY: both halves of a block are 16 values.
    unsafe { [_mm512_loadu_ps(low), _mm512_loadu_ps(high)] }
}

/// [`multiply`](super::kernel::multiply) in vectors of 8, half a block at a time: what the registers hold.
#[target_feature(enable = "avx2,fma")]
pub(super) fn multiply_avx2(rows: &[f32], stride: usize, panel: &[Lanes], init: &Lanes, out: &mut [Lanes]) {
    for half in 0..2 {
        let init = load_256(init, half);
        for (rows, out) in rows.chunks_exact(TILE * stride).zip(out.chunks_exact_mut(TILE)) {
            let mut sums = [init; TILE];
            for (weights, column) in panel.iter().zip(columns(rows, stride)) {
                let weights = load_256(weights, half);
                for (sums, x) in sums.iter_mut().zip(column) {
                    let x = _mm256_set1_ps(x);
                    for (sum, w) in sums.iter_mut().zip(weights) {
                        *sum = _mm256_fmadd_ps(x, w, *sum);
                    }
                }
            }
            for (out, sums) in out.iter_mut().zip(sums) {
                for (out, sum) in out[16 * half..].as_chunks_mut::<8>().0.iter_mut().zip(sums) {
                    // SAFETY: writes the 8 values that `out` refers to.
                    unsafe { _mm256_storeu_ps(out.as_mut_ptr(), sum) };
                }
            }
        }
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn load_256(lanes: &Lanes, half: usize) -> [__m256; 2] {
    let lanes = &lanes[16 * half..][..16];
    let (low, high) = (lanes[..8].as_ptr(), lanes[8..].as_ptr());
    // SAFETY: both are 8 values.
    unsafe { [_mm256_loadu_ps(low), _mm256_loadu_ps(high)] }
}

/// [`dot`](super::kernel::dot) in vectors of 16.
#[target_feature(enable = "avx512f,avx,fma")]
pub(super) fn dot_avx512(a: &[f32], b: &[f32]) -> f32 {
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks(), b.as_chunks());
    let mut sums = [_mm512_setzero_ps(); BLOCK / 16];
    let rest = (!rest_a.is_empty()).then(|| (padded(rest_a), padded(rest_b)));
    for (a, b) in a.iter().zip(b).chain(rest.as_ref().map(|(a, b)| (a, b))) {
        for ((sum, a), b) in sums.iter_mut().zip(load_512(a)).zip(load_512(b)) {
            *sum = _mm512_fmadd_ps(a, b, *sum);
        }
    }
    let sum = _mm512_add_ps(sums[0], sums[1]);
    let high = _mm256_castpd_ps(_mm512_extractf64x4_pd::<1>(_mm512_castps_pd(sum)));
    total(_mm256_add_ps(_mm512_castps512_ps256(sum), high))
}

/// [`dot`](super::kernel::dot) in vectors of 8.
#[target_feature(enable = "avx2,fma")]
pub(super) fn dot_avx2(a: &[f32], b: &[f32]) -> f32 {
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks(), b.as_chunks());
    let mut sums = [[_mm256_setzero_ps(); 2]; 2];
    let rest = (!rest_a.is_empty()).then(|| (padded(rest_a), padded(rest_b)));
    for (a, b) in a.iter().zip(b).chain(rest.as_ref().map(|(a, b)| (a, b))) {
        for (half, sums) in sums.iter_mut().enumerate() {
            for ((sum, a), b) in sums.iter_mut().zip(load_256(a, half)).zip(load_256(b, half)) {
                *sum = _mm256_fmadd_ps(a, b, *sum);
            }
        }
    }
    let [[a, b], [c, d]] = sums;
    total(_mm256_add_ps(_mm256_add_ps(a, c), _mm256_add_ps(b, d)))
}

/// Values of less than a block, with zeros after them.
#[inline]
fn padded(values: &[f32]) -> Lanes {
    let mut lanes = [0.0; BLOCK];
    lanes[..values.len()].copy_from_slice(values);
    lanes
}

/// The sum of all eight, half by half.
#[inline]
#[target_feature(enable = "avx")]
fn total(sums: __m256) -> f32 {
    let sums = _mm_add_ps(_mm256_castps256_ps128(sums), _mm256_extractf128_ps::<1>(sums));
    let sums = _mm_add_ps(sums, _mm_movehl_ps(sums, sums));
    _mm_cvtss_f32(_mm_add_ss(sums, _mm_shuffle_ps::<1>(sums, sums)))
}

/// [`multiply_quads`](super::kernel::multiply_quads) in vectors of 16.
#[target_feature(enable = "avx512f,avx512vnni")]
pub(super) fn multiply_quads_avx512(rows: &[Quad], stride: usize, panel: &[QuadLanes], out: &mut [Sums]) {
    for (rows, out) in rows.chunks_exact(TILE * stride).zip(out.chunks_exact_mut(TILE)) {
        let mut sums = [[_mm512_setzero_si512(); 4]; TILE];
        for (weights, column) in panel.iter().zip(columns(rows, stride)) {
            let weights = [0, 1, 2, 3].map(|v| weights[16 * v..][..16].as_ptr().cast());
            // SAFETY: each points to 16 times four bytes.
            let weights = unsafe {
                [
                    _mm512_loadu_si512(weights[0]),
                    _mm512_loadu_si512(weights[1]),
                    _mm512_loadu_si512(weights[2]),
                    _mm512_loadu_si512(weights[3]),
                ]
            };
            for (sums, x) in sums.iter_mut().zip(column) {
                let x = _mm512_set1_epi32(i32::from_ne_bytes(x));
                for (sum, w) in sums.iter_mut().zip(weights) {
                    *sum = _mm512_dpbusd_epi32(*sum, x, w);
                }
            }
        }
        for (out, sums) in out.iter_mut().zip(sums) {
            for (out, sum) in out.as_chunks_mut::<16>().0.iter_mut().zip(sums) {
                // SAFETY: writes the 16 values that `out` refers to.
                unsafe { _mm512_storeu_si512(out.as_mut_ptr().cast(), sum) };
            }
        }
    }
}

/// [`multiply_quads`](super::kernel::multiply_quads) in vectors of 8, two at a time: what the registers hold.
#[target_feature(enable = "avx2")]
pub(super) fn multiply_quads_avx2(rows: &[Quad], stride: usize, panel: &[QuadLanes], out: &mut [Sums]) {
    let ones = _mm256_set1_epi16(1);
    for at in (0..2 * BLOCK).step_by(16) {
        for (rows, out) in rows.chunks_exact(TILE * stride).zip(out.chunks_exact_mut(TILE)) {
            let mut sums = [[_mm256_setzero_si256(); 2]; TILE];
            for (weights, column) in panel.iter().zip(columns(rows, stride)) {
                let weights = &weights[at..][..16];
                let (low, high) = (weights[..8].as_ptr().cast(), weights[8..].as_ptr().cast());
                // SAFETY: both point to 8 times four bytes.
                let weights = unsafe { [_mm256_loadu_si256(low), _mm256_loadu_si256(high)] };
                for (sums, x) in sums.iter_mut().zip(column) {
                    let x = _mm256_set1_epi32(i32::from_ne_bytes(x));
                    for (sum, w) in sums.iter_mut().zip(weights) {
                        // Two products of a byte and at most 64 fit into 16 bits.
                        let pairs = _mm256_maddubs_epi16(x, w);
                        *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(pairs, ones));
                    }
                }
            }
            for (out, sums) in out.iter_mut().zip(sums) {
                for (out, sum) in out[at..].as_chunks_mut::<8>().0.iter_mut().zip(sums) {
                    // SAFETY: writes the 8 values that `out` refers to.
                    unsafe { _mm256_storeu_si256(out.as_mut_ptr().cast(), sum) };
                }
            }
        }
    }
}

/// [`above`](super::kernel::above) in vectors of 32.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) fn above_avx512(bounds: &[Bounds], bar: &Bounds, hits: &mut Vec<Hit>) {
    // SAFETY: reads the 32 values of a block.
    let load = |bounds: &Bounds| unsafe { _mm512_loadu_epi16(bounds.as_ptr()) };
    let bar = load(bar);
    for (point, bounds) in (0..).zip(bounds) {
        let channels = _mm512_cmpgt_epi16_mask(load(bounds), bar);
        if channels != 0 {
            hits.push(Hit { point, channels });
        }
    }
}

/// [`above`](super::kernel::above) in vectors of 16.
#[target_feature(enable = "avx2")]
pub(super) fn above_avx2(bounds: &[Bounds], bar: &Bounds, hits: &mut Vec<Hit>) {
    let load = |bounds: &Bounds| {
        let (low, high) = (bounds[..16].as_ptr(), bounds[16..].as_ptr());
        // SAFETY: both halves of a block are 16 values.
        unsafe { [_mm256_loadu_si256(low.cast()), _mm256_loadu_si256(high.cast())] }
    };
    let bar = load(bar);
    for (point, bounds) in (0..).zip(bounds) {
        let [low, high] = load(bounds);
        let (low, high) = (_mm256_cmpgt_epi16(low, bar[0]), _mm256_cmpgt_epi16(high, bar[1]));
        // Packing works on quarters of the two.
        let bytes = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packs_epi16(low, high));
        let channels = _mm256_movemask_epi8(bytes).cast_unsigned();
        if channels != 0 {
            hits.push(Hit { point, channels });
        }
    }
}

/// [`at_most`](super::kernel::at_most) in a vector of 16.
#[inline]
#[target_feature(enable = "avx512f")]
pub(super) fn at_most_avx512(values: &[f32; 16], most: f32) -> u32 {
    // SAFETY: reads 16 values.
    let values = unsafe { _mm512_loadu_ps(values.as_ptr()) };
    _mm512_cmp_ps_mask::<_CMP_LE_OQ>(values, _mm512_set1_ps(most)).into()
}

/// [`at_most`](super::kernel::at_most) in vectors of 8.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) fn at_most_avx2(values: &[f32; 16], most: f32) -> u32 {
    let most = _mm256_set1_ps(most);
    let [low, high] = [0, 8].map(|at| {
        // SAFETY: reads half of the 16 values.
        let values = unsafe { _mm256_loadu_ps(values[at..].as_ptr()) };
        _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(values, most)).cast_unsigned()
    });
    low | high << 8
}

/// The columns of a tile of rows.
#[inline(always)]
fn columns<T: Copy>(rows: &[T], stride: usize) -> impl Iterator<Item = [T; TILE]> {
    let row = |r: usize| rows[r * stride..][..stride].iter();
    let columns = row(0).zip(row(1)).zip(row(2)).zip(row(3)).zip(row(4)).zip(row(5));
    columns.map(|(((((a, b), c), d), e), f)| [*a, *b, *c, *d, *e, *f])
}
