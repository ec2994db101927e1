//! Where a first pose comes from: one file per source.

mod consensus;
mod fgr;
mod matching;
mod prior;
mod ransac;

use matching::are_congruent;
pub(crate) use matching::{Match, match_levels};

use crate::{prepare::Prepared, settings::Method, transform::Rigid};

/// A pose to be refined and verified, in local frames.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hypothesis {
    pub pose: Rigid,
    pub method: Method,
    /// Matches that agree with the pose; 0 for a source that uses none.
    pub support: usize,
}

/// What a source of hypotheses works on.
pub(crate) struct Problem<'a> {
    pub source: &'a Prepared,
    pub target: &'a Prepared,
    /// Feature matches between the coarse levels; empty for a source that needs none.
    pub matches: &'a [Match],
    /// Initial pose in local frames.
    pub init: Rigid,
    /// Distance between matched points under a right pose, at most.
    pub tolerance: f32,
    pub seed: u64,
}

/// Something that proposes poses, best first.
pub(crate) trait HypothesisSource: Sync {
    fn method(&self) -> Method;
    fn needs_matches(&self) -> bool;
    fn propose(&self, problem: &Problem) -> Vec<Hypothesis>;
}

/// Every source, cheapest first.
pub(crate) const SOURCES: [&dyn HypothesisSource; 4] =
    [&prior::Prior, &consensus::Consensus, &fgr::Fgr, &ransac::Ransac];

/// Angle and translation between two poses as one length: how far they lay the source's rim apart at most.
pub(crate) fn separation(a: &Rigid, b: &Rigid, radius: f64) -> f64 {
    let between = a.inverse() * *b;
    // Chord of the rotation at the rim; the local origin is the source's centre.
    2.0 * (0.5 * between.angle()).sin() * radius + between.translation.norm()
}

/// Keeps the first of hypotheses that say nearly the same.
fn drop_repeats(hypotheses: &mut Vec<Hypothesis>, problem: &Problem) {
    let radius = f64::from(problem.source.fine.radius);
    let mut kept: Vec<Hypothesis> = Vec::new();
    for h in hypotheses.drain(..) {
        if kept.iter().all(|k| separation(&k.pose, &h.pose, radius) > f64::from(problem.tolerance)) {
            kept.push(h);
        }
    }
    *hypotheses = kept;
}
