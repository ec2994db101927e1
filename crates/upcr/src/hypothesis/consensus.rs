//! Poses from matches that agree with each other: second-order spatial compatibility
//! (SC²-PCR, Chen, Sun, Yang & Tao, CVPR 2022), on bit sets.
//!
//! Two matches are compatible where both clouds put the same distance, and the same angle of normals, between
//! them. Two wrong matches are compatible by chance; that many others are compatible with both is hardly ever
//! chance, so the number of common neighbours ranks pairs. No random choice is made.

use multiversion::multiversion;
use rayon::prelude::*;

use super::{Hypothesis, HypothesisSource, Match, Problem};
use crate::{refine::align, settings::Method, transform::Rigid};

/// Matches considered, the most distinctive first.
const MAX_MATCHES: usize = 512;
/// Most distinctive matches that may seed a consensus set, and sets that become poses.
const SEEDS: usize = 256;
const CONSENSUSES: usize = 32;
/// Matches in a seed's first consensus set.
const CONSENSUS: usize = 20;
/// Normals of compatible matches enclose the same angle up to this difference of cosines.
const COSINE_TOLERANCE: f32 = 0.35;

pub(super) struct Consensus;

impl HypothesisSource for Consensus {
    fn method(&self) -> Method {
        Method::Consensus
    }

    fn needs_matches(&self) -> bool {
        true
    }

    fn propose(&self, problem: &Problem) -> Vec<Hypothesis> {
        let (matches, call) = (most_distinctive(problem.matches), problem.call);
        let graph = Compatibility::new(&matches, problem.tolerance);
        let mut seeds: Vec<(u64, u32)> = (0..matches.len().min(SEEDS) as u32)
            .into_par_iter()
            // A match that is not looked at any more seeds nothing.
            .map(|i| (if call.is_over() { 0 } else { graph.second_order_degree(i as usize) }, i))
            .collect();
        seeds.sort_unstable_by_key(|&(degree, i)| (std::cmp::Reverse(degree), i));
        // Matches of one consensus lead to one pose: the best of them speaks for the others.
        let mut spoken_for = vec![false; matches.len()];
        let mut consensuses = Vec::new();
        for &(degree, seed) in &seeds {
            if degree > 0 && !spoken_for[seed as usize] && consensuses.len() < CONSENSUSES {
                let consensus = graph.consensus(seed as usize);
                for &(i, _) in &consensus {
                    spoken_for[i] = true;
                }
                consensuses.push(consensus);
            }
        }
        let mut hypotheses: Vec<Hypothesis> = consensuses
            .par_iter()
            .filter_map(|consensus| {
                let pose = align(consensus.iter().map(|&(i, w)| {
                    let m = &matches[i];
                    (m.source, m.target, w)
                }))?;
                let (pose, support) = grow(&matches, pose, problem.tolerance);
                (support >= 3).then_some(Hypothesis { pose, method: self.method(), support })
            })
            .collect();
        hypotheses.sort_by_key(|h| std::cmp::Reverse(h.support));
        super::drop_repeats(&mut hypotheses, problem);
        hypotheses
    }
}

/// Mutual matches before others, distinctive before common, at most [`MAX_MATCHES`].
fn most_distinctive(matches: &[Match]) -> Vec<Match> {
    let mut chosen = matches.to_vec();
    chosen.sort_by(|a, b| b.mutual.cmp(&a.mutual).then(a.ratio.total_cmp(&b.ratio)));
    chosen.truncate(MAX_MATCHES);
    chosen
}

/// Least squares over the matches that agree with the pose, until they stay the same.
fn grow(matches: &[Match], mut pose: Rigid, tolerance: f32) -> (Rigid, usize) {
    const ROUNDS: usize = 4;
    let mut support = 0;
    for _ in 0..ROUNDS {
        let inliers: Vec<&Match> = matches.iter().filter(|m| m.agrees_with(&pose, tolerance)).collect();
        if inliers.len() <= support {
            break;
        }
        support = inliers.len();
        let Some(next) = align(inliers.iter().map(|m| (m.source, m.target, 1.0))) else { break };
        pose = next;
    }
    (pose, support)
}

/// Which matches are compatible with which, a bit a pair.
struct Compatibility {
    count: usize,
    words: usize,
    bits: Vec<u64>,
}

impl Compatibility {
    fn new(matches: &[Match], tolerance: f32) -> Self {
        let count = matches.len();
        let words = count.div_ceil(64);
        let blocks: Vec<Block> = matches.chunks(64).map(Block::new).collect();
        let mut bits = vec![0u64; words * count];
        bits.par_chunks_mut(words.max(1)).with_min_len(32).enumerate().for_each(|(i, row)| {
            fill_row(&matches[i], &blocks, tolerance, row);
        });
        Self { count, words, bits }
    }

    fn row(&self, i: usize) -> &[u64] {
        &self.bits[i * self.words..(i + 1) * self.words]
    }

    /// With how many matches each match is compatible that is compatible with `i`; zero for those that are not.
    fn common(&self, i: usize) -> Vec<u32> {
        let mut common = vec![0; self.count];
        common_bits(self.row(i), &self.bits, self.words, &mut common);
        common
    }

    /// Σ over compatible matches of the compatible matches in common.
    fn second_order_degree(&self, i: usize) -> u64 {
        self.common(i).into_iter().map(u64::from).sum()
    }

    /// The seed and the matches with which it has most in common, with that number as weight.
    fn consensus(&self, seed: usize) -> Vec<(usize, f64)> {
        let mut ranked: Vec<(u32, usize)> =
            self.common(seed).into_iter().zip(0..).filter(|&(common, _)| common > 0).collect();
        ranked.sort_unstable_by_key(|&(common, j)| (std::cmp::Reverse(common), j));
        ranked.truncate(CONSENSUS);
        let most = ranked.first().map_or(1, |r| r.0).max(1);
        std::iter::once((seed, f64::from(most)))
            .chain(ranked.into_iter().map(|(common, j)| (j, f64::from(common))))
            .collect()
    }
}

/// For every bit set in `row`, how many bits that row of `bits` has in common with it.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512vpopcntdq+popcnt", "x86_64+avx2+popcnt"))]
fn common_bits(row: &[u64], bits: &[u64], words: usize, common: &mut [u32]) {
    for (j, out) in common.iter_mut().enumerate() {
        if row[j / 64] >> (j % 64) & 1 == 1 {
            let other = &bits[j * words..(j + 1) * words];
            *out = row.iter().zip(other).map(|(a, b)| (a & b).count_ones()).sum();
        }
    }
}

/// 64 matches by coordinate.
struct Block {
    source: [[f32; 64]; 3],
    target: [[f32; 64]; 3],
    source_normal: [[f32; 64]; 3],
    target_normal: [[f32; 64]; 3],
}

impl Block {
    /// Up to 64 matches; what is left is filled with NaN, which nothing is compatible with.
    fn new(matches: &[Match]) -> Self {
        let mut block = Self {
            source: [[f32::NAN; 64]; 3],
            target: [[f32::NAN; 64]; 3],
            source_normal: [[f32::NAN; 64]; 3],
            target_normal: [[f32::NAN; 64]; 3],
        };
        for (l, m) in matches.iter().enumerate() {
            for k in 0..3 {
                block.source[k][l] = m.source[k];
                block.target[k][l] = m.target[k];
                block.source_normal[k][l] = m.source_normal[k];
                block.target_normal[k][l] = m.target_normal[k];
            }
        }
        block
    }
}

/// One row of bits: which matches are compatible with `a`. Normals have no sign.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn fill_row(a: &Match, blocks: &[Block], tolerance: f32, row: &mut [u64]) {
    for (word, b) in row.iter_mut().zip(blocks) {
        let mut compatible = [0u8; 64];
        for l in 0..64 {
            let (mut ds, mut dt, mut cs, mut ct) = (0.0, 0.0, 0.0, 0.0);
            for k in 0..3 {
                ds += (b.source[k][l] - a.source[k]) * (b.source[k][l] - a.source[k]);
                dt += (b.target[k][l] - a.target[k]) * (b.target[k][l] - a.target[k]);
                cs += b.source_normal[k][l] * a.source_normal[k];
                ct += b.target_normal[k][l] * a.target_normal[k];
            }
            let same_length = (ds.sqrt() - dt.sqrt()).abs() < tolerance;
            let apart = ds > tolerance * tolerance;
            let same_angle = (cs.abs() - ct.abs()).abs() < COSINE_TOLERANCE;
            compatible[l] = u8::from(same_length & apart & same_angle);
        }
        *word = 0;
        for (byte, eight) in compatible.as_chunks::<8>().0.iter().enumerate() {
            // Gathers the lowest bits of eight bytes.
            let gathered = u64::from_le_bytes(*eight).wrapping_mul(0x0102_0408_1020_4080) >> 56;
            *word |= gathered << (8 * byte);
        }
    }
}
