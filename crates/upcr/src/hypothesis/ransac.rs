//! Feature RANSAC (Fischler & Bolles, CACM 1981) with edge-length and distance checks.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::{Hypothesis, HypothesisSource, Match, Problem, are_congruent};
use crate::{refine::align, settings::Method, transform::Rigid};

/// Triples drawn at most.
const MAX_TRIALS: usize = 200_000;
/// Probability of having drawn one all-inlier triple at which drawing stops.
const CONFIDENCE: f64 = 0.999;
/// Edges of a triple have the same length in both clouds up to this ratio.
const EDGE_RATIO: f32 = 0.9;
/// Triples drawn between two looks at whether to stop; each such round has its own random stream.
const ROUND: usize = 4096;
/// Trials of one random stream.
const STREAM: usize = 512;
/// Trials between two looks at whether to go on.
const TRIALS_PER_LOOK: usize = 32;
const MAX_HYPOTHESES: usize = 16;

pub(super) struct Ransac;

impl HypothesisSource for Ransac {
    fn method(&self) -> Method {
        Method::Ransac
    }

    fn needs_matches(&self) -> bool {
        true
    }

    fn propose(&self, problem: &Problem) -> Vec<Hypothesis> {
        let mutual: Vec<Match> = problem.matches.iter().filter(|m| m.mutual).copied().collect();
        let matches = if mutual.len() >= 30 { mutual } else { problem.matches.to_vec() };
        if matches.len() < 3 {
            return Vec::new();
        }
        let mut best: Vec<Hypothesis> = Vec::new();
        let mut trials = 0;
        while trials < MAX_TRIALS {
            let round: Vec<Vec<Hypothesis>> = (0..ROUND / STREAM)
                .into_par_iter()
                .map(|stream| {
                    let mut rng = ChaCha8Rng::seed_from_u64(problem.seed);
                    rng.set_stream((trials / STREAM + stream) as u64);
                    let mut found: Vec<Hypothesis> = (0..STREAM)
                        .take_while(|i| !(i.is_multiple_of(TRIALS_PER_LOOK) && problem.call.is_over()))
                        .filter_map(|_| trial(&matches, problem.tolerance, &mut rng))
                        .collect();
                    found.sort_by_key(|h| std::cmp::Reverse(h.support));
                    found.truncate(MAX_HYPOTHESES);
                    found
                })
                .collect();
            trials += ROUND;
            best.extend(round.into_iter().flatten());
            best.sort_by_key(|h| std::cmp::Reverse(h.support));
            super::drop_repeats(&mut best, problem);
            best.truncate(MAX_HYPOTHESES);
            let inlier_share = best.first().map_or(0.0, |h| h.support as f64 / matches.len() as f64);
            let needed = (1.0 - CONFIDENCE).ln() / (1.0 - inlier_share.powi(3)).ln();
            if trials as f64 > needed || problem.call.is_over() {
                break;
            }
            problem.call.advance(trials as f64 / MAX_TRIALS as f64);
        }
        best
    }
}

/// Draws three matches; where they are congruent, their pose, re-estimated once over its inliers.
fn trial(matches: &[Match], tolerance: f32, rng: &mut impl Rng) -> Option<Hypothesis> {
    let triple: [&Match; 3] = std::array::from_fn(|_| &matches[rng.random_range(0..matches.len())]);
    if !are_congruent(triple, EDGE_RATIO, tolerance) {
        return None;
    }
    let pose = align(triple.iter().map(|m| (m.source, m.target, 1.0)))?;
    if !triple.iter().all(|m| m.agrees_with(&pose, tolerance)) {
        return None;
    }
    let inliers =
        |pose: &Rigid| -> Vec<&Match> { matches.iter().filter(|m| m.agrees_with(pose, tolerance)).collect() };
    let first = inliers(&pose);
    let refit = align(first.iter().map(|m| (m.source, m.target, 1.0)))?;
    let second = inliers(&refit).len();
    let (pose, support) = if second >= first.len() { (refit, second) } else { (pose, first.len()) };
    Some(Hypothesis { pose, method: Method::Ransac, support })
}
