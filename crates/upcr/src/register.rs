//! The one pipeline: prepare, hypotheses, refine, verify.

use std::time::Instant;

use nalgebra::Matrix6;
use rayon::prelude::*;

use crate::{
    CloudRole, PointCloud, Result,
    cloud::orient_by_curvature,
    features::{Descriptors, Feature, FeatureInput},
    hypothesis::{Hypothesis, Match, Problem, SOURCES, are_alike, match_levels, separation},
    memory::most_cells,
    prepare::{Described, Level, Prepared, check, derive_voxel_size, prepare},
    refine::{Icp, LockedPose, Refined, Refinement, Schedule, factor},
    registration::{Registration, TRUSTWORTHY, Timings},
    settings::{Method, Settings},
    threads::on_threads,
    transform::Rigid,
    verify::{Evidence, conditioning, covariance, distances, judge, overlap_at},
    watch::{Call, Stage, Stop, Watch},
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
/// Held-out points that are looked at although the time is up: they take a few milliseconds.
const QUICKLY_SEEN: usize = 16_384;
/// Points of the source that tell its size where nothing else is known.
const GLANCED_POINTS: usize = 1024;
/// Probability, at most, of a pose that was not refined to the end, or not compared with all that was to stand beside it.
const CUT_SHORT: f64 = 0.9 * TRUSTWORTHY;
/// Share of the longest way that is behind once the clouds are prepared; of a source's, once it has proposed its poses,
/// and once these are refined.
const PREPARED: f64 = 0.25;
const PROPOSED: f64 = 0.5;
const REFINED: f64 = 0.95;

/// Finds the pose that lays `source` on `target`.
///
/// # Errors
/// Where a cloud is too small, degenerate or not finite, or a setting is out of its range. Clouds that cannot
/// be registered are no error: the result says so (`probability`, `reasons`).
pub fn register(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Registration> {
    register_watched(source, target, settings, &Watch::default())
}

/// As [`register`], watched: it may be cancelled, and tells how far it is. As long as it is not cancelled, the result is
/// the same.
///
/// # Errors
/// As [`register`].
pub fn register_watched(
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
    watch: &Watch,
) -> Result<Registration> {
    settings.check()?;
    let call = Call::new(settings.max_seconds, *watch);
    on_threads(settings.threads, || run(source, target, settings, &call))?
}

/// A refined pose with its score.
struct Candidate {
    method: Method,
    refined: Refined,
    score: f64,
    sharpness: f64,
    /// Whether it was refined to the end, and so was all that its source proposed beside it.
    complete: bool,
}

fn run(source: &PointCloud, target: &PointCloud, settings: &Settings, call: &Call) -> Result<Registration> {
    let start = Instant::now();
    let mut best = match prepare_both(source, target, settings, call) {
        Ok(clouds) => {
            let mut pipeline = Pipeline::new(&clouds, settings, call);
            pipeline.timings.prepare = milliseconds(start);
            pipeline.best()?
        }
        Err(Stop::Failed(error)) => return Err(error),
        Err(Stop::Over | Stop::Full) => {
            let mut none = nothing_known(glanced_radius(source), settings);
            none.timings_ms.prepare = milliseconds(start);
            none
        }
    };
    if let Some(reason) = call.ended_by() {
        best.converged = false;
        best.reasons.push(reason);
    }
    best.timings_ms.total = milliseconds(start);
    call.end();
    Ok(best)
}

/// Both clouds, ready to be registered.
struct Clouds {
    source: Prepared,
    target: Prepared,
    voxel_size: f64,
    asks_network: bool,
}

fn prepare_both(
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
    call: &Call,
) -> Result<Clouds, Stop> {
    call.begin(Stage::Prepare, None, (0.0, PREPARED));
    call.go_on()?;
    let (source, target) =
        rayon::join(|| check(source, CloudRole::Source, call), || check(target, CloudRole::Target, call));
    let (mut source, mut target) = (source?, target?);
    call.advance(0.2);
    let asks_network = match settings.method {
        Method::Auto => are_alike(source.cloud, target.cloud),
        method => method == Method::Upcr,
    };
    let described = match settings.method {
        Method::Prior => Described::Never,
        _ if asks_network => Described::Perhaps,
        _ => Described::Surely,
    };
    let most = most_cells(settings.max_memory_bytes, [source.len(), target.len()])?;
    loop {
        call.go_on()?;
        let voxel_size = settings.voxel_size.unwrap_or_else(|| derive_voxel_size(&source, &target));
        call.go_on()?;
        call.advance(0.4);
        let ready = rayon::join(
            || prepare(&source, voxel_size, described, most[0], call),
            || prepare(&target, voxel_size, described, most[1], call),
        );
        match ready {
            (Err(Stop::Full), Err(Stop::Full)) => {
                source.thin();
                target.thin();
            }
            (Err(Stop::Full), _) => source.thin(),
            (_, Err(Stop::Full)) => target.thin(),
            (source, target) => {
                return Ok(Clouds { source: source?, target: target?, voxel_size, asks_network });
            }
        }
    }
}

/// About half the length of the cloud's bounding box's diagonal, from a few points that need not be sound; never zero.
fn glanced_radius(cloud: &PointCloud) -> f64 {
    let step = cloud.len().div_ceil(GLANCED_POINTS).max(1);
    let few = cloud.points.iter().step_by(step).filter(|p| p.iter().all(|v| v.is_finite())).copied();
    let bounds = PointCloud::from_points(few.collect()).checked_bounds(CloudRole::Source);
    match bounds.ok().flatten().map(|b| 0.5 * b.diagonal()) {
        Some(radius) if radius > 0.0 && radius.is_finite() => radius,
        _ => 1.0,
    }
}

fn milliseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Two prepared clouds and what is known of them so far.
struct Pipeline<'a> {
    source: &'a Prepared,
    target: &'a Prepared,
    settings: &'a Settings,
    call: &'a Call<'a>,
    voxel_size: f64,
    asks_network: bool,
    init: Rigid,
    lock: Option<LockedPose>,
    matches: Vec<Match>,
    candidates: Vec<Candidate>,
    timings: Timings,
}

impl<'a> Pipeline<'a> {
    fn new(clouds: &'a Clouds, settings: &'a Settings, call: &'a Call) -> Self {
        let &Clouds { ref source, ref target, voxel_size, asks_network } = clouds;
        let init = settings.init.unwrap_or_else(Rigid::identity);
        let lock = LockedPose::new(settings.locks, &init, source.origin, target.origin);
        let init = to_local(&init, source, target);
        Self {
            source,
            target,
            settings,
            call,
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
        let wanted: Vec<_> = SOURCES.iter().filter(|source| self.wants(source.method())).collect();
        let part = (1.0 - PREPARED) / wanted.len() as f64;
        for (source, from) in wanted.iter().zip((0..).map(|i| PREPARED + part * f64::from(i))) {
            // A given pose is there at no cost.
            if (best.is_some() || source.method() != Method::Prior) && self.call.is_over() {
                break;
            }
            let begin = |stage, share: (f64, f64)| {
                self.call.begin(stage, Some(source.method()), (from + part * share.0, from + part * share.1));
            };
            begin(Stage::Hypotheses, (0.0, PROPOSED));
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
                call: self.call,
            };
            let hypotheses = source.propose(&problem);
            self.timings.hypotheses += milliseconds(start);
            begin(Stage::Refine, (PROPOSED, REFINED));
            let start = Instant::now();
            let refined = self.refined(&hypotheses, |best| source.alternatives(&problem, best));
            let complete = self.call.ended_by().is_none();
            self.candidates.extend(refined.into_iter().map(|c| Candidate { complete, ..c }));
            self.candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
            self.timings.refine += milliseconds(start);
            begin(Stage::Verify, (REFINED, 1.0));
            let start = Instant::now();
            let mut registration = self.verified();
            if self.candidates.first().is_some_and(|best| !best.complete) {
                registration.probability = registration.probability.min(CUT_SHORT);
            }
            self.timings.verify += milliseconds(start);
            let sure = registration.probability >= source.sure();
            best = Some(Registration { timings_ms: self.timings, ..registration });
            if sure {
                break;
            }
        }
        Ok(best.unwrap_or_else(|| Registration { timings_ms: self.timings, ..self.nothing_found() }))
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
        let (da, db) = rayon::join(|| describe(a, feature, self.call), || describe(b, feature, self.call));
        if self.call.is_over() {
            return Ok(Vec::new());
        }
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
            call: self.call,
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
            if self.settings.refine == Refinement::None || ranked.is_empty() || self.call.is_over() {
                return ranked;
            }
            let icp = self.icp(source, target);
            let refined = ranked.par_iter().map(|(_, h)| {
                let pose = icp.refine(&moved, &h.pose, &Schedule::coarse(limit)).pose;
                (rank(&pose, COMPARING_POINTS), Hypothesis { pose, ..*h })
            });
            refined.collect()
        };
        // The best come first.
        let few = hypotheses.len().min(COARSE_CANDIDATES);
        let hypotheses =
            if hypotheses.len() > few && self.call.is_over() { &hypotheses[..few] } else { hypotheses };
        let mut ranked = coarsely_refined(promising(hypotheses, RANKING_POINTS, 0.0));
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        if let Some((score, best)) = ranked.first()
            && *score < COINCIDENT
            && !self.call.is_over()
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
        let shares = (0..).map(|i| f64::from(i) / distinct.len() as f64);
        let going_on = |&(share, _): &(f64, _)| share == 0.0 || !self.call.is_over();
        let refined = shares.zip(&distinct).take_while(going_on).map(|(share, (_, h))| {
            self.call.advance(share);
            self.finely_refined(h)
        });
        refined.collect()
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
            if few.len() == moved.len() || self.call.is_over() {
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
        Candidate { method: hypothesis.method, refined, score: score * sharpness, sharpness, complete: true }
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
        let seen = |cloud: &Prepared| match cloud.held_out_points() {
            all if all.len() > QUICKLY_SEEN && self.call.is_over() => Level::thin(&all, QUICKLY_SEEN),
            all => all,
        };
        let forward = distances(source, &seen(self.source), target, pose, limit);
        let backward = distances(target, &seen(self.target), source, &pose.inverse(), limit);
        let conditioning = conditioning(&best.refined.shape_hessian, radius);
        let inliers = forward.within(limit) + backward.within(limit);
        let evidence = Evidence {
            overlap: [forward.share(limit), backward.share(limit)],
            inliers,
            sharpness: best.sharpness,
            runner_up,
            conditioning,
            converged: best.refined.converged || self.settings.refine == Refinement::None,
            points: source.points.len().min(target.points.len()),
        };
        let verdict = judge(&evidence);
        let covariance = covariance(&best.refined.hessian, best.refined.variance, radius);
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
            covariance: std::array::from_fn(|r| std::array::from_fn(|c| covariance[(r, c)])),
            reasons: verdict.reasons,
            method: best.method,
            ..self.nothing_found()
        }
    }

    /// The answer where no source of hypotheses had any.
    fn nothing_found(&self) -> Registration {
        let points = self.source.fine.points.len().min(self.target.fine.points.len());
        let none = nothing_known(f64::from(self.source.fine.radius), self.settings);
        Registration {
            T_target_source: to_file(&self.init, self.source, self.target),
            // Nothing speaks against a pose that was not looked for.
            reasons: match self.call.ended_by() {
                None => judge(&Evidence::none(points)).reasons,
                Some(_) => Vec::new(),
            },
            voxel_size: self.voxel_size,
            points_used: [self.source.points_used, self.target.points_used],
            settings: Settings { voxel_size: Some(self.voxel_size), ..none.settings },
            ..none
        }
    }
}

/// The answer where nothing is known but about how large the source is.
fn nothing_known(radius: f64, settings: &Settings) -> Registration {
    let covariance = covariance(&Matrix6::zeros(), 0.0, radius);
    Registration {
        T_target_source: settings.init.unwrap_or_else(Rigid::identity),
        fitness: 0.0,
        inlier_rmse: 0.0,
        num_inliers: 0,
        converged: false,
        iterations: 0,
        probability: 0.0,
        covariance: std::array::from_fn(|r| std::array::from_fn(|c| covariance[(r, c)])),
        reasons: Vec::new(),
        method: settings.method,
        voxel_size: settings.voxel_size.unwrap_or(0.0),
        points_used: [0; 2],
        settings: settings.clone(),
        timings_ms: Timings::default(),
    }
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

fn describe(level: &Level, feature: &dyn Feature, call: &Call) -> Result<Descriptors> {
    let is_over = || call.is_over();
    let neighborhoods = level.feature_graph(&is_over);
    let mut normals = level.normals.clone();
    orient_by_curvature(&level.points, &mut normals, &neighborhoods);
    let input = FeatureInput { points: &level.points, normals: &normals, neighborhoods: &neighborhoods };
    feature.compute_unless(&input, &is_over)
}

fn to_local(file: &Rigid, source: &Prepared, target: &Prepared) -> Rigid {
    Rigid::from_translation(target.origin).inverse() * *file * Rigid::from_translation(source.origin)
}

fn to_file(local: &Rigid, source: &Prepared, target: &Prepared) -> Rigid {
    Rigid::from_translation(target.origin) * *local * Rigid::from_translation(source.origin).inverse()
}
