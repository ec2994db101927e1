//! The UPCR network's pose, once and again on the moved source while the clouds come closer.

use nalgebra::Vector3;

use super::{Hypothesis, HypothesisSource, Problem};
use crate::{
    PointCloud, cloud::deviations, net::Network, prepare::Level, settings::Method, transform::Rigid,
    verify::overlap_at,
};

/// Points that the network learned from, and that it sees here at most: its pose is only a first one.
const LEARNED_POINTS: usize = 1024;
const POINTS: usize = 512;
/// Passes at most.
const PASSES: usize = 4;
/// Points that tell how close the clouds are, and the share of the larger cloud's radius that counts as far.
const JUDGED_POINTS: usize = 192;
const FAR: f32 = 0.2;
/// Score from which on the refinement needs no closer pose.
const CLOSE: f64 = 0.9;
/// Scores below which other sources are the better choice, after the first pass and after the last: right poses of
/// shapes that overlap well have more, wrong ones of scenes less.
const FAR_OFF: f64 = 0.6;
const HOPELESS: f64 = 0.8;
/// How little the spreads of two views of one whole differ, as a share of the largest: noise changes less, a crop mostly
/// more.
pub(crate) const ALIKE: f64 = 0.03;

pub(super) struct Upcr;

/// Whether two clouds may show the same whole, which the network pools over: their spreads along their own principal
/// axes, which no motion changes, are nearly equal.
pub(crate) fn are_alike(source: &PointCloud, target: &PointCloud) -> bool {
    let (a, b) = (deviations(source), deviations(target));
    (a - b).amax() <= ALIKE * a.amax().max(b.amax())
}

impl HypothesisSource for Upcr {
    fn method(&self) -> Method {
        Method::Upcr
    }

    fn needs_matches(&self) -> bool {
        false
    }

    /// What features would find has not been looked at yet: more is asked of the one answer.
    fn sure(&self) -> f64 {
        0.9
    }

    fn propose(&self, problem: &Problem) -> Vec<Hypothesis> {
        let embedded;
        let network: &Network = match problem.network {
            Some(network) => network,
            None => match Network::embedded() {
                Ok(found) => {
                    embedded = found;
                    &embedded
                }
                Err(_) => return Vec::new(),
            },
        };
        let (source, target) = (&problem.source.fine, &problem.target.fine);
        let (source_points, target_points) = (sample(source), sample(target));
        let radius = spread(&source_points).max(spread(&target_points));
        if !(radius > 0.0 && radius.is_finite()) {
            return Vec::new();
        }
        // Shapes were learned in the unit sphere.
        let scale = 1.0 / radius;
        let scaled = |points: &[[f32; 3]], pose: &Rigid| -> Vec<[f32; 3]> {
            let rotation = pose.rotation.map(|v| v as f32);
            let translation = pose.translation.map(|v| v as f32);
            points.iter().map(|&p| ((rotation * Vector3::from(p) + translation) * scale).into()).collect()
        };
        let canonical = |points: &[[f32; 3]], pose: &Rigid| {
            // Fewer neighbours reach as far among fewer points.
            let k = (network.config().k * points.len()).div_ceil(LEARNED_POINTS);
            network.canonical_pose(&scaled(points, pose), k)
        };
        let canonical_target = || canonical(&target_points, &Rigid::identity());
        let canonical_source = |pose: &Rigid| canonical(&source_points, pose);
        let closeness = |pose: &Rigid| overlap_at(source, target, pose, JUDGED_POINTS, FAR * radius).score(2);

        let (mut pose, mut closest) = (problem.init, 0.0);
        let mut passes = 0;
        let (mut found, canonical_target) = rayon::join(|| canonical_source(&pose), canonical_target);
        let Ok(canonical_target) = canonical_target else { return Vec::new() };
        while let Ok(canonical_source_pose) = found {
            let step = canonical_target * canonical_source_pose.inverse();
            let next = Rigid { translation: step.translation * f64::from(radius), ..step } * pose;
            let closer = closeness(&next);
            if closer <= closest {
                break;
            }
            (pose, closest, passes) = (next, closer, passes + 1);
            if closest >= CLOSE || passes == PASSES || (closest < FAR_OFF && !problem.alone) {
                break;
            }
            if problem.call.is_over() {
                break;
            }
            found = canonical_source(&pose);
        }
        // Where the time is up, no other source will be asked either.
        let alone = problem.alone || problem.call.ended_by().is_some();
        if passes == 0 || (closest < HOPELESS && !alone) {
            return Vec::new();
        }
        vec![Hypothesis { pose, method: Method::Upcr, support: 0 }]
    }
}

fn sample(level: &Level) -> Vec<[f32; 3]> {
    level.spread(POINTS).iter().map(|&i| level.points[i as usize]).collect()
}

/// Largest distance of a point from their mean.
fn spread(points: &[[f32; 3]]) -> f32 {
    let mean = points.iter().map(|&p| Vector3::from(p)).sum::<Vector3<f32>>() / points.len().max(1) as f32;
    points.iter().map(|&p| (Vector3::from(p) - mean).norm()).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;

    #[test]
    fn a_moved_cloud_is_alike_and_a_part_is_not() {
        let point = |i: usize| [(i % 7) as f64, 2.0 * (i % 11) as f64, 3.0 * (i % 13) as f64];
        let cloud = PointCloud::from_points((0..1001).map(point).collect());
        let motion = Rigid {
            rotation: Rotation3::from_euler_angles(0.4, -1.0, 2.5).into_inner(),
            translation: Vector3::new(4e5, -2e6, 70.0),
        };
        assert!(are_alike(&cloud, &cloud.transformed(&motion)));
        let part = cloud.points.iter().copied().filter(|p| p[2] < 26.0).collect();
        assert!(!are_alike(&cloud, &PointCloud::from_points(part)));
    }
}
