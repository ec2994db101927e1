//! Where a first pose comes from: one file per source.

mod consensus;
mod fgr;
mod matching;
mod prior;
mod ransac;
mod turns;
mod upcr;

use matching::are_congruent;
pub(crate) use matching::{Match, match_levels};
pub(crate) use turns::turned;
pub(crate) use upcr::{ALIKE, are_alike};

use crate::{net::Network, prepare::Prepared, settings::Method, transform::Rigid, watch::Call};

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
    /// The network to ask; the embedded one where none is given.
    pub network: Option<&'a Network>,
    /// Distance between matched points under a right pose, at most.
    pub tolerance: f32,
    pub seed: u64,
    /// Whether no other source will be asked.
    pub alone: bool,
    /// The call, which may be over before a source is done: then it proposes what it has.
    pub call: &'a Call<'a>,
}

/// Something that proposes poses, best first.
pub(crate) trait HypothesisSource: Sync {
    fn method(&self) -> Method;
    fn needs_matches(&self) -> bool;
    /// Probability from which no dearer source is asked.
    fn sure(&self) -> f64 {
        0.75
    }
    fn propose(&self, problem: &Problem) -> Vec<Hypothesis>;
}

/// Every source, cheapest first.
pub(crate) const SOURCES: [&dyn HypothesisSource; 5] =
    [&prior::Prior, &upcr::Upcr, &consensus::Consensus, &fgr::Fgr, &ransac::Ransac];

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

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        CloudRole, PointCloud,
        prepare::{Described, check, prepare},
        watch::Watch,
    };

    fn ready(cloud: &PointCloud, call: &Call) -> Prepared {
        let checked = check(cloud, CloudRole::Cloud, call).unwrap();
        prepare(&checked, 0.5, Described::Surely, cloud.len(), call).unwrap()
    }

    /// 300 matches of which 90 follow one motion and the others none.
    fn planted(truth: &Rigid) -> Vec<Match> {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut point = || std::array::from_fn(|_| rng.random_range(-1.0..1.0f32));
        (0..300)
            .map(|i| {
                let (source, normal): ([f32; 3], [f32; 3]) = (point(), point());
                let unit = Vector3::from(normal).normalize();
                let (target, target_normal) = if i % 10 < 3 {
                    let moved = truth.apply(source.map(f64::from)).map(|v| v as f32);
                    (moved, truth.rotation.map(|v| v as f32) * unit)
                } else {
                    (point(), Vector3::from(point()).normalize())
                };
                Match {
                    source,
                    target,
                    source_normal: unit.into(),
                    target_normal: target_normal.into(),
                    ratio: 0.9,
                    mutual: true,
                }
            })
            .collect()
    }

    #[test]
    fn every_source_that_matches_finds_the_motion_that_matches_follow() {
        let truth = Rigid {
            rotation: Rotation3::from_euler_angles(0.4, -1.0, 2.5).into_inner(),
            translation: Vector3::new(0.3, -0.2, 0.5),
        };
        let matches = planted(&truth);
        let corners = (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2].map(f64::from)).collect();
        let cloud = PointCloud::from_points(corners);
        let call = Call::new(None, Watch::default());
        let (source, target) = (ready(&cloud, &call), ready(&cloud, &call));
        for finder in SOURCES.iter().filter(|s| s.needs_matches()) {
            let problem = Problem {
                source: &source,
                target: &target,
                matches: &matches,
                init: Rigid::identity(),
                network: None,
                tolerance: 0.05,
                seed: 1,
                alone: true,
                call: &call,
            };
            let best = finder.propose(&problem)[0];
            let off = separation(&best.pose, &truth, 1.0);
            assert!(off < 0.02, "{:?} is {off} off", finder.method());
            assert!(best.support >= 90, "{:?} has {} matches", finder.method(), best.support);
            // Nothing depends on anything but the problem.
            assert_eq!(finder.propose(&problem)[0].pose, best.pose, "{:?}", finder.method());
        }
    }

    #[test]
    fn no_matches_no_hypotheses() {
        let corners = (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2].map(f64::from)).collect();
        let cloud = PointCloud::from_points(corners);
        let call = Call::new(None, Watch::default());
        let ready = ready(&cloud, &call);
        for finder in SOURCES.iter().filter(|s| s.needs_matches()) {
            let problem = Problem {
                source: &ready,
                target: &ready,
                matches: &[],
                init: Rigid::identity(),
                network: None,
                tolerance: 0.05,
                seed: 1,
                alone: true,
                call: &call,
            };
            assert!(finder.propose(&problem).is_empty(), "{:?}", finder.method());
        }
    }
}
