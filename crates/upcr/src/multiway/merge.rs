//! From scans that lie anywhere to their poses in common models.
//!
//! Scans that look alike are registered with each other, the poses of pairs become a graph, and the graph's poses say which
//! other pairs overlap and are registered too. What is known of a pair is told as soon as it is known, and need not be found
//! again.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix3, Matrix6, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::pose_graph::{Edge, PoseGraph, Solution};
use super::vocabulary::{Vocabulary, alike};
use crate::{
    PointCloud, ReadyScan, Result, Settings, features::Descriptors, register_ready,
    registration::TRUSTWORTHY, settings::Method, threads::on_threads, transform::Rigid,
};

/// Scans that tell the common scale.
const SCALED: usize = 24;
/// Features of a scan that tell what it looks like.
const LOOKED_AT: usize = 400;
/// Rounds in which models that nothing joins yet are looked at again.
const JOINING_ROUNDS: usize = 3;
/// Rounds in which scans that the poses bring together are registered.
const CLOSING_ROUNDS: usize = 2;
/// Points of a scan that tell whether it overlaps another, edge of the cells in which they do, in voxels, and share of the
/// smaller scan's cells.
const SAMPLE: usize = 512;
const CELL_VOXELS: f64 = 8.0;
const OVERLAPPING: f64 = 0.25;
/// Probability from which on a pair is not looked at again from where the poses lay it.
const SURE: f64 = 0.9;
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
    /// The poses found so far lay one on the other.
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
    /// Squared error under its covariance, where it was trusted as a pair.
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

struct Merge<'a, S: ?Sized> {
    scans: &'a S,
    settings: &'a MergeSettings,
    watch: &'a MergeWatch<'a>,
    voxel_size: f64,
    surveyed: Vec<Surveyed>,
    /// Scans that are ready.
    ready: BTreeMap<usize, ReadyScan>,
    /// How many of them there may be at once.
    capacity: usize,
    known: BTreeMap<(usize, usize, Proposal), Attempt>,
    attempts: BTreeMap<(usize, usize, Proposal), Attempt>,
}

/// What is kept of each scan.
struct Surveyed {
    /// Why it cannot be used.
    fault: Option<String>,
    center: [f64; 3],
    radius: f64,
    /// Some points, about the centre.
    sample: Vec<[f32; 3]>,
    /// Some features.
    features: Descriptors,
}

impl<'a, S: Scans + ?Sized> Merge<'a, S> {
    fn new(scans: &'a S, settings: &'a MergeSettings, known: &[Attempt], watch: &'a MergeWatch<'a>) -> Self {
        let voxel_size = match settings.registration.voxel_size {
            Some(voxel_size) => voxel_size,
            None => common_voxel_size(scans),
        };
        let mut merge = Self {
            scans,
            settings,
            watch,
            voxel_size,
            surveyed: Vec::new(),
            ready: BTreeMap::new(),
            capacity: scans.len().max(2),
            known: known.iter().map(|a| ((a.source, a.target, a.proposal), a.clone())).collect(),
            attempts: BTreeMap::new(),
        };
        merge.survey();
        merge
    }

    /// Reads every scan once.
    fn survey(&mut self) {
        let memory = self.settings.max_memory_bytes.unwrap_or(DEFAULT_MEMORY);
        let together = rayon::current_num_threads().max(1);
        let all: Vec<usize> = (0..self.scans.len()).collect();
        let mut held = 0_u64;
        for (n, some) in all.chunks(together).enumerate() {
            (self.watch.progress)(MergeProgress {
                step: MergeStep::Describe,
                done: n * together,
                of: all.len(),
            });
            let found: Vec<Result<ReadyScan>> = some.par_iter().map(|&scan| self.make_ready(scan)).collect();
            for (&scan, found) in some.iter().zip(found) {
                self.surveyed.push(match &found {
                    Ok(ready) => Surveyed::of(ready),
                    Err(error) => Surveyed::unusable(error.to_string()),
                });
                if let Ok(ready) = found {
                    let bytes = ready.bytes() as u64;
                    if held + bytes <= memory {
                        self.ready.insert(scan, ready);
                    } else if self.capacity == self.scans.len().max(2) {
                        self.capacity = self.ready.len().max(2);
                    }
                    held += bytes;
                }
            }
        }
    }

    fn make_ready(&self, scan: usize) -> Result<ReadyScan> {
        ReadyScan::new(&self.scans.read(scan)?, self.voxel_size, self.settings.registration.feature)
    }

    fn run(mut self) -> Result<Merged> {
        let usable = |s: &Surveyed| s.fault.is_none();
        let features: Vec<Descriptors> = self.surveyed.iter().map(|s| s.features.clone()).collect();
        let vocabulary = Vocabulary::learn(&features, self.settings.registration.seed);
        let vectors: Vec<Vec<f32>> = features.par_iter().map(|f| vocabulary.describe(f)).collect();
        let neighbors = self.settings.neighbors.max(1);
        let order: Vec<Vec<usize>> = alike(&vectors, neighbors * (1 + JOINING_ROUNDS))
            .into_iter()
            .map(|others| others.into_iter().map(|(j, _)| j).filter(|&j| usable(&self.surveyed[j])).collect())
            .collect();

        let mut wanted = BTreeSet::new();
        if self.settings.sequential {
            let taken: Vec<usize> = (0..self.scans.len()).filter(|&i| usable(&self.surveyed[i])).collect();
            for step in 1..=2 {
                wanted.extend(taken.windows(step + 1).map(|w| (w[step], w[0], Proposal::Sequence)));
            }
        }
        for (i, others) in order.iter().enumerate().filter(|(i, _)| usable(&self.surveyed[*i])) {
            wanted.extend(others.iter().take(neighbors).map(|&j| (i.max(j), i.min(j), Proposal::Likeness)));
        }
        self.register(wanted, None)?;
        let mut solution = self.solve();

        for round in 1..=JOINING_ROUNDS {
            let sizes = sizes(&solution.models);
            let largest = (0..sizes.len()).max_by_key(|&m| (sizes[m], usize::MAX - m));
            let mut wanted = BTreeSet::new();
            for (i, others) in order.iter().enumerate() {
                if usable(&self.surveyed[i]) && Some(solution.models[i]) != largest {
                    let apart = |&&j: &&usize| solution.models[j] != solution.models[i];
                    let more = others.iter().take(neighbors * (1 + round)).filter(apart);
                    wanted.extend(more.map(|&j| (i.max(j), i.min(j), Proposal::Likeness)));
                }
            }
            if !self.register(wanted, None)? {
                break;
            }
            solution = self.solve();
        }
        for _ in 0..CLOSING_ROUNDS {
            let wanted = self.overlapping(&solution);
            if !self.register(wanted, Some(&solution))? {
                break;
            }
            solution = self.solve();
        }
        Ok(self.merged(&solution))
    }

    /// Registers the pairs that have not been yet; whether there were any.
    fn register(
        &mut self,
        wanted: BTreeSet<(usize, usize, Proposal)>,
        prior: Option<&Solution>,
    ) -> Result<bool> {
        let tried = |merge: &Self, &(a, b, proposal): &(usize, usize, Proposal)| {
            // What was looked for once is not looked for again for another reason.
            let searched = [Proposal::Sequence, Proposal::Likeness]
                .iter()
                .any(|&p| merge.attempts.contains_key(&(a, b, p)));
            merge.attempts.contains_key(&(a, b, proposal)) || (proposal != Proposal::Overlap && searched)
        };
        let mut missing: Vec<(usize, usize, Proposal)> = Vec::new();
        let mut any = false;
        for pair in wanted {
            if tried(self, &pair) {
                continue;
            }
            any = true;
            match self.known.get(&pair) {
                Some(attempt) => {
                    self.attempts.insert(pair, attempt.clone());
                }
                None if !missing.iter().any(|m| (m.0, m.1) == (pair.0, pair.1)) => missing.push(pair),
                None => {}
            }
        }
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
                    part.par_iter().map(|pair| self.attempt(pair, prior)).collect::<Result<_>>()?;
                for (pair, attempt) in part.iter().zip(found) {
                    if let Some(attempt) = attempt {
                        (self.watch.pair)(&attempt)?;
                        self.attempts.insert(*pair, attempt);
                    }
                }
            }
        }
        Ok(any)
    }

    /// How many of the pairs, from the first, can be registered with the scans that may be held at once.
    fn fitting(&self, pairs: &[(usize, usize, Proposal)]) -> usize {
        let mut needed = BTreeSet::new();
        pairs
            .iter()
            .take_while(|(a, b, _)| {
                needed.insert(*a);
                needed.insert(*b);
                needed.len() <= self.capacity
            })
            .count()
            .max(1)
    }

    /// Makes ready what the pairs need, and lets go of what they do not where there is no room.
    fn hold(&mut self, pairs: &[(usize, usize, Proposal)]) -> Result<()> {
        let needed: BTreeSet<usize> = pairs.iter().flat_map(|(a, b, _)| [*a, *b]).collect();
        let missing: Vec<usize> =
            needed.iter().copied().filter(|scan| !self.ready.contains_key(scan)).collect();
        let spare: Vec<usize> = self.ready.keys().copied().filter(|scan| !needed.contains(scan)).collect();
        let over = (self.ready.len() + missing.len()).saturating_sub(self.capacity);
        for scan in spare.into_iter().take(over) {
            self.ready.remove(&scan);
        }
        let found: Vec<(usize, ReadyScan)> =
            missing.par_iter().map(|&scan| Ok((scan, self.make_ready(scan)?))).collect::<Result<_>>()?;
        self.ready.extend(found);
        Ok(())
    }

    fn attempt(
        &self,
        &(source, target, proposal): &(usize, usize, Proposal),
        prior: Option<&Solution>,
    ) -> Result<Option<Attempt>> {
        let (Some(a), Some(b)) = (self.ready.get(&source), self.ready.get(&target)) else { return Ok(None) };
        let mut settings = Settings {
            voxel_size: Some(self.voxel_size),
            init: None,
            threads: None,
            ..self.settings.registration.clone()
        };
        if let Some(solution) = prior {
            settings.method = Method::Prior;
            settings.init = Some(solution.poses[target].inverse() * solution.poses[source]);
        }
        let found = register_ready(a, b, &settings)?;
        Ok(Some(Attempt {
            source,
            target,
            proposal,
            T_target_source: found.T_target_source.to_rows(),
            probability: found.probability,
            covariance: found.covariance,
            fitness: found.fitness,
            reasons: found.reasons,
        }))
    }

    /// The best attempt of each pair of scans.
    fn best(&self) -> BTreeMap<(usize, usize), &Attempt> {
        let mut best: BTreeMap<(usize, usize), &Attempt> = BTreeMap::new();
        for attempt in self.attempts.values() {
            let held = best.entry((attempt.source, attempt.target)).or_insert(attempt);
            if attempt.probability > held.probability {
                *held = attempt;
            }
        }
        best
    }

    fn solve(&self) -> Solution {
        self.graph().0.solve_heard(self.watch.alignment)
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
    fn overlapping(&self, solution: &Solution) -> BTreeSet<(usize, usize, Proposal)> {
        let edge = CELL_VOXELS * self.voxel_size;
        let mut scans_of: BTreeMap<(usize, [i64; 3]), Vec<usize>> = BTreeMap::new();
        let mut cells_of = vec![0_usize; self.surveyed.len()];
        for (scan, surveyed) in self.surveyed.iter().enumerate() {
            let center = Vector3::from(surveyed.center);
            let cells: BTreeSet<[i64; 3]> = surveyed
                .sample
                .iter()
                .map(|p| {
                    let p = Vector3::from(p.map(f64::from)) + center;
                    solution.poses[scan].apply(p.into()).map(|v| (v / edge).floor() as i64)
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
            wanted.extend(
                pairs.into_iter().take(self.settings.neighbors).map(|(_, (a, b))| (a, b, Proposal::Overlap)),
            );
        }
        wanted
    }

    fn merged(&self, solution: &Solution) -> Merged {
        let (graph, trusted) = self.graph();
        let judged: BTreeMap<(usize, usize), _> = trusted.iter().copied().zip(&solution.edges).collect();
        let pairs: Vec<JudgedAttempt> = self
            .best()
            .into_iter()
            .map(|(pair, attempt)| JudgedAttempt {
                attempt: attempt.clone(),
                kept: judged.get(&pair).is_some_and(|j| j.kept),
                chi_sq: judged.get(&pair).map(|j| j.chi_sq),
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
    fn of(ready: &ReadyScan) -> Self {
        let (_, all) = ready.features();
        let step = all.len().div_ceil(LOOKED_AT).max(1);
        let values = (0..all.len()).step_by(step).flat_map(|i| all.row(i)).copied().collect();
        Self {
            fault: None,
            center: ready.center(),
            radius: ready.radius(),
            sample: ready.sample(SAMPLE),
            features: Descriptors { dim: all.dim, values },
        }
    }

    fn unusable(fault: String) -> Self {
        let features = Descriptors { dim: 0, values: Vec::new() };
        Self { fault: Some(fault), center: [0.0; 3], radius: 0.0, sample: Vec::new(), features }
    }
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
