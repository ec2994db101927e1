//! Poses from matches that agree with each other: second-order spatial compatibility
//! (SC²-PCR, Chen, Sun, Yang & Tao, CVPR 2022), on bit sets.
//!
//! Two matches are compatible where both clouds put the same distance, and the same angle of normals, between
//! them. Two wrong matches are compatible by chance; that many others are compatible with both is hardly ever
//! chance, so the number of common neighbours ranks pairs. No random choice is made.

use rayon::prelude::*;

use super::{Hypothesis, HypothesisSource, Match, Problem};
use crate::{refine::align, register::Method, transform::Rigid};

/// Matches considered, the most distinctive first.
const MAX_MATCHES: usize = 1024;
/// Seeds from which a consensus set is grown.
const SEEDS: usize = 96;
/// Matches in a seed's first consensus set.
const CONSENSUS: usize = 20;
/// Normals of compatible matches enclose the same angle up to this difference of cosines.
const COSINE_TOLERANCE: f32 = 0.35;
/// Hypotheses handed on.
const MAX_HYPOTHESES: usize = 48;

pub(super) struct Consensus;

impl HypothesisSource for Consensus {
    fn method(&self) -> Method {
        Method::Consensus
    }

    fn needs_matches(&self) -> bool {
        true
    }

    fn propose(&self, problem: &Problem) -> Vec<Hypothesis> {
        let matches = most_distinctive(problem.matches);
        let graph = Compatibility::new(&matches, problem.tolerance);
        let mut seeds: Vec<(u64, u32)> = (0..matches.len() as u32)
            .into_par_iter()
            .map(|i| (graph.second_order_degree(i as usize), i))
            .collect();
        seeds.sort_unstable_by_key(|&(degree, i)| (std::cmp::Reverse(degree), i));
        seeds.truncate(SEEDS);
        let mut hypotheses: Vec<Hypothesis> = seeds
            .par_iter()
            .filter(|seed| seed.0 > 0)
            .filter_map(|&(_, seed)| {
                let consensus = graph.consensus(seed as usize);
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
        hypotheses.truncate(MAX_HYPOTHESES);
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
        let mut bits = vec![0u64; words * count];
        bits.par_chunks_mut(words.max(1)).enumerate().for_each(|(i, row)| {
            let a = &matches[i];
            for (word, block) in row.iter_mut().zip(matches.chunks(64)) {
                let mut mask = 0u64;
                for (bit, b) in block.iter().enumerate() {
                    let (ds, dt) = (distance(a.source, b.source), distance(a.target, b.target));
                    let (cs, ct) =
                        (dot(a.source_normal, b.source_normal), dot(a.target_normal, b.target_normal));
                    // Normals have no sign.
                    let compatible = (ds - dt).abs() < tolerance
                        && ds > tolerance
                        && (cs.abs() - ct.abs()).abs() < COSINE_TOLERANCE;
                    mask |= u64::from(compatible) << bit;
                }
                *word = mask;
            }
        });
        Self { count, words, bits }
    }

    fn row(&self, i: usize) -> &[u64] {
        &self.bits[i * self.words..(i + 1) * self.words]
    }

    fn common(&self, i: usize, j: usize) -> u32 {
        self.row(i).iter().zip(self.row(j)).map(|(a, b)| (a & b).count_ones()).sum()
    }

    fn neighbors(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        let row = self.row(i);
        (0..self.count).filter(move |&j| row[j / 64] >> (j % 64) & 1 == 1)
    }

    /// Σ over compatible matches of the compatible matches in common.
    fn second_order_degree(&self, i: usize) -> u64 {
        self.neighbors(i).map(|j| u64::from(self.common(i, j))).sum()
    }

    /// The seed and the matches with which it has most in common, with that number as weight.
    fn consensus(&self, seed: usize) -> Vec<(usize, f64)> {
        let mut ranked: Vec<(u32, usize)> = self.neighbors(seed).map(|j| (self.common(seed, j), j)).collect();
        ranked.sort_unstable_by_key(|&(common, j)| (std::cmp::Reverse(common), j));
        ranked.truncate(CONSENSUS);
        let most = ranked.first().map_or(1, |r| r.0).max(1);
        std::iter::once((seed, f64::from(most)))
            .chain(ranked.into_iter().filter(|r| r.0 > 0).map(|(common, j)| (j, f64::from(common))))
            .collect()
    }
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let d: [f32; 3] = std::array::from_fn(|k| a[k] - b[k]);
    dot(d, d).sqrt()
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
