//! From evidence to a probability and reasons.

use crate::registration::{Reason, TRUSTWORTHY};

/// Fewer held-out points than this within reach of the other cloud say nothing.
const FEWEST_INLIERS: usize = 10;
/// Fewer points than this say little.
const FEWEST_POINTS: usize = 50;
/// Overlap under which a pose is called a pose of clouds that share nothing, and that share little.
const NO_OVERLAP: f64 = 0.1;
const LOW_OVERLAP: f64 = 0.3;
/// A runner-up this close in score is as good an answer.
const AMBIGUOUS_MARGIN: f64 = 0.05;
/// A caveat that speaks against the pose itself leaves at most this.
const DOUBTFUL: f64 = 0.45;

/// What is known about a pose once it is found.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evidence {
    /// Share of held-out source points near the target, and of held-out target points near the source.
    pub overlap: [f64; 2],
    /// Held-out points near the other cloud, both directions.
    pub inliers: usize,
    /// Score over several scales relative to the coarsest: 1 where residuals vanish.
    pub sharpness: f64,
    /// Score of the best clearly different pose over that of this one; 0 where there is none.
    pub runner_up: f64,
    /// Whether the geometry leaves some motion free.
    pub free: bool,
    /// Whether the refinement settled.
    pub converged: bool,
    /// Points of the smaller cloud.
    pub points: usize,
}

impl Evidence {
    /// Of a pose that nothing speaks for, between clouds of at least `points` points.
    pub fn none(points: usize) -> Self {
        Self {
            overlap: [0.0; 2],
            inliers: 0,
            sharpness: 0.0,
            runner_up: 0.0,
            free: false,
            converged: true,
            points,
        }
    }
}

/// Probability and reasons.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Verdict {
    pub probability: f64,
    pub reasons: Vec<Reason>,
}

/// Weighs the evidence.
pub(crate) fn judge(e: &Evidence) -> Verdict {
    let overlap = e.overlap[0].max(e.overlap[1]);
    let mut reasons = Vec::new();
    if e.points < FEWEST_POINTS || (overlap >= NO_OVERLAP && e.inliers < FEWEST_INLIERS) {
        reasons.push(Reason::TooFewPoints);
    }
    if overlap < NO_OVERLAP {
        // Where nothing meets, nothing can be said of the rest.
        reasons.push(Reason::NoOverlap);
    } else {
        if overlap < LOW_OVERLAP {
            reasons.push(Reason::LowOverlap);
        }
        if 1.0 - e.runner_up < AMBIGUOUS_MARGIN {
            reasons.push(Reason::Ambiguous);
        }
        if e.free {
            reasons.push(Reason::DegenerateAxis);
        }
    }
    let mut probability = logistic(e);
    if !reasons.is_empty() {
        let against_the_pose = |r: &Reason| *r != Reason::LowOverlap;
        if reasons.iter().any(against_the_pose) {
            probability = probability.min(DOUBTFUL);
        }
    } else if probability < TRUSTWORTHY {
        reasons.push(Reason::PoorFit);
    }
    if reasons.contains(&Reason::NoOverlap) {
        probability = 0.0;
    }
    if !e.converged {
        reasons.push(Reason::NotConverged);
    }
    Verdict { probability, reasons }
}

/// Logistic regression over overlap, closeness and margin, fitted on 1,900 pairs of training shapes and virtual
/// scans: consistent, noisy, cropped, of little overlap, and of different things.
fn logistic(e: &Evidence) -> f64 {
    let (larger, smaller) = (e.overlap[0].max(e.overlap[1]), e.overlap[0].min(e.overlap[1]));
    let margin = (1.0 - e.runner_up).min(0.6);
    let logit = -12.38 - 2.53 * larger + 6.13 * smaller + 18.96 * e.sharpness + 4.79 * margin;
    1.0 / (1.0 + (-logit).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Evidence = Evidence {
        overlap: [0.8, 0.8],
        inliers: 1000,
        sharpness: 0.75,
        runner_up: 0.5,
        free: false,
        converged: true,
        points: 5000,
    };

    #[test]
    fn good_evidence_is_trusted_and_needs_no_reason() {
        let verdict = judge(&GOOD);
        assert!(verdict.probability > 0.9 && verdict.reasons.is_empty(), "{verdict:?}");
    }

    #[test]
    fn every_weakness_is_named_and_lowers_the_probability() {
        let cases = [
            (Evidence { overlap: [0.02, 0.03], ..GOOD }, Reason::NoOverlap),
            (Evidence { inliers: 5, ..GOOD }, Reason::TooFewPoints),
            (Evidence { overlap: [0.2, 0.2], ..GOOD }, Reason::LowOverlap),
            (Evidence { runner_up: 0.99, ..GOOD }, Reason::Ambiguous),
            (Evidence { free: true, ..GOOD }, Reason::DegenerateAxis),
            (Evidence { points: 20, ..GOOD }, Reason::TooFewPoints),
            (Evidence { sharpness: 0.3, ..GOOD }, Reason::PoorFit),
        ];
        for (evidence, reason) in cases {
            let verdict = judge(&evidence);
            assert!(verdict.reasons.contains(&reason), "{evidence:?}: {verdict:?}");
            assert!(verdict.probability < judge(&GOOD).probability, "{evidence:?}: {verdict:?}");
        }
    }

    #[test]
    fn no_distrust_without_a_reason() {
        for overlap in [0.0, 0.15, 0.5, 0.9] {
            for sharpness in [0.0, 0.4, 0.6, 1.0] {
                for runner_up in [0.0, 0.8, 1.2] {
                    let verdict = judge(&Evidence { overlap: [overlap; 2], sharpness, runner_up, ..GOOD });
                    assert!(verdict.probability >= TRUSTWORTHY || !verdict.reasons.is_empty());
                }
            }
        }
    }
}
