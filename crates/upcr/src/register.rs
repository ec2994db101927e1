//! The one pipeline: prepare, hypotheses, refine, verify.

use std::sync::Arc;
use std::time::Instant;

use nalgebra::{Matrix6, Matrix6xX};
use rayon::prelude::*;

use crate::{
    CloudRole, PointCloud, Result,
    cloud::orient_by_curvature,
    features::{Descriptors, Feature, FeatureInput},
    free_direction,
    hypothesis::{Hypothesis, Match, Problem, SOURCES, are_alike, match_levels, separation, turned},
    memory::most_cells,
    prepare::{Described, Level, Prepared, check, derive_voxel_size, prepare},
    refine::{Icp, LockedPose, Locks, Refined, Refinement, Schedule, factor},
    registration::{Alternative, Reason, Registration, TRUSTWORTHY, Timings},
    settings::{Method, Settings},
    threads::on_threads,
    transform::Rigid,
    verify::{Calibration, Evidence, Sizes, Uncertainty, judge, meeting, overlap_at, scaled, seen},
    watch::{Call, Stage, Stop, Watch},
};

/// Hypotheses that are refined on the coarse level, and of those on the fine one.
const COARSE_CANDIDATES: usize = 8;
const FINE_CANDIDATES: usize = 3;
/// Different poses that score at least this share of the best are as good an answer; so many of them are told.
const RIVALLING: f64 = 0.92;
const RIVALS: usize = 8;
/// A hypothesis that scores less than this share of the best is not looked at further.
const PROMISING: f64 = 0.7;
/// As much for turns of the best, which show what else the clouds would let pass.
const TELLING: f64 = 0.5;
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
/// Scores relative to another are told up to this.
const MOST_RELATIVE: f64 = 10.0;
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

/// A coarsely refined pose with its score.
#[derive(Clone, Copy)]
struct Glimpse {
    score: f64,
    pose: Rigid,
    /// Whether a source proposed it, and not only a turn.
    proposed: bool,
}

/// A refined pose with its score.
struct Candidate {
    method: Method,
    refined: Refined,
    score: f64,
    closeness: f64,
    /// Whether it was refined to the end, and so was all that its source proposed beside it.
    complete: bool,
}

fn run(source: &PointCloud, target: &PointCloud, settings: &Settings, call: &Call) -> Result<Registration> {
    let start = Instant::now();
    let mut found = run_as_is(source, target, settings, call)?;
    if !found.is_trustworthy() && call.ended_by().is_none() {
        let sizes = Sizes::of(source, target);
        found.source_scale = fitting_scale(&sizes, source, target, settings, call);
        if found.source_scale.is_some() || sizes.are_far_apart() {
            found.reasons.retain(|reason| *reason != Reason::PoorFit);
            found.reasons.insert(0, Reason::ScaleMismatch);
        }
    }
    if let Some(reason) = call.ended_by() {
        found.converged = false;
        found.reasons.push(reason);
    }
    found.timings_ms.total = milliseconds(start);
    call.end();
    Ok(found)
}

/// The factor that makes the source fit, where its own size does not.
fn fitting_scale(
    sizes: &Sizes,
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
    call: &Call,
) -> Option<f64> {
    // A guess at the wrong scale is none at the right one.
    let method = if settings.method == Method::Prior { Method::Auto } else { settings.method };
    let plain =
        Settings { method, init: None, locks: Locks::default(), voxel_size: None, ..settings.clone() };
    let factors = sizes.factors();
    if factors.is_empty() {
        return None;
    }
    let target = scaled(target, 1.0);
    for factor in factors {
        let aside = call.aside();
        let fits = run_as_is(&scaled(source, factor), &target, &plain, &aside);
        if aside.ended_by().is_some() {
            // What ends the question ends the call, which finds that out by asking.
            call.is_over();
            return None;
        }
        if fits.is_ok_and(|fits| fits.is_trustworthy()) {
            return Some(factor);
        }
    }
    None
}

/// The pose at the scale that the clouds have.
fn run_as_is(
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
    call: &Call,
) -> Result<Registration> {
    let start = Instant::now();
    match prepare_both(source, target, settings, call) {
        Ok(clouds) => {
            let mut pipeline = Pipeline::new(&clouds, settings, call)?;
            pipeline.timings.prepare = milliseconds(start);
            pipeline.best()
        }
        Err(Stop::Failed(error)) => Err(error),
        Err(Stop::Over | Stop::Full) => {
            let mut none = nothing_known(glanced_radius(source), settings);
            none.timings_ms.prepare = milliseconds(start);
            Ok(none)
        }
    }
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
    glimpses: Vec<Glimpse>,
    candidates: Vec<Candidate>,
    calibration: Arc<Calibration>,
    timings: Timings,
}

impl<'a> Pipeline<'a> {
    fn new(clouds: &'a Clouds, settings: &'a Settings, call: &'a Call) -> Result<Self> {
        let &Clouds { ref source, ref target, voxel_size, asks_network } = clouds;
        let init = settings.first_guess();
        let lock = LockedPose::new(settings.locks, &init, source.origin, target.origin);
        let init = to_local(&init, source, target);
        Ok(Self {
            source,
            target,
            settings,
            call,
            voxel_size,
            asks_network,
            init,
            lock,
            matches: Vec::new(),
            glimpses: Vec::new(),
            candidates: Vec::new(),
            calibration: settings.calibration.clone().map_or_else(Calibration::embedded, Ok)?,
            timings: Timings::default(),
        })
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
            let problem = Problem {
                source: self.source,
                target: self.target,
                matches: &self.matches,
                init: self.init,
                network: self.settings.network.as_deref(),
                tolerance: self.match_tolerance(),
                seed: self.settings.seed,
                alone: self.settings.method == source.method(),
                call: self.call,
            };
            let hypotheses = source.propose(&problem);
            self.timings.hypotheses += milliseconds(start);
            begin(Stage::Refine, (PROPOSED, REFINED));
            let start = Instant::now();
            let (refined, glimpses) = self.refined(&hypotheses);
            self.glimpses.extend(glimpses);
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
            // What two sources find ambiguous alike is.
            let settled = registration.evidence.rivals > 0 && self.sources_agree();
            best = Some(Registration { timings_ms: self.timings, ..registration });
            if sure || settled {
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

    /// Whether the points are samples as they were taken, not averages of many.
    fn samples(&self) -> bool {
        self.source.fine.sparse && self.target.fine.sparse
    }

    /// Distance between matched points under a right pose, at most.
    fn match_tolerance(&self) -> f32 {
        TOLERANCE_VOXELS * self.source.coarse().voxel_size.max(self.target.coarse().voxel_size)
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

    /// Ranks hypotheses by overlap, refines the best coarsely, ranks again, beside turns of the best, and refines
    /// the best of those finely. Beside these, all that was refined coarsely.
    fn refined(&self, hypotheses: &[Hypothesis]) -> (Vec<Candidate>, Vec<Glimpse>) {
        let (source, target) = (self.source.coarse(), self.target.coarse());
        let limit = self.coarse_reach();
        let rank = |pose: &Rigid, points: usize| overlap_at(source, target, pose, points, limit).score(2);
        let promising = |hypotheses: &[Hypothesis], points: usize, share: f64, of: f64| {
            let mut ranked: Vec<(f64, Hypothesis)> =
                hypotheses.par_iter().map(|h| (rank(&h.pose, points), *h)).collect();
            ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
            let least = share * of.max(ranked.first().map_or(0.0, |best| best.0));
            ranked.retain(|&(score, _)| score >= least);
            ranked.truncate(COARSE_CANDIDATES);
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
        let mut ranked = coarsely_refined(promising(hypotheses, RANKING_POINTS, PROMISING, 0.0));
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let glimpsed = |ranked: &[(f64, Hypothesis)], proposed| -> Vec<Glimpse> {
            ranked.iter().map(|&(score, h)| Glimpse { score, pose: h.pose, proposed }).collect()
        };
        let mut glimpses = glimpsed(&ranked, true);
        if let Some((score, best)) = ranked.first()
            && *score < COINCIDENT
            && !self.call.is_over()
        {
            let turns: Vec<Hypothesis> =
                turned(source, &best.pose).into_iter().map(|pose| Hypothesis { pose, ..*best }).collect();
            let others = promising(&turns, GLANCING_POINTS, TELLING, *score);
            let others = coarsely_refined(others);
            glimpses.extend(glimpsed(&others, false));
            ranked.extend(others);
            ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        }
        let mut distinct: Vec<(f64, Hypothesis)> = Vec::new();
        for (score, h) in ranked {
            if distinct.iter().all(|(_, d)| !self.coarsely_same(&d.pose, &h.pose)) {
                distinct.push((score, h));
            }
        }
        let best = distinct.first().map_or(0.0, |best| best.0);
        let worth_it = |rank: usize, score: f64| {
            let enough = if rank < FINE_CANDIDATES { PROMISING } else { RIVALLING };
            rank < RIVALS && score >= enough * best
        };
        let count =
            distinct.iter().enumerate().take_while(|(rank, (score, _))| worth_it(*rank, *score)).count();
        let going_on = |&(rank, _): &(usize, _)| rank == 0 || !self.call.is_over();
        let fine = distinct[..count].iter().enumerate().take_while(going_on);
        let candidates = fine.map(|(rank, (_, h))| {
            self.call.advance(rank as f64 / count as f64);
            self.finely_refined(h)
        });
        (candidates.collect(), glimpses)
    }

    /// Distance within which points of the coarse level count as near.
    fn coarse_reach(&self) -> f32 {
        REACH_VOXELS * self.source.coarse().voxel_size.max(self.target.coarse().voxel_size)
    }

    /// Whether two poses, coarsely refined, are one answer.
    fn coarsely_same(&self, a: &Rigid, b: &Rigid) -> bool {
        separation(a, b, f64::from(self.source.fine.radius)) <= f64::from(self.coarse_reach())
    }

    /// How far the sources agree on `pose`, and the coarse score of the best other pose over its own.
    fn glimpsed(&self, pose: &Rigid) -> (f64, f64) {
        let (source, target) = (self.source.coarse(), self.target.coarse());
        let here = overlap_at(source, target, pose, COMPARING_POINTS, self.coarse_reach()).score(2);
        let (same, others): (Vec<&Glimpse>, Vec<&Glimpse>) =
            self.glimpses.iter().partition(|glimpse| self.coarsely_same(&glimpse.pose, pose));
        let proposed = |glimpses: &[&Glimpse]| glimpses.iter().filter(|g| g.proposed).count();
        let (agreeing, not) = (proposed(&same), proposed(&others));
        let best_other = others.iter().map(|glimpse| glimpse.score).fold(0.0, f64::max);
        let relative = if best_other == 0.0 { 0.0 } else { (best_other / here).min(MOST_RELATIVE) };
        (agreeing as f64 / (agreeing + not).max(1) as f64, relative)
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
        let closeness = score / overlap.score(1).max(f64::MIN_POSITIVE);
        // Walls that slide along each other overlap more than those that stand where they belong, but less closely.
        Candidate { method: hypothesis.method, refined, score: score * closeness, closeness, complete: true }
    }

    /// The best candidate with the verdict on it.
    fn verified(&self) -> Registration {
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
        let forward = meeting(source, &held_out(self.source), target, pose, limit);
        let backward = meeting(target, &held_out(self.target), source, &pose.inverse(), limit);
        let uncertainty = self.uncertainty(pose);
        let (agreement, glimpsed) = self.glimpsed(pose);
        let tolerance = self.match_tolerance();
        let explained = |matches: &[Match]| matches.iter().filter(|m| m.agrees_with(pose, tolerance)).count();
        let evidence = Evidence {
            closeness: best.closeness,
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

    /// Whether two poses, finely refined, are one answer.
    fn same(&self, a: &Candidate, b: &Candidate) -> bool {
        let radius = f64::from(self.source.fine.radius);
        separation(&a.refined.pose, &b.refined.pose, radius) <= DISTINCT_VOXELS * self.voxel_size
    }

    /// Whether another source of hypotheses came to the best pose too.
    fn sources_agree(&self) -> bool {
        let Some(best) = self.candidates.first() else { return false };
        self.candidates.iter().any(|c| c.method != best.method && self.same(c, best))
    }

    /// Candidates that are clearly different from `best` and from each other, best first.
    fn others(&self, best: &Candidate) -> Vec<&Candidate> {
        let mut others: Vec<&Candidate> = Vec::new();
        for candidate in &self.candidates {
            if !self.same(candidate, best) && others.iter().all(|other| !self.same(candidate, other)) {
                others.push(candidate);
            }
        }
        others
    }

    /// The pose between the clouds in their files' frames.
    fn file_pose(&self, local: &Rigid) -> Rigid {
        match &self.lock {
            Some(lock) => lock.file_pose(local),
            None => to_file(local, self.source, self.target),
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
            Some(information) => Uncertainty::of(&information, &tangent, radius, self.samples()),
            None => Uncertainty::unknown(radius),
        }
    }

    /// The answer where no source of hypotheses had any.
    fn nothing_found(&self) -> Registration {
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
fn nothing_known(radius: f64, settings: &Settings) -> Registration {
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

fn rows(m: &Matrix6<f64>) -> [[f64; 6]; 6] {
    std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]))
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
