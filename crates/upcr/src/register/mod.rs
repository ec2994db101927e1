//! The one pipeline: prepare, hypotheses, refine, verify.

mod answer;
mod candidates;
mod ready;

use std::sync::Arc;

use web_time::Instant;

use crate::{
    CloudRole, PointCloud, Result,
    cloud::orient_by_curvature,
    features::{Descriptors, Feature, FeatureInput},
    hypothesis::{Match, Problem, SOURCES, are_alike, match_levels},
    memory::most_cells,
    prepare::{Described, Level, Prepared, check, derive_voxel_size, prepare},
    refine::{Icp, LockedPose, factor},
    registration::{Reason, Registration, TRUSTWORTHY, Timings},
    settings::{Method, Settings},
    threads::on_threads,
    transform::Rigid,
    verify::{Calibration, Sizes, View},
    watch::{Call, Stage, Stop, Watch},
};
use answer::{glanced_radius, nothing_known};
use candidates::{Candidate, Glimpse};
pub use ready::{ReadyScan, register_ready};

/// Matched points lie this many coarse voxels apart at most under a right pose.
const TOLERANCE_VOXELS: f32 = 1.5;
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

fn run(source: &PointCloud, target: &PointCloud, settings: &Settings, call: &Call) -> Result<Registration> {
    let start = Instant::now();
    let mut found = run_as_is(source, target, settings, call)?;
    if !found.is_trustworthy() && call.ended_by().is_none() {
        let sizes = Sizes::of(source, target);
        found.source_scale = sizes.fitting_factor(source, target, settings, call, run_as_is);
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
            let Clouds { source, target, voxel_size, asks_network } = &clouds;
            let mut pipeline = Pipeline::new(source, target, *voxel_size, *asks_network, settings, call)?;
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
    /// What the sensors of source and target saw.
    views: [Option<View>; 2],
    /// Of source and target, where they are known already.
    descriptors: Option<[&'a Descriptors; 2]>,
    matches: Vec<Match>,
    glimpses: Vec<Glimpse>,
    candidates: Vec<Candidate>,
    calibration: Arc<Calibration>,
    timings: Timings,
}

impl<'a> Pipeline<'a> {
    fn new(
        source: &'a Prepared,
        target: &'a Prepared,
        voxel_size: f64,
        asks_network: bool,
        settings: &'a Settings,
        call: &'a Call,
    ) -> Result<Self> {
        let init = settings.first_guess();
        let lock = LockedPose::new(settings.locks, &init, source.origin, target.origin);
        let init = to_local(&init, source, target);
        let views = rayon::join(|| View::of(source), || View::of(target)).into();
        Ok(Self {
            source,
            target,
            settings,
            call,
            voxel_size,
            asks_network,
            init,
            lock,
            views,
            descriptors: None,
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
        if let Some([da, db]) = self.descriptors {
            return Ok(match_levels((a, da), (b, db)));
        }
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
}

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
