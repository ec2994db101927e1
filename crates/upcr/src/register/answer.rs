//! The answer: the best candidate with the verdict on it, or what is said where there is none.

use nalgebra::{Matrix6, Matrix6xX};

use super::{
    Pipeline,
    candidates::{COMPARING_POINTS, Candidate, FINE_POINTS, Glimpse, REACH_VOXELS, RIVALLING, RIVALS},
    to_file,
};
use crate::{
    CloudRole, PointCloud, free_direction,
    hypothesis::Match,
    prepare::{Level, Prepared},
    refine::{Refinement, Schedule},
    registration::{Alternative, Registration, Timings},
    settings::Settings,
    transform::Rigid,
    verify::{Evidence, Uncertainty, judge, meeting, overlap_at, seen},
};

/// Scores relative to another are told up to this.
const MOST_RELATIVE: f64 = 10.0;
/// Held-out points that are looked at although the time is up: they take a few milliseconds.
const QUICKLY_SEEN: usize = 16_384;
/// Points of the source that tell its size where nothing else is known.
const GLANCED_POINTS: usize = 1024;

impl Pipeline<'_> {
    /// The best candidate with the verdict on it.
    pub(super) fn verified(&self) -> Registration {
        let radius = f64::from(self.source.fine.radius);
        let Some(best) = self.candidates.first() else { return self.nothing_found() };
        let pose = &best.refined.pose;
        let relative = |c: &Candidate| (c.score / best.score.max(f64::MIN_POSITIVE)).min(MOST_RELATIVE);
        let others = self.others(best);
        let (source, target) = (&self.source.fine, &self.target.fine);
        let limit = self.voxel_size as f32;
        let held_out = |cloud: &Prepared| match cloud.held_out_points() {
            all if all.len() > QUICKLY_SEEN && self.call.is_over() => Level::thin(&all, QUICKLY_SEEN),
            all => all,
        };
        let [ours, theirs] = [held_out(self.source), held_out(self.target)];
        let forward = meeting(source, &ours, target, pose, limit);
        let backward = meeting(target, &theirs, source, &pose.inverse(), limit);
        let uncertainty = self.uncertainty(pose);
        let (agreement, glimpsed) = self.glimpsed(pose);
        let tolerance = self.match_tolerance();
        let explained = |matches: &[Match]| matches.iter().filter(|m| m.agrees_with(pose, tolerance)).count();
        let evidence = Evidence {
            closeness: best.closeness,
            in_free_space: self.in_free_space(pose, [&ours, &theirs]),
            runner_up: others.first().map_or(0.0, |c| relative(c)),
            rivals: others.iter().filter(|c| relative(c) >= RIVALLING).count(),
            glimpsed,
            agreement,
            matches: (!self.matches.is_empty()).then(|| [explained(&self.matches), self.matches.len()]),
            conditioning: uncertainty.conditioning,
            free_directions: uncertainty.free.ncols(),
            converged: best.refined.converged || self.settings.refine == Refinement::None,
            samples: self.samples(),
            ..Evidence::none(source.points.len().min(target.points.len()))
        };
        let evidence = seen([&forward, &backward], limit, evidence);
        let verdict = judge(&evidence, &self.calibration);
        Registration {
            T_target_source: self.file_pose(pose),
            fitness: forward.share(limit),
            inlier_rmse: forward.rmse(limit),
            num_inliers: forward.count(limit),
            converged: evidence.converged && forward.count(limit) > 0,
            iterations: best.refined.iterations,
            probability: verdict.probability,
            covariance: rows(&uncertainty.covariance),
            free_directions: free_direction::name(&uncertainty.free, radius, self.target.origin),
            reasons: verdict.reasons,
            alternatives: (others.iter().filter(|c| relative(c) >= RIVALLING).take(RIVALS))
                .map(|c| Alternative {
                    T_target_source: self.file_pose(&c.refined.pose),
                    relative_score: relative(c),
                })
                .collect(),
            evidence,
            method: best.method,
            ..self.nothing_found()
        }
    }

    /// How far the sources agree on `pose`, and the coarse score of the best other pose over its own.
    fn glimpsed(&self, pose: &Rigid) -> (f64, f64) {
        let (source, target) = (self.source.coarse(), self.target.coarse());
        let here = overlap_at(source, target, pose, COMPARING_POINTS, self.coarse_reach()).score(2);
        let here = here * self.clearance(pose);
        let (same, others): (Vec<&Glimpse>, Vec<&Glimpse>) =
            self.glimpses.iter().partition(|glimpse| self.coarsely_same(&glimpse.pose, pose));
        let proposed = |glimpses: &[&Glimpse]| glimpses.iter().filter(|g| g.proposed).count();
        let (agreeing, not) = (proposed(&same), proposed(&others));
        let best_other = others.iter().map(|glimpse| glimpse.score).fold(0.0, f64::max);
        let relative = if best_other == 0.0 { 0.0 } else { (best_other / here).min(MOST_RELATIVE) };
        (agreeing as f64 / (agreeing + not).max(1) as f64, relative)
    }

    /// How far `pose` may be off, as the pairs of the last refinement tell.
    fn uncertainty(&self, pose: &Rigid) -> Uncertainty {
        let radius = f64::from(self.source.fine.radius);
        let moved = Level::thin(&self.source.refined_points(), FINE_POINTS);
        let icp = self.icp(&self.source.fine, &self.target.fine);
        let reach = REACH_VOXELS * self.voxel_size as f32;
        let mut schedule = Schedule::settled(reach, self.settings.overlap.unwrap_or(1.0));
        if self.settings.refine == Refinement::None {
            // What was never refined may lie further off.
            schedule.max_slide_voxels = f32::INFINITY;
        }
        let tangent = match &self.lock {
            Some(lock) => lock.tangent(pose),
            None => Matrix6xX::identity(6),
        };
        match icp.information(&moved, pose, &schedule) {
            Some(information) => Uncertainty::of(&information, &tangent, radius),
            None => Uncertainty::unknown(radius),
        }
    }

    /// The pose between the clouds in their files' frames.
    pub(super) fn file_pose(&self, local: &Rigid) -> Rigid {
        match &self.lock {
            Some(lock) => lock.file_pose(local),
            None => to_file(local, self.source, self.target),
        }
    }

    /// The answer where no source of hypotheses had any.
    pub(super) fn nothing_found(&self) -> Registration {
        let points = self.source.fine.points.len().min(self.target.fine.points.len());
        let none = nothing_known(f64::from(self.source.fine.radius), self.settings);
        Registration {
            // As it was given: what is locked is held to the last bit.
            T_target_source: self.settings.first_guess(),
            // Nothing speaks against a pose that was not looked for.
            reasons: match self.call.ended_by() {
                None => judge(&Evidence::none(points), &self.calibration).reasons,
                Some(_) => Vec::new(),
            },
            evidence: Evidence::none(points),
            voxel_size: self.voxel_size,
            points_used: [self.source.points_used, self.target.points_used],
            settings: Settings { voxel_size: Some(self.voxel_size), ..none.settings },
            ..none
        }
    }
}

/// The answer where nothing is known but about how large the source is.
pub(super) fn nothing_known(radius: f64, settings: &Settings) -> Registration {
    Registration {
        T_target_source: settings.first_guess(),
        fitness: 0.0,
        inlier_rmse: 0.0,
        num_inliers: 0,
        converged: false,
        iterations: 0,
        probability: 0.0,
        covariance: rows(&Uncertainty::unknown(radius).covariance),
        free_directions: Vec::new(),
        reasons: Vec::new(),
        alternatives: Vec::new(),
        source_scale: None,
        evidence: Evidence::none(0),
        method: settings.method,
        voxel_size: settings.voxel_size.unwrap_or(0.0),
        points_used: [0; 2],
        settings: settings.clone(),
        timings_ms: Timings::default(),
    }
}

/// About half the length of the cloud's bounding box's diagonal, from a few points that need not be sound; never zero.
pub(super) fn glanced_radius(cloud: &PointCloud) -> f64 {
    let step = cloud.len().div_ceil(GLANCED_POINTS).max(1);
    let few = cloud.points.iter().step_by(step).filter(|p| p.iter().all(|v| v.is_finite())).copied();
    let bounds = PointCloud::from_points(few.collect()).checked_bounds(CloudRole::Source);
    match bounds.ok().flatten().map(|b| 0.5 * b.diagonal()) {
        Some(radius) if radius > 0.0 && radius.is_finite() => radius,
        _ => 1.0,
    }
}

fn rows(m: &Matrix6<f64>) -> [[f64; 6]; 6] {
    std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]))
}
