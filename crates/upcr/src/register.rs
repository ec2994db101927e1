//! The one pipeline: prepare, hypotheses, refine, verify.

use std::time::Instant;

use nalgebra::{Matrix6, Matrix6xX};
use rayon::prelude::*;

use crate::{
    CloudRole, Error, PointCloud, Result,
    cloud::orient_by_curvature,
    features::{Descriptors, Feature, FeatureInput},
    free_direction,
    hypothesis::{Hypothesis, Match, Problem, SOURCES, are_alike, match_levels, separation},
    prepare::{Described, Level, Prepared, check, derive_voxel_size, prepare},
    refine::{Icp, LockedPose, Refined, Refinement, Schedule, factor},
    registration::{Registration, Timings},
    settings::{Method, Settings},
    threads::on_threads,
    transform::Rigid,
    verify::{Evidence, Uncertainty, distances, judge, overlap_at},
};

/// Hypotheses that are refined on the coarse level, and of those on the fine one.
const COARSE_CANDIDATES: usize = 8;
const FINE_CANDIDATES: usize = 3;
/// A hypothesis that scores less than this share of the best is not looked at further.
const PROMISING: f64 = 0.7;
/// Where points lie on each other as closely as this, no other pose can look as right.
const COINCIDENT: f64 = 0.95;
/// Points that score an alternative at a glance and a raw hypothesis, that refine it coarsely, that score it then, and
/// that score the result.
const GLANCING_POINTS: usize = 96;
const RANKING_POINTS: usize = 192;
const COARSE_POINTS: usize = 300;
const COMPARING_POINTS: usize = 500;
const SCORING_POINTS: usize = 1500;
/// Pairs of the final refinement are at most so many voxels apart.
const REACH_VOXELS: f32 = 2.0;
/// Points that refine a pose until it settles, and in a few last iterations.
const FEW_POINTS: usize = 1500;
const FINE_POINTS: usize = 6000;
/// Scales over which refined poses are compared, each half the one before.
const SCORING_SCALES: u32 = 4;
/// Poses closer than this many voxels at the source's rim are one answer.
const DISTINCT_VOXELS: f64 = 6.0;

/// Finds the pose that lays `source` on `target`.
///
/// # Errors
/// Where a cloud is too small, degenerate or not finite, or a setting is out of its range. Clouds that cannot
/// be registered are no error: the result says so (`probability`, `reasons`).
pub fn register(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Registration> {
    settings.check()?;
    on_threads(settings.threads, || run(source, target, settings))?
}

/// A refined pose with its score.
struct Candidate {
    method: Method,
    refined: Refined,
    score: f64,
    sharpness: f64,
}

fn run(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Registration> {
    let start = Instant::now();
    let (source, target) =
        rayon::join(|| check(source, CloudRole::Source), || check(target, CloudRole::Target));
    let (source, target) = (source?, target?);
    let voxel_size = settings.voxel_size.unwrap_or_else(|| derive_voxel_size(&source, &target));
    let asks_network = match settings.method {
        Method::Auto => are_alike(source.cloud, target.cloud),
        method => method == Method::Upcr,
    };
    let described = match settings.method {
        Method::Prior => Described::Never,
        _ if asks_network => Described::Perhaps,
        _ => Described::Surely,
    };
    let (source, target) =
        rayon::join(|| prepare(&source, voxel_size, described), || prepare(&target, voxel_size, described));
    let (source, target) = (source?, target?);
    let mut pipeline = Pipeline::new(&source, &target, voxel_size, asks_network, settings);
    pipeline.timings.prepare = milliseconds(start);
    let mut best = pipeline.best()?;
    best.timings_ms.total = milliseconds(start);
    Ok(best)
}

fn milliseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Two prepared clouds and what is known of them so far.
struct Pipeline<'a> {
    source: &'a Prepared,
    target: &'a Prepared,
    settings: &'a Settings,
    voxel_size: f64,
    asks_network: bool,
    init: Rigid,
    lock: Option<LockedPose>,
    matches: Vec<Match>,
    candidates: Vec<Candidate>,
    timings: Timings,
}

impl<'a> Pipeline<'a> {
    fn new(
        source: &'a Prepared,
        target: &'a Prepared,
        voxel_size: f64,
        asks_network: bool,
        settings: &'a Settings,
    ) -> Self {
        let init = settings.init.unwrap_or_else(Rigid::identity);
        let lock = LockedPose::new(settings.locks, &init, source.origin, target.origin);
        let init = to_local(&init, source, target);
        Self {
            source,
            target,
            settings,
            voxel_size,
            asks_network,
            init,
            lock,
            matches: Vec::new(),
            candidates: Vec::new(),
            timings: Timings::default(),
        }
    }

    /// Asks one source of hypotheses after the other until the verdict is sure.
    fn best(&mut self) -> Result<Registration> {
        let mut best = None;
        for source in SOURCES {
            if !self.wants(source.method()) {
                continue;
            }
            let start = Instant::now();
            if source.needs_matches() && self.matches.is_empty() {
                self.matches = self.feature_matches()?;
            }
            let coarse = self.source.coarse().voxel_size.max(self.target.coarse().voxel_size);
            let problem = Problem {
                source: self.source,
                target: self.target,
                matches: &self.matches,
                init: self.init,
                network: self.settings.network.as_deref(),
                tolerance: TOLERANCE_VOXELS * coarse,
                seed: self.settings.seed,
                alone: self.settings.method == source.method(),
            };
            let hypotheses = source.propose(&problem);
            self.timings.hypotheses += milliseconds(start);
            let start = Instant::now();
            let refined = self.refined(&hypotheses, |best| source.alternatives(&problem, best));
            self.candidates.extend(refined);
            self.candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
            self.timings.refine += milliseconds(start);
            let start = Instant::now();
            let registration = self.verified();
            self.timings.verify += milliseconds(start);
            let sure = registration.probability >= source.sure();
            best = Some(Registration { timings_ms: self.timings, ..registration });
            if sure {
                break;
            }
        }
        best.ok_or_else(|| Error::InvalidSetting {
            name: "method",
            reason: "no source of hypotheses has this name".into(),
        })
    }

    fn wants(&self, method: Method) -> bool {
        match self.settings.method {
            Method::Auto => match method {
                Method::Prior => self.settings.init.is_some(),
                Method::Upcr => self.asks_network,
                _ => true,
            },
            Method::Features => matches!(method, Method::Consensus | Method::Fgr | Method::Ransac),
            chosen => chosen == method,
        }
    }

    fn feature_matches(&self) -> Result<Vec<Match>> {
        let (a, b) = (self.source.coarse(), self.target.coarse());
        let feature = self.settings.feature.feature();
        let (da, db) = rayon::join(|| describe(a, feature), || describe(b, feature));
        Ok(match_levels((a, &da?), (b, &db?)))
    }

    /// The refinement between two levels.
    fn icp(&self, source: &'a Level, target: &'a Level) -> Icp<'_> {
        Icp {
            source,
            target,
            factor: factor(self.settings.refine, source.sparse && target.sparse),
            kernel: self.settings.kernel,
            lock: self.lock.as_ref(),
        }
    }

    /// Ranks hypotheses by overlap, refines the best coarsely, ranks again, beside the `alternatives` to the best, and
    /// refines the best of those finely.
    fn refined(
        &self,
        hypotheses: &[Hypothesis],
        alternatives: impl FnOnce(&Rigid) -> Vec<Hypothesis>,
    ) -> Vec<Candidate> {
        let (source, target) = (self.source.coarse(), self.target.coarse());
        let limit = REACH_VOXELS * source.voxel_size.max(target.voxel_size);
        let rank = |pose: &Rigid, points: usize| overlap_at(source, target, pose, points, limit).score(2);
        let promising = |hypotheses: &[Hypothesis], points: usize, least: f64| {
            let mut ranked: Vec<(f64, Hypothesis)> =
                hypotheses.par_iter().map(|h| (rank(&h.pose, points), *h)).collect();
            ranked.retain(|&(score, _)| score >= least);
            keep_promising(&mut ranked, COARSE_CANDIDATES);
            ranked
        };
        let moved = source.spread(COARSE_POINTS);
        let coarsely_refined = |ranked: Vec<(f64, Hypothesis)>| {
            if self.settings.refine == Refinement::None {
                return ranked;
            }
            let icp = self.icp(source, target);
            let refined = ranked.par_iter().map(|(_, h)| {
                let pose = icp.refine(&moved, &h.pose, &Schedule::coarse(limit)).pose;
                (rank(&pose, COMPARING_POINTS), Hypothesis { pose, ..*h })
            });
            refined.collect()
        };
        let mut ranked = coarsely_refined(promising(hypotheses, RANKING_POINTS, 0.0));
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        if let Some((score, best)) = ranked.first()
            && *score < COINCIDENT
        {
            let others = promising(&alternatives(&best.pose), GLANCING_POINTS, PROMISING * score);
            ranked.extend(coarsely_refined(others));
            ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        }
        let radius = f64::from(self.source.fine.radius);
        let mut distinct: Vec<(f64, Hypothesis)> = Vec::new();
        for (score, h) in ranked {
            if distinct.iter().all(|(_, d)| separation(&d.pose, &h.pose, radius) > f64::from(limit)) {
                distinct.push((score, h));
            }
        }
        keep_promising(&mut distinct, FINE_CANDIDATES);
        distinct.iter().map(|(_, h)| self.finely_refined(h)).collect()
    }

    fn finely_refined(&self, hypothesis: &Hypothesis) -> Candidate {
        let (source, target) = (&self.source.fine, &self.target.fine);
        let reach = REACH_VOXELS * self.voxel_size as f32;
        let icp = self.icp(source, target);
        let moved = self.source.refined_points();
        let few = Level::thin(&moved, FEW_POINTS);
        let keep = self.settings.overlap.unwrap_or(1.0);
        let refined = if self.settings.refine == Refinement::None {
            icp.refine(
                &few,
                &hypothesis.pose,
                &Schedule { max_iterations: 0, ..Schedule::settled(reach, keep) },
            )
        } else {
            // A guess may be further off than what the coarse level brings near.
            let first = if hypothesis.method == Method::Prior { 3.0 * reach } else { 1.5 * reach };
            let found = icp.refine(&few, &hypothesis.pose, &Schedule::fine(first, reach, keep));
            if few.len() == moved.len() {
                found
            } else {
                let all = Level::thin(&moved, FINE_POINTS);
                let settled = icp.refine(&all, &found.pose, &Schedule::settled(reach, keep));
                Refined {
                    iterations: found.iterations + settled.iterations,
                    converged: found.converged || settled.converged,
                    ..settled
                }
            }
        };
        let overlap = overlap_at(source, target, &refined.pose, SCORING_POINTS, reach);
        let score = overlap.score(SCORING_SCALES);
        let sharpness = score / overlap.score(1).max(f64::MIN_POSITIVE);
        // Walls that slide along each other overlap more than those that stand where they belong, but less closely.
        Candidate { method: hypothesis.method, refined, score: score * sharpness, sharpness }
    }

    /// The best candidate with the verdict on it.
    fn verified(&self) -> Registration {
        let radius = f64::from(self.source.fine.radius);
        let Some(best) = self.candidates.first() else { return self.nothing_found() };
        let pose = &best.refined.pose;
        let distinct = DISTINCT_VOXELS * self.voxel_size;
        let runner_up = self
            .candidates
            .iter()
            .find(|c| separation(&c.refined.pose, pose, radius) > distinct)
            .map_or(0.0, |c| c.score / best.score.max(f64::MIN_POSITIVE));
        let (source, target) = (&self.source.fine, &self.target.fine);
        let limit = self.voxel_size as f32;
        let forward = distances(source, &self.source.held_out_points(), target, pose, limit);
        let backward = distances(target, &self.target.held_out_points(), source, &pose.inverse(), limit);
        let uncertainty = self.uncertainty(pose);
        let inliers = forward.within(limit) + backward.within(limit);
        let evidence = Evidence {
            overlap: [forward.share(limit), backward.share(limit)],
            inliers,
            sharpness: best.sharpness,
            runner_up,
            free: uncertainty.free.ncols() > 0,
            converged: best.refined.converged || self.settings.refine == Refinement::None,
            points: source.points.len().min(target.points.len()),
        };
        let verdict = judge(&evidence);
        Registration {
            T_target_source: match &self.lock {
                Some(lock) => lock.file_pose(pose),
                None => to_file(pose, self.source, self.target),
            },
            fitness: forward.share(limit),
            inlier_rmse: forward.rmse(limit),
            num_inliers: forward.within(limit),
            converged: evidence.converged && forward.within(limit) > 0,
            iterations: best.refined.iterations,
            probability: verdict.probability,
            covariance: rows(&uncertainty.covariance),
            free_directions: free_direction::name(&uncertainty.free, radius, self.target.origin),
            reasons: verdict.reasons,
            method: best.method,
            ..self.nothing_found()
        }
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

    /// The answer where no source of hypotheses had any.
    fn nothing_found(&self) -> Registration {
        let radius = f64::from(self.source.fine.radius);
        let points = self.source.fine.points.len().min(self.target.fine.points.len());
        Registration {
            T_target_source: to_file(&self.init, self.source, self.target),
            fitness: 0.0,
            inlier_rmse: 0.0,
            num_inliers: 0,
            converged: false,
            iterations: 0,
            probability: 0.0,
            covariance: rows(&Uncertainty::unknown(radius).covariance),
            free_directions: Vec::new(),
            reasons: judge(&Evidence::none(points)).reasons,
            method: self.settings.method,
            voxel_size: self.voxel_size,
            settings: Settings { voxel_size: Some(self.voxel_size), ..self.settings.clone() },
            timings_ms: Timings::default(),
        }
    }
}

fn rows(m: &Matrix6<f64>) -> [[f64; 6]; 6] {
    std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]))
}

/// Keeps the best `count` at most, and of those only what scores nearly as well as the best.
fn keep_promising(scored: &mut Vec<(f64, Hypothesis)>, count: usize) {
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    let enough = scored.first().map_or(0.0, |best| PROMISING * best.0);
    scored.retain(|&(score, _)| score >= enough);
    scored.truncate(count);
}

/// Matched points lie this many coarse voxels apart at most under a right pose.
const TOLERANCE_VOXELS: f32 = 1.5;

fn describe(level: &Level, feature: &dyn Feature) -> Result<Descriptors> {
    let neighborhoods = level.feature_graph();
    let mut normals = level.normals.clone();
    orient_by_curvature(&level.points, &mut normals, &neighborhoods);
    let input = FeatureInput { points: &level.points, normals: &normals, neighborhoods: &neighborhoods };
    feature.compute(&input)
}

fn to_local(file: &Rigid, source: &Prepared, target: &Prepared) -> Rigid {
    Rigid::from_translation(target.origin).inverse() * *file * Rigid::from_translation(source.origin)
}

fn to_file(local: &Rigid, source: &Prepared, target: &Prepared) -> Rigid {
    Rigid::from_translation(target.origin) * *local * Rigid::from_translation(source.origin).inverse()
}
