//! From evidence to a probability and reasons.

use crate::register::Reason;

/// Fewer held-out points than this within reach of the other cloud say nothing.
const FEWEST_INLIERS: usize = 10;
/// Overlap under which a pose is called a pose of clouds that share nothing, and that share little.
const NO_OVERLAP: f64 = 0.1;
const LOW_OVERLAP: f64 = 0.3;
/// A runner-up this close in score is as good an answer.
const AMBIGUOUS_MARGIN: f64 = 0.03;
/// Information, relative to the best held direction, under which a direction is free.
const FREE_DIRECTION: f64 = 1e-4;

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
    /// Ratio of the worst to the best held direction.
    pub conditioning: f64,
    /// Whether the refinement settled.
    pub converged: bool,
    /// Points of the smaller cloud.
    pub points: usize,
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
    if e.points < 50 {
        reasons.push(Reason::TooFewPoints);
    }
    if overlap < NO_OVERLAP || e.inliers < FEWEST_INLIERS {
        reasons.push(Reason::NoOverlap);
    } else if overlap < LOW_OVERLAP {
        reasons.push(Reason::LowOverlap);
    }
    if 1.0 - e.runner_up < AMBIGUOUS_MARGIN {
        reasons.push(Reason::Ambiguous);
    }
    if e.conditioning < FREE_DIRECTION {
        reasons.push(Reason::DegenerateAxis);
    }
    if !e.converged {
        reasons.push(Reason::NotConverged);
    }
    if reasons.contains(&Reason::NoOverlap) {
        return Verdict { probability: 0.0, reasons };
    }
    let logit = -6.0 + 8.0 * overlap + 6.0 * e.sharpness + 6.0 * (1.0 - e.runner_up).min(0.5) - 2.0;
    let mut probability = 1.0 / (1.0 + (-logit).exp());
    if reasons.iter().any(|r| matches!(r, Reason::Ambiguous | Reason::DegenerateAxis | Reason::TooFewPoints))
    {
        probability *= 0.5;
    }
    Verdict { probability, reasons }
}
