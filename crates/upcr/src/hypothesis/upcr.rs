//! The UPCR network's pose, once and again on the moved source while the clouds come closer.

use nalgebra::{Matrix3, Rotation3, Unit, Vector3};

use super::{Hypothesis, HypothesisSource, Problem, drop_repeats};
use crate::{net::Network, prepare::Level, settings::Method, transform::Rigid, verify::overlap_at};

/// Points that the network sees, at most; as many as it learned from.
const POINTS: usize = 1024;
/// Passes at most.
const PASSES: usize = 4;
/// Points that tell how close the clouds are, and the share of the larger cloud's radius that counts as far.
const JUDGED_POINTS: usize = 192;
const FAR: f32 = 0.2;

pub(super) struct Upcr;

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
        let target_scaled = scaled(&target_points, &Rigid::identity());
        let closeness = |pose: &Rigid| overlap_at(source, target, pose, JUDGED_POINTS, FAR * radius).score(2);

        let mut pose = problem.init;
        let mut closest = 0.0;
        let mut hypotheses: Vec<Hypothesis> = Vec::new();
        for _ in 0..PASSES {
            let Ok(step) = network.predict(&scaled(&source_points, &pose), &target_scaled) else { break };
            let next = Rigid { translation: step.translation * f64::from(radius), ..step } * pose;
            let closer = closeness(&next);
            if closer <= closest {
                break;
            }
            (pose, closest) = (next, closer);
            hypotheses.insert(0, Hypothesis { pose, method: Method::Upcr, support: 0 });
        }
        if !hypotheses.is_empty() {
            let turned = turns(&source_points).map(|turn| pose * turn);
            hypotheses.extend(turned.map(|pose| Hypothesis { pose, method: Method::Upcr, support: 0 }));
        }
        drop_repeats(&mut hypotheses, problem);
        hypotheses
    }
}

/// Turns of the points about their principal axes: the network has one answer, and whether a nearly symmetric shape
/// has a better one, or another as good, only a comparison tells.
fn turns(points: &[[f32; 3]]) -> impl Iterator<Item = Rigid> {
    const STEPS: u32 = 12;
    let weight = 1.0 / points.len().max(1) as f64;
    let mean = points.iter().map(|p| Vector3::from(p.map(f64::from)) * weight).sum::<Vector3<f64>>();
    let covariance: Matrix3<f64> = points
        .iter()
        .map(|p| {
            let d = Vector3::from(p.map(f64::from)) - mean;
            d * d.transpose() * weight
        })
        .sum();
    let axes = covariance.symmetric_eigen().eigenvectors;
    (0..3).flat_map(move |axis| {
        let axis = Unit::new_normalize(axes.column(axis).into_owned());
        (1..STEPS).map(move |step| {
            let angle = std::f64::consts::TAU * f64::from(step) / f64::from(STEPS);
            let rotation = Rotation3::from_axis_angle(&axis, angle).into_inner();
            Rigid { rotation, translation: mean - rotation * mean }
        })
    })
}

fn sample(level: &Level) -> Vec<[f32; 3]> {
    level.spread(POINTS).iter().map(|&i| level.points[i as usize]).collect()
}

/// Largest distance of a point from their mean.
fn spread(points: &[[f32; 3]]) -> f32 {
    let mean = points.iter().map(|&p| Vector3::from(p)).sum::<Vector3<f32>>() / points.len().max(1) as f32;
    points.iter().map(|&p| (Vector3::from(p) - mean).norm()).fold(0.0, f32::max)
}
