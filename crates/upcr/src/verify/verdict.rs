//! From evidence to a probability and reasons.

use super::{Calibration, Evidence};
use crate::registration::{Reason, TRUSTWORTHY};

/// Fewer held-out points than this within reach of the other cloud say nothing.
const FEWEST_INLIERS: usize = 10;
/// Fewer points than this say little.
const FEWEST_POINTS: usize = 50;
/// The calibration was fitted on clouds of no fewer points: of smaller ones no pose is called surer than this.
const FEWEST_FITTED: usize = 300;
const UNSURE: f64 = 0.9;
/// Overlap under which a pose is called a pose of clouds that share nothing, and that share little.
const NO_OVERLAP: f64 = 0.1;
const LOW_OVERLAP: f64 = 0.3;
/// Of training pairs' right poses, told the viewpoints to within a twentieth of the clouds' diameter, hardly one in a hundred
/// sets a larger share of the points in free space; of the wrong ones, which were chosen to set few, four in ten do.
const SEEN_THROUGH: f64 = 0.1;
/// A caveat that speaks against the pose itself leaves at most this.
const DOUBTFUL: f64 = 0.45;

/// Probability and reasons.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Verdict {
    pub probability: f64,
    pub reasons: Vec<Reason>,
}

/// Weighs the evidence.
pub(crate) fn judge(e: &Evidence, calibration: &Calibration) -> Verdict {
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
        if e.rivals > 0 {
            reasons.push(Reason::Ambiguous);
        }
        if e.in_free_space.is_some_and(|share| share > SEEN_THROUGH) {
            reasons.push(Reason::SeenThrough);
        }
        if e.free_directions > 0 {
            reasons.push(Reason::DegenerateAxis);
        }
    }
    let mut probability = calibration.probability(e);
    // The other reasons say what is there to be told; where it does not look right either, that is one more.
    if probability < TRUSTWORTHY
        && !reasons.iter().any(|r| matches!(r, Reason::NoOverlap | Reason::TooFewPoints))
    {
        reasons.push(Reason::PoorFit);
    }
    if e.points < FEWEST_FITTED {
        probability = probability.min(UNSURE);
    }
    let against_the_pose = |r: &Reason| !matches!(r, Reason::LowOverlap | Reason::PoorFit);
    if reasons.iter().any(against_the_pose) {
        probability = probability.min(DOUBTFUL);
    }
    if reasons.contains(&Reason::NoOverlap) {
        probability = 0.0;
    }
    if !e.converged {
        reasons.push(Reason::NotConverged);
    }
    Verdict { probability, reasons }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Evidence = Evidence {
        overlap: [0.7, 0.7],
        inliers: 2500,
        closeness: 0.52,
        residual_ratio: 1.1,
        near_misses: 0.2,
        facing: [0.8, 0.85],
        in_free_space: None,
        runner_up: 0.5,
        glimpsed: 0.6,
        rivals: 0,
        agreement: 0.5,
        matches: Some([60, 800]),
        conditioning: 0.02,
        free_directions: 0,
        converged: true,
        points: 5000,
        samples: false,
    };

    fn verdict_on(evidence: &Evidence) -> Verdict {
        judge(evidence, &Calibration::embedded().unwrap())
    }

    #[test]
    fn good_evidence_is_trusted_and_needs_no_reason() {
        let verdict = verdict_on(&GOOD);
        assert!(verdict.probability > 0.9 && verdict.reasons.is_empty(), "{verdict:?}");
    }

    #[test]
    fn every_weakness_is_named_and_lowers_the_probability() {
        let cases = [
            (Evidence { overlap: [0.02, 0.03], ..GOOD }, Reason::NoOverlap),
            (Evidence { inliers: 5, ..GOOD }, Reason::TooFewPoints),
            (Evidence { rivals: 1, ..GOOD }, Reason::Ambiguous),
            (Evidence { in_free_space: Some(0.2), ..GOOD }, Reason::SeenThrough),
            (Evidence { free_directions: 1, ..GOOD }, Reason::DegenerateAxis),
            (Evidence { points: 20, ..GOOD }, Reason::TooFewPoints),
            (
                Evidence { closeness: 0.35, near_misses: 0.6, matches: Some([5, 800]), ..GOOD },
                Reason::PoorFit,
            ),
        ];
        for (evidence, reason) in cases {
            let verdict = verdict_on(&evidence);
            assert!(verdict.reasons.contains(&reason), "{evidence:?}: {verdict:?}");
            assert!(verdict.probability < verdict_on(&GOOD).probability, "{evidence:?}: {verdict:?}");
        }
    }

    #[test]
    fn of_few_points_no_pose_is_sure() {
        let verdict = verdict_on(&Evidence { points: 299, ..GOOD });
        assert!(verdict.probability <= UNSURE && verdict.reasons.is_empty(), "{verdict:?}");
    }

    #[test]
    fn little_overlap_is_told_whatever_the_probability() {
        let verdict = verdict_on(&Evidence { overlap: [0.2, 0.25], ..GOOD });
        assert_eq!(verdict.reasons, [Reason::LowOverlap]);
    }

    #[test]
    fn no_distrust_without_a_reason() {
        for overlap in [0.0, 0.15, 0.5, 0.9] {
            for closeness in [0.0, 0.4, 0.6, 1.0] {
                for runner_up in [0.0, 0.8, 1.2] {
                    let verdict =
                        verdict_on(&Evidence { overlap: [overlap; 2], closeness, runner_up, ..GOOD });
                    assert!(verdict.probability >= TRUSTWORTHY || !verdict.reasons.is_empty());
                }
            }
        }
    }
}
