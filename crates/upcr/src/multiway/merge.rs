//! From scans that lie anywhere to their poses in common models.
//!
//! Scans that look alike are registered with each other, the poses of pairs become a graph, and the graph's poses say which
//! other pairs overlap and are registered too. Parts of the graph are joined only where the pairs that would come to lie on each
//! other speak for it: one room looks like another, and a wrong pair agrees with all others between the two. What is known of a
//! pair is told as soon as it is known, and need not be found again.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use nalgebra::{Matrix3, Matrix6, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::pose_graph::{Edge, Joining, PoseGraph, Solution, odds};
use super::vocabulary::{Vocabulary, alike, looks};
use crate::{
    PointCloud, ReadyScan, Result, Settings, features::Descriptors, register_ready,
    registration::TRUSTWORTHY, settings::Method, threads::on_threads, transform::Rigid,
};

/// Scans that tell the common scale.
const SCALED: usize = 24;
/// Rounds in which models that nothing joins yet are looked at again.
const JOINING_ROUNDS: usize = 3;
/// Rounds in which scans that the poses bring together are registered.
const CLOSING_ROUNDS: usize = 2;
/// Points of a scan that tell whether it overlaps another, edge of the cells in which they do, in voxels, and share of the
/// smaller scan's cells.
const SAMPLE: usize = 2048;
const CELL_VOXELS: f64 = 8.0;
const OVERLAPPING: f64 = 0.25;
/// Probability from which on a pair is not looked at again from where the poses lay it.
const SURE: f64 = 0.9;
/// Pairs that are asked whether two parts may be joined, the share by which they are to overlap, and edge of the cells in which they
/// do: so small that the two sides of a thing are apart.
const WITNESSES: usize = 12;
const WITNESSING: f64 = 0.25;
const WITNESS_CELL_VOXELS: f64 = 3.0;
/// Poses that differ by less, in voxels anywhere on the source, are one.
const SAME_VOXELS: f64 = 4.0;
/// Scans in one cell that are looked at.
const MOST_IN_A_CELL: usize = 48;
/// Registrations are a little further off than their covariances know: as a share of the voxel size.
const SYSTEMATIC_VOXELS: f64 = 0.25;
/// Bytes of scans held at once where no bound is given.
const DEFAULT_MEMORY: u64 = 2 << 30;

/// Where scans come from: read when they are needed, and as often.
pub trait Scans: Sync {
    /// How many there are.
    fn len(&self) -> usize;

    /// Whether there is none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Reads one.
    ///
    /// # Errors
    /// Where it cannot be read: the others are merged without it.
    fn read(&self, scan: usize) -> Result<PointCloud>;
}

impl Scans for [PointCloud] {
    fn len(&self) -> usize {
        <[PointCloud]>::len(self)
    }

    fn read(&self, scan: usize) -> Result<PointCloud> {
        Ok(self[scan].clone())
    }
}

/// How scans are merged.
#[derive(Debug, Clone, PartialEq)]
pub struct MergeSettings {
    /// How pairs are registered. Its voxel size is that of all scans; `init`, `locks` and the memory bound are of no use here.
    pub registration: Settings,
    /// Scans that each is registered with, of those that look most like it.
    pub neighbors: usize,
    /// Whether the scans are in the order in which they were taken: each is registered with the two after it as well.
    pub sequential: bool,
    /// Bytes of scans that are held at once.
    pub max_memory_bytes: Option<u64>,
}

impl Default for MergeSettings {
    fn default() -> Self {
        Self { registration: Settings::default(), neighbors: 8, sequential: false, max_memory_bytes: None }
    }
}

/// Why a pair was registered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Proposal {
    /// One scan follows the other.
    Sequence,
    /// They look alike.
    Likeness,
    /// The poses of other pairs lay one on the other, and it was looked whether it belongs there.
    Overlap,
}

/// A pair that was registered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attempt {
    /// The scan that is moved.
    pub source: usize,
    /// The scan that stays.
    pub target: usize,
    /// Why these two.
    pub proposal: Proposal,
    /// Of an overlap, where the other pairs lay it.
    pub prior: Option<[[f64; 4]; 4]>,
    /// Takes source coordinates to target coordinates: 4×4, row after row.
    pub T_target_source: [[f64; 4]; 4],
    /// Probability that it does.
    pub probability: f64,
    /// As [`crate::Registration::covariance`].
    pub covariance: [[f64; 6]; 6],
    /// As [`crate::Registration::fitness`].
    pub fitness: f64,
    /// As [`crate::Registration::reasons`].
    pub reasons: Vec<crate::Reason>,
}

/// What became of a pair.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JudgedAttempt {
    /// The pair.
    #[serde(flatten)]
    pub attempt: Attempt,
    /// Whether the poses rest on it.
    pub kept: bool,
    /// Whether it was trusted as a pair, and the pairs that would come to lie on each other by it speak against it.
    pub contradicted: bool,
    /// Squared error under its covariance, where it was trusted as a pair and is not contradicted.
    pub chi_sq: Option<f64>,
}

/// Where a scan lies.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Place {
    /// In a model of two scans or more.
    Placed {
        /// The model's number: 0 is the one of the most scans.
        model: usize,
        /// Takes the scan's coordinates to the model's.
        T_model_scan: Rigid,
        /// Kept pairs that hold it there.
        pairs: usize,
        /// Probability that one of these pairs at least is right.
        probability: f64,
    },
    /// No pair with it is to be trusted.
    Alone,
    /// It cannot be used.
    Unusable {
        /// Why.
        reason: String,
    },
}

impl Place {
    /// Why the scan lies in no model, where it does not.
    pub fn reason(&self) -> Option<&str> {
        match self {
            Self::Placed { .. } => None,
            Self::Alone => Some("no pair with it is to be trusted"),
            Self::Unusable { reason } => Some(reason),
        }
    }
}

/// What was made of the scans.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Merged {
    /// Of each scan.
    pub places: Vec<Place>,
    /// All pairs that were registered, in order of their scans.
    pub pairs: Vec<JudgedAttempt>,
    /// What the poses are the solution of: the pairs that were trusted.
    #[serde(skip)]
    pub graph: PoseGraph,
    /// The common voxel size.
    pub voxel_size: f64,
    /// By how much the covariances of pairs were multiplied, so that pairs agree with each other as they should.
    pub inflation: f64,
}

/// How far a merge is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MergeProgress {
    /// What is being done.
    pub step: MergeStep,
    /// Scans or pairs of this step that are done, and all of them.
    pub done: usize,
    /// See `done`.
    pub of: usize,
}

/// A step of a merge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MergeStep {
    /// Scans are read, and described.
    Describe,
    /// Pairs are registered.
    Register,
}

/// How a merge is watched from outside.
#[derive(Clone, Copy)]
pub struct MergeWatch<'a> {
    /// Hears each pair that was registered, in order, from one thread at a time.
    pub pair: &'a (dyn Fn(&Attempt) -> Result<()> + Sync),
    /// Hears how far it is.
    pub progress: &'a (dyn Fn(MergeProgress) + Sync),
    /// Hears the poses of all scans whenever they are aligned anew, step by step; the last ones are those of the result.
    pub alignment: &'a (dyn Fn(&[Rigid]) + Sync),
}

impl Default for MergeWatch<'_> {
    fn default() -> Self {
        Self { pair: &|_| Ok(()), progress: &|_| (), alignment: &|_| () }
    }
}

/// Finds the poses of all scans. `known` are pairs that an earlier call of the same scans and settings told.
///
/// # Errors
/// Where a setting is out of its range, or `watch` cannot take what it hears. Scans that cannot be read or placed are no error: the
/// result says so.
pub fn merge(
    scans: &(impl Scans + ?Sized),
    settings: &MergeSettings,
    known: &[Attempt],
    watch: &MergeWatch,
) -> Result<Merged> {
    settings.registration.check()?;
    on_threads(settings.registration.threads, || Merge::new(scans, settings, known, watch).run())?
}

/// A pair that is to be registered.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    source: usize,
    target: usize,
    proposal: Proposal,
    /// Where it is looked for alone.
    prior: Option<Rigid>,
}

impl Wanted {
    fn searched(a: usize, b: usize, proposal: Proposal) -> Self {
        Self { source: a.max(b), target: a.min(b), proposal, prior: None }
    }

    /// As `T_b_a` has it.
    fn laid(a: usize, b: usize, T_b_a: Rigid) -> Self {
        let prior = Some(if a > b { T_b_a } else { T_b_a.inverse() });
        Self { source: a.max(b), target: a.min(b), proposal: Proposal::Overlap, prior }
    }
}

struct Merge<'a, S: ?Sized> {
    scans: &'a S,
    settings: &'a MergeSettings,
    watch: &'a MergeWatch<'a>,
    voxel_size: f64,
    surveyed: Vec<Surveyed>,
    /// Scans that are ready, and the bytes that they may take.
    ready: BTreeMap<usize, ReadyScan>,
    memory: usize,
    /// By their scans, the source's number first.
    known: BTreeMap<(usize, usize), Vec<Attempt>>,
    attempts: BTreeMap<(usize, usize), Vec<Attempt>>,
}

/// What is kept of each scan.
struct Surveyed {
    /// Why it cannot be used.
    fault: Option<String>,
    center: [f64; 3],
    radius: f64,
    /// Bytes that it takes when it is ready.
    bytes: usize,
    /// Some points, about the centre.
    sample: Vec<[f32; 3]>,
    /// The small cells of these.
    cells: HashSet<[i32; 3]>,
    /// What it looks like.
    looks: Descriptors,
}

/// Poses, and what they are the solution of.
struct Solved {
    graph: PoseGraph,
    /// Scans of each of the graph's edges.
    pairs: Vec<(usize, usize)>,
    solution: Solution,
}

impl<'a, S: Scans + ?Sized> Merge<'a, S> {
    fn new(scans: &'a S, settings: &'a MergeSettings, known: &[Attempt], watch: &'a MergeWatch<'a>) -> Self {
        let voxel_size = match settings.registration.voxel_size {
            Some(voxel_size) => voxel_size,
            None => common_voxel_size(scans),
        };
        let mut by_scans: BTreeMap<(usize, usize), Vec<Attempt>> = BTreeMap::new();
        for attempt in known {
            by_scans.entry((attempt.source, attempt.target)).or_default().push(attempt.clone());
        }
        let memory = settings.max_memory_bytes.unwrap_or(DEFAULT_MEMORY);
        let mut merge = Self {
            scans,
            settings,
            watch,
            voxel_size,
            surveyed: Vec::new(),
            ready: BTreeMap::new(),
            memory: usize::try_from(memory).unwrap_or(usize::MAX),
            known: by_scans,
            attempts: BTreeMap::new(),
        };
        merge.survey();
        merge
    }

    /// Reads every scan once.
    fn survey(&mut self) {
        let together = rayon::current_num_threads().max(1);
        let all: Vec<usize> = (0..self.scans.len()).collect();
        let mut held = 0;
        for (n, some) in all.chunks(together).enumerate() {
            (self.watch.progress)(MergeProgress {
                step: MergeStep::Describe,
                done: n * together,
                of: all.len(),
            });
            let found: Vec<Result<(ReadyScan, Surveyed)>> =
                some.par_iter().map(|&scan| self.surveyed(scan)).collect();
            for (&scan, found) in some.iter().zip(found) {
                match found {
                    Ok((ready, surveyed)) => {
                        if held + surveyed.bytes <= self.memory {
                            held += surveyed.bytes;
                            self.ready.insert(scan, ready);
                        }
                        self.surveyed.push(surveyed);
                    }
                    Err(error) => self.surveyed.push(Surveyed::unusable(error.to_string())),
                }
            }
        }
    }

    /// The small cell in which a place of a scan, about its centre, is.
    fn small_cell(&self, place: &Vector3<f64>) -> [i32; 3] {
        cell_of(place, WITNESS_CELL_VOXELS * self.voxel_size)
    }

    fn surveyed(&self, scan: usize) -> Result<(ReadyScan, Surveyed)> {
        let feature = self.settings.registration.feature;
        let cloud = self.scans.read(scan)?;
        let ready = ReadyScan::new(&cloud, self.voxel_size, feature)?;
        let sample = ready.sample(SAMPLE);
        let surveyed = Surveyed {
            fault: None,
            center: ready.center(),
            radius: ready.radius(),
            bytes: ready.bytes(),
            cells: sample.iter().map(|p| self.small_cell(&Vector3::from(p.map(f64::from)))).collect(),
            sample,
            looks: looks(&cloud, self.voxel_size, feature)?,
        };
        Ok((ready, surveyed))
    }

    fn make_ready(&self, scan: usize) -> Result<ReadyScan> {
        ReadyScan::new(&self.scans.read(scan)?, self.voxel_size, self.settings.registration.feature)
    }

    fn run(mut self) -> Result<Merged> {
        let usable = |s: &Surveyed| s.fault.is_none();
        let nothing = || Descriptors { dim: 0, values: Vec::new() };
        let looks: Vec<Descriptors> =
            self.surveyed.iter_mut().map(|s| std::mem::replace(&mut s.looks, nothing())).collect();
        let vocabulary = Vocabulary::learn(&looks, self.settings.registration.seed);
        let vectors: Vec<Vec<f32>> = looks.par_iter().map(|looks| vocabulary.describe(looks)).collect();
        drop(looks);
        let neighbors = self.settings.neighbors.max(1);
        let order: Vec<Vec<usize>> = alike(&vectors, neighbors * (1 + JOINING_ROUNDS))
            .into_iter()
            .map(|others| others.into_iter().map(|(j, _)| j).filter(|&j| usable(&self.surveyed[j])).collect())
            .collect();

        let mut wanted = Vec::new();
        if self.settings.sequential {
            let taken: Vec<usize> = (0..self.scans.len()).filter(|&i| usable(&self.surveyed[i])).collect();
            for step in 1..=2 {
                let following = taken.windows(step + 1);
                wanted.extend(following.map(|w| Wanted::searched(w[step], w[0], Proposal::Sequence)));
            }
        }
        for (i, others) in order.iter().enumerate().filter(|(i, _)| usable(&self.surveyed[*i])) {
            let nearest = others.iter().take(neighbors);
            wanted.extend(nearest.map(|&j| Wanted::searched(i, j, Proposal::Likeness)));
        }
        self.register(wanted)?;
        let mut solved = self.solve()?;

        for round in 1..=JOINING_ROUNDS {
            let models = &solved.solution.models;
            let sizes = sizes(models);
            let largest = (0..sizes.len()).max_by_key(|&m| (sizes[m], usize::MAX - m));
            let mut wanted = Vec::new();
            for (i, others) in order.iter().enumerate() {
                if usable(&self.surveyed[i]) && Some(models[i]) != largest {
                    let more =
                        others.iter().take(neighbors * (1 + round)).filter(|&&j| models[j] != models[i]);
                    wanted.extend(more.map(|&j| Wanted::searched(i, j, Proposal::Likeness)));
                }
            }
            if !self.register(wanted)? {
                break;
            }
            solved = self.solve()?;
        }
        for _ in 0..CLOSING_ROUNDS {
            let wanted = self.overlapping(&solved.solution);
            if !self.register(wanted)? {
                break;
            }
            solved = self.solve()?;
        }
        Ok(self.merged(solved))
    }

    /// Whether `attempt` answers what is wanted.
    fn answers(&self, attempt: &Attempt, wanted: &Wanted) -> bool {
        match (&attempt.prior, &wanted.prior) {
            (Some(told), Some(prior)) => self.same(&exactly(told), prior, wanted.source),
            // What was looked for once is not looked for again for another reason.
            (None, None) => true,
            _ => false,
        }
    }

    /// Whether two poses lay a source nearly alike.
    fn same(&self, a: &Rigid, b: &Rigid, source: usize) -> bool {
        let Surveyed { center, radius, .. } = &self.surveyed[source];
        let apart = a.inverse() * *b;
        let shift = (Vector3::from(apart.apply(*center)) - Vector3::from(*center)).norm();
        let turn = ((apart.rotation.trace() - 1.0) / 2.0).clamp(-1.0, 1.0).acos();
        shift + turn * radius < SAME_VOXELS * self.voxel_size
    }

    /// Registers the pairs that have not been yet; whether there were any.
    fn register(&mut self, wanted: Vec<Wanted>) -> Result<bool> {
        let mut missing: BTreeMap<(usize, usize), Wanted> = BTreeMap::new();
        let mut any = false;
        for pair in wanted {
            let scans = (pair.source, pair.target);
            let answered = |attempts: Option<&Vec<Attempt>>| {
                attempts.and_then(|all| all.iter().find(|a| self.answers(a, &pair)).cloned())
            };
            if answered(self.attempts.get(&scans)).is_some() || missing.contains_key(&scans) {
                continue;
            }
            any = true;
            match answered(self.known.get(&scans)) {
                Some(attempt) => self.attempts.entry(scans).or_default().push(attempt),
                None => drop(missing.insert(scans, pair)),
            }
        }
        let missing: Vec<Wanted> = missing.into_values().collect();
        let (all, mut done) = (missing.len(), 0);
        let mut rest = &missing[..];
        while !rest.is_empty() {
            let (some, after) = rest.split_at(self.fitting(rest));
            rest = after;
            self.hold(some)?;
            // In parts, so that what is known is told while the rest is under way.
            for part in some.chunks(4 * rayon::current_num_threads().max(1)) {
                (self.watch.progress)(MergeProgress { step: MergeStep::Register, done, of: all });
                done += part.len();
                let found: Vec<Option<Attempt>> =
                    part.par_iter().map(|pair| self.attempt(pair)).collect::<Result<_>>()?;
                for attempt in found.into_iter().flatten() {
                    (self.watch.pair)(&attempt)?;
                    self.attempts.entry((attempt.source, attempt.target)).or_default().push(attempt);
                }
            }
        }
        Ok(any)
    }

    /// How many of the pairs, from the first, can be registered with the scans that may be held at once.
    fn fitting(&self, pairs: &[Wanted]) -> usize {
        let mut needed = BTreeSet::new();
        let mut bytes = 0;
        let fits = |pair: &&Wanted| {
            for scan in [pair.source, pair.target] {
                if needed.insert(scan) {
                    bytes += self.surveyed[scan].bytes;
                }
            }
            bytes <= self.memory
        };
        pairs.iter().take_while(fits).count().max(1)
    }

    /// Makes ready what the pairs need, and lets go of what they do not where there is no room.
    fn hold(&mut self, pairs: &[Wanted]) -> Result<()> {
        let needed: BTreeSet<usize> = pairs.iter().flat_map(|pair| [pair.source, pair.target]).collect();
        let missing: Vec<usize> =
            needed.iter().copied().filter(|scan| !self.ready.contains_key(scan)).collect();
        let spare: Vec<usize> = self.ready.keys().copied().filter(|scan| !needed.contains(scan)).collect();
        let mut bytes: usize = self.ready.keys().chain(&missing).map(|&scan| self.surveyed[scan].bytes).sum();
        for scan in spare {
            if bytes <= self.memory {
                break;
            }
            bytes -= self.surveyed[scan].bytes;
            self.ready.remove(&scan);
        }
        let found: Vec<(usize, ReadyScan)> =
            missing.par_iter().map(|&scan| Ok((scan, self.make_ready(scan)?))).collect::<Result<_>>()?;
        self.ready.extend(found);
        Ok(())
    }

    fn attempt(&self, &Wanted { source, target, proposal, prior }: &Wanted) -> Result<Option<Attempt>> {
        let (Some(a), Some(b)) = (self.ready.get(&source), self.ready.get(&target)) else { return Ok(None) };
        let registration = &self.settings.registration;
        let settings = Settings {
            voxel_size: Some(self.voxel_size),
            method: if prior.is_some() { Method::Prior } else { registration.method },
            init: prior,
            threads: None,
            ..registration.clone()
        };
        let found = register_ready(a, b, &settings)?;
        Ok(Some(Attempt {
            source,
            target,
            proposal,
            prior: prior.map(|pose| pose.to_rows()),
            T_target_source: found.T_target_source.to_rows(),
            probability: found.probability,
            covariance: found.covariance,
            fitness: found.fitness,
            reasons: found.reasons,
        }))
    }

    /// The best attempt of each pair of scans.
    fn best(&self) -> BTreeMap<(usize, usize), &Attempt> {
        self.attempts
            .iter()
            .filter_map(|(&scans, all)| {
                let surer = |a: &&Attempt, b: &&Attempt| a.probability.total_cmp(&b.probability);
                // Of equals the first.
                all.iter().rev().max_by(surer).map(|attempt| (scans, attempt))
            })
            .collect()
    }

    fn solve(&mut self) -> Result<Solved> {
        let (graph, pairs) = self.graph();
        let watch = self.watch;
        let solution = graph.solve_asking(|joining| self.corroborated(&graph, joining), watch.alignment)?;
        Ok(Solved { graph, pairs, solution })
    }

    /// Whether the pairs that an edge would lay on each other speak for it, all in all.
    fn corroborated(&mut self, graph: &PoseGraph, joining: Joining) -> Result<bool> {
        let edge = &graph.edges[joining.edge];
        let witnesses = self.witnesses(edge, &joining);
        self.register(witnesses.clone())?;
        let said = |pair: &Wanted| {
            let attempts = self.attempts.get(&(pair.source, pair.target))?;
            let attempt = attempts.iter().find(|a| self.answers(a, pair))?;
            let stays = self.same(&exactly(&attempt.T_target_source), &pair.prior?, pair.source);
            Some(odds(if stays { attempt.probability } else { 0.0 }))
        };
        Ok(odds(edge.probability) + witnesses.iter().filter_map(said).sum::<f64>() > 0.0)
    }

    /// The pairs that an edge would lay on each other most, but for its own.
    fn witnesses(&self, edge: &Edge, joining: &Joining) -> Vec<Wanted> {
        let placed = |scan: usize| Vector3::from(joining.poses[scan].apply(self.surveyed[scan].center));
        let moved = |a: usize| joining.T_target_source * joining.poses[a];
        let [sources, targets] = joining.parts;
        let mut found: Vec<(f64, usize, usize, Rigid)> = Vec::new();
        for &a in sources {
            let center = Vector3::from(moved(a).apply(self.surveyed[a].center));
            for &b in targets {
                let reach = self.surveyed[a].radius.min(self.surveyed[b].radius);
                if (a, b) == (edge.source, edge.target) || (center - placed(b)).norm() > reach {
                    continue;
                }
                let T_b_a = joining.poses[b].inverse() * moved(a);
                let share = self.share(a, b, &T_b_a);
                if share >= WITNESSING {
                    found.push((share, a, b, T_b_a));
                }
            }
        }
        found.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        // Each scan but once: scans of one room say the same.
        let mut asked = BTreeSet::new();
        found.retain(|&(_, a, b, _)| {
            !asked.contains(&a) && !asked.contains(&b) && asked.insert(a) && asked.insert(b)
        });
        found.into_iter().take(WITNESSES).map(|(_, a, b, T_b_a)| Wanted::laid(a, b, T_b_a)).collect()
    }

    /// Share of one of two scans that lies in small cells of the other: of that of which it is more.
    fn share(&self, a: usize, b: usize, T_b_a: &Rigid) -> f64 {
        let inside = |from: usize, to: usize, T: &Rigid| {
            let (from, to) = (&self.surveyed[from], &self.surveyed[to]);
            let offset = T.apply(from.center);
            let center = Vector3::from(offset) - Vector3::from(to.center);
            let hits = from.sample.iter().filter(|p| {
                let p = T.rotation * Vector3::from(p.map(f64::from)) + center;
                to.cells.contains(&self.small_cell(&p))
            });
            hits.count() as f64 / from.sample.len().max(1) as f64
        };
        inside(a, b, T_b_a).max(inside(b, a, &T_b_a.inverse()))
    }

    /// The graph of the pairs that are trusted, and these pairs.
    fn graph(&self) -> (PoseGraph, Vec<(usize, usize)>) {
        let centers = self.surveyed.iter().map(|s| s.center).collect();
        let trusted: Vec<((usize, usize), &Attempt)> =
            self.best().into_iter().filter(|(_, a)| a.probability >= TRUSTWORTHY).collect();
        let edges = trusted
            .iter()
            .map(|(_, attempt)| Edge {
                source: attempt.source,
                target: attempt.target,
                T_target_source: exactly(&attempt.T_target_source),
                covariance: self.covariance(attempt),
                probability: attempt.probability,
            })
            .collect();
        (PoseGraph { centers, edges }, trusted.into_iter().map(|(pair, _)| pair).collect())
    }

    fn covariance(&self, attempt: &Attempt) -> Matrix6<f64> {
        let length = SYSTEMATIC_VOXELS * self.voxel_size;
        let angle = length / self.surveyed[attempt.source].radius.max(length);
        let mut covariance = Matrix6::from_fn(|r, c| attempt.covariance[r][c]);
        for k in 0..3 {
            covariance[(k, k)] += angle * angle;
            covariance[(k + 3, k + 3)] += length * length;
        }
        covariance
    }

    /// Pairs that the poses lay on each other, and that are not surely known: for each scan those that overlap it most.
    fn overlapping(&self, solution: &Solution) -> Vec<Wanted> {
        let mut scans_of: BTreeMap<(usize, [i32; 3]), Vec<usize>> = BTreeMap::new();
        let mut cells_of = vec![0_usize; self.surveyed.len()];
        for (scan, surveyed) in self.surveyed.iter().enumerate() {
            let center = Vector3::from(surveyed.center);
            let cells: BTreeSet<[i32; 3]> = surveyed
                .sample
                .iter()
                .map(|p| {
                    let p = Vector3::from(p.map(f64::from)) + center;
                    cell_of(&solution.poses[scan].apply(p.into()).into(), CELL_VOXELS * self.voxel_size)
                })
                .collect();
            cells_of[scan] = cells.len();
            for cell in cells {
                scans_of.entry((solution.models[scan], cell)).or_default().push(scan);
            }
        }
        let mut shared: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        for scans in scans_of.values() {
            let step = scans.len().div_ceil(MOST_IN_A_CELL);
            let some: Vec<usize> = scans.iter().step_by(step).copied().collect();
            for (n, &b) in some.iter().enumerate() {
                for &a in &some[n + 1..] {
                    *shared.entry((a, b)).or_default() += 1;
                }
            }
        }
        let best = self.best();
        let mut of: Vec<Vec<(f64, (usize, usize))>> = vec![Vec::new(); self.surveyed.len()];
        for (&(a, b), &cells) in &shared {
            let share = cells as f64 / cells_of[a].min(cells_of[b]).max(1) as f64;
            let sure = best.get(&(a, b)).is_some_and(|attempt| attempt.probability >= SURE);
            if share >= OVERLAPPING && !sure {
                of[a].push((share, (a, b)));
                of[b].push((share, (a, b)));
            }
        }
        let mut wanted = BTreeSet::new();
        for mut pairs in of {
            pairs.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
            wanted.extend(pairs.into_iter().take(self.settings.neighbors).map(|(_, pair)| pair));
        }
        let laid =
            |(a, b): (usize, usize)| Wanted::laid(a, b, solution.poses[b].inverse() * solution.poses[a]);
        wanted.into_iter().map(laid).collect()
    }

    fn merged(&self, Solved { graph, pairs: trusted, solution }: Solved) -> Merged {
        let judged: BTreeMap<(usize, usize), _> = trusted.iter().copied().zip(&solution.edges).collect();
        let pairs: Vec<JudgedAttempt> = self
            .best()
            .into_iter()
            .map(|(pair, attempt)| {
                let judged = judged.get(&pair);
                JudgedAttempt {
                    attempt: attempt.clone(),
                    kept: judged.is_some_and(|j| j.kept),
                    contradicted: judged.is_some_and(|j| j.contradicted),
                    chi_sq: judged.and_then(|j| j.chi_sq),
                }
            })
            .collect();
        let mut wrong = vec![1.0; self.surveyed.len()];
        let mut held = vec![0; self.surveyed.len()];
        for pair in pairs.iter().filter(|pair| pair.kept) {
            for scan in [pair.attempt.source, pair.attempt.target] {
                wrong[scan] *= 1.0 - pair.attempt.probability;
                held[scan] += 1;
            }
        }
        let sizes = sizes(&solution.models);
        let mut by_size: Vec<usize> = (0..sizes.len()).collect();
        by_size.sort_by_key(|&m| (std::cmp::Reverse(sizes[m]), m));
        let places = self
            .surveyed
            .iter()
            .enumerate()
            .map(|(scan, surveyed)| {
                let model = solution.models[scan];
                match &surveyed.fault {
                    Some(fault) => Place::Unusable { reason: fault.clone() },
                    None if sizes[model] < 2 => Place::Alone,
                    None => Place::Placed {
                        model: by_size.iter().position(|&m| m == model).unwrap_or(0),
                        T_model_scan: solution.poses[scan],
                        pairs: held[scan],
                        probability: 1.0 - wrong[scan],
                    },
                }
            })
            .collect();
        Merged { places, pairs, graph, voxel_size: self.voxel_size, inflation: solution.inflation }
    }
}

impl Surveyed {
    fn unusable(fault: String) -> Self {
        Self {
            fault: Some(fault),
            center: [0.0; 3],
            radius: 0.0,
            bytes: 0,
            sample: Vec::new(),
            cells: HashSet::new(),
            looks: Descriptors { dim: 0, values: Vec::new() },
        }
    }
}

/// The cube of edge `cell` about the origin's grid in which a place is.
fn cell_of(place: &Vector3<f64>, cell: f64) -> [i32; 3] {
    std::array::from_fn(|k| (place[k] / cell).floor() as i32)
}

/// The middle one of the scales of some scans; zero where none has one.
fn common_voxel_size(scans: &(impl Scans + ?Sized)) -> f64 {
    let step = scans.len().div_ceil(SCALED).max(1);
    let some: Vec<usize> = (0..scans.len()).step_by(step).collect();
    let mut sizes: Vec<f64> = some
        .par_iter()
        .filter_map(|&scan| ReadyScan::natural_voxel_size(&scans.read(scan).ok()?).ok())
        .collect();
    sizes.sort_by(f64::total_cmp);
    sizes.get(sizes.len() / 2).copied().unwrap_or(0.0)
}

/// Scans in each model.
fn sizes(models: &[usize]) -> Vec<usize> {
    let mut sizes = vec![0; models.iter().max().map_or(0, |m| m + 1)];
    for &model in models {
        sizes[model] += 1;
    }
    sizes
}

/// The motion that these rows are, to the last bit.
fn exactly(rows: &[[f64; 4]; 4]) -> Rigid {
    Rigid { rotation: Matrix3::from_fn(|r, c| rows[r][c]), translation: Vector3::from_fn(|r, _| rows[r][3]) }
}
