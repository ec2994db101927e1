//! Fast Global Registration (Zhou, Park & Koltun, ECCV 2016).

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Hypothesis, HypothesisSource, Match, Problem, are_congruent};
use crate::{
    refine::{Correspondence, Objective, Refinement, RobustKernel, align, factor},
    settings::Method,
    transform::Rigid,
    watch::Call,
};

/// Tuples tested, per match (section 3.3 of the paper).
const TUPLE_TRIALS_PER_MATCH: usize = 100;
/// Tuples tested between two looks at whether to go on.
const TRIALS_PER_LOOK: usize = 1024;
/// Tuples kept at most.
const MAX_TUPLES: usize = 1000;
/// μ is divided by this after every few steps.
const SCALE_DIVISOR: f64 = 1.4;
const STEPS_PER_SCALE: usize = 4;
/// τ: edges of a tuple agree up to this ratio.
const EDGE_RATIO: f32 = 0.9;

pub(super) struct Fgr;

impl HypothesisSource for Fgr {
    fn method(&self) -> Method {
        Method::Fgr
    }

    fn needs_matches(&self) -> bool {
        true
    }

    fn propose(&self, problem: &Problem) -> Vec<Hypothesis> {
        let mutual: Vec<Match> = problem.matches.iter().filter(|m| m.mutual).copied().collect();
        let mut chosen = tuples(&mutual, problem.seed, problem.call);
        if chosen.len() < 3 {
            chosen = mutual;
        }
        let pairs: Vec<Correspondence> = chosen
            .iter()
            .map(|m| Correspondence {
                source: m.source,
                target: m.target,
                source_normal: m.source_normal,
                target_normal: m.target_normal,
            })
            .collect();
        let Some(start) = align(pairs.iter().map(|c| (c.source, c.target, 1.0))) else {
            return Vec::new();
        };
        let pose = graduate(start, &pairs, problem.target.diagonal, problem.tolerance, problem.call);
        let support = problem.matches.iter().filter(|m| m.agrees_with(&pose, problem.tolerance)).count();
        vec![Hypothesis { pose, method: Method::Fgr, support }]
    }
}

/// Minimises Σ μ‖r‖² / (μ + ‖r‖²) (equation 3) while μ falls from the cloud's size to the matches' tolerance.
fn graduate(mut pose: Rigid, pairs: &[Correspondence], diagonal: f32, tolerance: f32, call: &Call) -> Rigid {
    let floor = f64::from(tolerance).powi(2);
    let mut mu = f64::from(diagonal).powi(2).max(floor);
    let mut damping = 0.0;
    loop {
        let objective = Objective {
            factor: factor(Refinement::Point, true),
            kernel: RobustKernel::GemanMcclure,
            scale_sq: mu,
        };
        for _ in 0..STEPS_PER_SCALE {
            if call.is_over() {
                return pose;
            }
            match objective.step(&pose, pairs, None, &mut damping) {
                Some(next) => pose = next,
                None => break,
            }
        }
        if mu <= floor {
            return pose;
        }
        mu = (mu / SCALE_DIVISOR).max(floor);
    }
}

/// Matches that occur in congruent triples.
fn tuples(matches: &[Match], seed: u64, call: &Call) -> Vec<Match> {
    let mut chosen = Vec::new();
    if matches.len() < 3 {
        return chosen;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for trial in 0..TUPLE_TRIALS_PER_MATCH * matches.len() {
        if trial.is_multiple_of(TRIALS_PER_LOOK) && call.is_over() {
            break;
        }
        let triple: [&Match; 3] = std::array::from_fn(|_| &matches[rng.random_range(0..matches.len())]);
        if are_congruent(triple, EDGE_RATIO, 0.0) {
            chosen.extend(triple.map(|m| *m));
            if chosen.len() >= 3 * MAX_TUPLES {
                break;
            }
        }
    }
    chosen
}
