//! From hypotheses to candidates for the answer: ranked, refined coarsely and finely, told apart.

use rayon::prelude::*;

use super::Pipeline;
use crate::{
    hypothesis::{Hypothesis, separation, turned},
    prepare::{Level, Prepared},
    refine::{Hear, Icp, Refined, Refinement, Schedule},
    settings::Method,
    transform::Rigid,
    verify::{Seen, in_free_space, overlap_at},
    watch::{PoseStep, StepPairs},
};

/// Hypotheses that are refined on the coarse level, and of those on the fine one.
const COARSE_CANDIDATES: usize = 8;
const FINE_CANDIDATES: usize = 3;
/// Different poses that score at least this share of the best are as good an answer; so many of them are told.
pub(super) const RIVALLING: f64 = 0.92;
pub(super) const RIVALS: usize = 8;
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
pub(super) const COMPARING_POINTS: usize = 500;
const SCORING_POINTS: usize = 1500;
/// Pairs of the final refinement are at most so many voxels apart.
pub(super) const REACH_VOXELS: f32 = 2.0;
/// Points that refine a pose until it settles, and in a few last iterations.
const FEW_POINTS: usize = 1500;
pub(super) const FINE_POINTS: usize = 6000;
/// Scales over which refined poses are compared, each half the one before.
const SCORING_SCALES: u32 = 4;
/// A pose loses a factor of e of its score for each such share of the points that it sets in free space.
const TOLERATED_IN_FREE_SPACE: f64 = 0.1;
/// Points of each cloud that are looked at for it.
const CLEARING_POINTS: usize = 500;
/// Poses closer than this many voxels at the source's rim are one answer.
const DISTINCT_VOXELS: f64 = 6.0;

/// A coarsely refined pose with its score.
#[derive(Clone, Copy)]
pub(super) struct Glimpse {
    pub score: f64,
    pub pose: Rigid,
    /// Whether a source proposed it, and not only a turn.
    pub proposed: bool,
}

/// A hypothesis with its score.
struct Ranked {
    score: f64,
    hypothesis: Hypothesis,
    /// The poses that it went through, from the one proposed on; empty where nobody hears them.
    way: Vec<(Rigid, Option<StepPairs>)>,
}

/// A refined pose with its score.
pub(super) struct Candidate {
    pub method: Method,
    pub refined: Refined,
    pub score: f64,
    pub closeness: f64,
    /// Whether it was refined to the end, and so was all that its source proposed beside it.
    pub complete: bool,
}

impl Pipeline<'_> {
    /// Ranks hypotheses by overlap, refines the best coarsely, ranks again, beside turns of the best, and refines
    /// the best of those finely. Beside these, all that was refined coarsely.
    pub(super) fn refined(&self, hypotheses: &[Hypothesis]) -> (Vec<Candidate>, Vec<Glimpse>) {
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
        let listened = self.call.tells_poses();
        let coarsely_refined = |ranked: Vec<(f64, Hypothesis)>| -> Vec<Ranked> {
            let mut ranked: Vec<Ranked> = ranked
                .into_iter()
                .map(|(score, hypothesis)| {
                    let way = if listened { vec![(hypothesis.pose, None)] } else { Vec::new() };
                    Ranked { score, hypothesis, way }
                })
                .collect();
            if self.settings.refine == Refinement::None || ranked.is_empty() || self.call.is_over() {
                return ranked;
            }
            let icp = self.icp(source, target);
            ranked.par_iter_mut().for_each(|Ranked { score, hypothesis, way }| {
                let mut hear = |pose: &Rigid, pairs| way.push((*pose, Some(pairs)));
                let hear: Option<Hear> = if listened { Some(&mut hear) } else { None };
                let pose = icp.refine(&moved, &hypothesis.pose, &Schedule::coarse(limit), hear).pose;
                *score = rank(&pose, COMPARING_POINTS) * self.clearance(&pose);
                hypothesis.pose = pose;
            });
            ranked
        };
        // The best come first.
        let few = hypotheses.len().min(COARSE_CANDIDATES);
        let hypotheses =
            if hypotheses.len() > few && self.call.is_over() { &hypotheses[..few] } else { hypotheses };
        let mut ranked = coarsely_refined(promising(hypotheses, RANKING_POINTS, PROMISING, 0.0));
        ranked.sort_by(|a, b| b.score.total_cmp(&a.score));
        let glimpsed = |ranked: &[Ranked], proposed| -> Vec<Glimpse> {
            ranked.iter().map(|r| Glimpse { score: r.score, pose: r.hypothesis.pose, proposed }).collect()
        };
        let mut glimpses = glimpsed(&ranked, true);
        if let Some(Ranked { score, hypothesis: best, .. }) = ranked.first()
            && *score < COINCIDENT
            && !self.call.is_over()
        {
            let turns: Vec<Hypothesis> =
                turned(source, &best.pose).into_iter().map(|pose| Hypothesis { pose, ..*best }).collect();
            let others = promising(&turns, GLANCING_POINTS, TELLING, *score);
            let others = coarsely_refined(others);
            glimpses.extend(glimpsed(&others, false));
            ranked.extend(others);
            ranked.sort_by(|a, b| b.score.total_cmp(&a.score));
        }
        let mut distinct: Vec<Ranked> = Vec::new();
        for r in ranked {
            if distinct.iter().all(|d| !self.coarsely_same(&d.hypothesis.pose, &r.hypothesis.pose)) {
                distinct.push(r);
            }
        }
        let best = distinct.first().map_or(0.0, |best| best.score);
        let worth_it = |rank: usize, score: f64| {
            let enough = if rank < FINE_CANDIDATES { PROMISING } else { RIVALLING };
            rank < RIVALS && score >= enough * best
        };
        let count = distinct.iter().enumerate().take_while(|(rank, r)| worth_it(*rank, r.score)).count();
        let going_on = |&(rank, _): &(usize, _)| rank == 0 || !self.call.is_over();
        let fine = distinct[..count].iter().enumerate().take_while(going_on);
        let candidates = fine.map(|(rank, ranked)| {
            self.call.advance(rank as f64 / count as f64);
            self.finely_refined(ranked, self.candidates.len() + rank)
        });
        (candidates.collect(), glimpses)
    }

    /// Distance within which points of the coarse level count as near.
    pub(super) fn coarse_reach(&self) -> f32 {
        REACH_VOXELS * self.source.coarse().voxel_size.max(self.target.coarse().voxel_size)
    }

    /// Whether two poses, coarsely refined, are one answer.
    pub(super) fn coarsely_same(&self, a: &Rigid, b: &Rigid) -> bool {
        separation(a, b, f64::from(self.source.fine.radius)) <= f64::from(self.coarse_reach())
    }

    fn finely_refined(&self, ranked: &Ranked, number: usize) -> Candidate {
        let Ranked { hypothesis, way, .. } = ranked;
        let tell = |iteration, fine, pose: &Rigid, pairs| {
            self.call.tell_pose(PoseStep {
                method: hypothesis.method,
                hypothesis: number,
                iteration,
                fine,
                T_target_source: self.file_pose(pose),
                pairs,
            });
        };
        for (iteration, (pose, pairs)) in way.iter().enumerate() {
            tell(iteration, false, pose, *pairs);
        }
        let mut iteration = way.len();
        let mut hear = |pose: &Rigid, pairs| {
            tell(iteration, true, pose, Some(pairs));
            iteration += 1;
        };
        let mut refine = |icp: &Icp, moved: &[u32], pose: &Rigid, schedule: &Schedule| {
            let hear: Option<Hear> = if self.call.tells_poses() { Some(&mut hear) } else { None };
            icp.refine(moved, pose, schedule, hear)
        };
        let (source, target) = (&self.source.fine, &self.target.fine);
        let reach = REACH_VOXELS * self.voxel_size as f32;
        let icp = self.icp(source, target);
        let moved = self.source.refined_points();
        let few = Level::thin(&moved, FEW_POINTS);
        let keep = self.settings.overlap.unwrap_or(1.0);
        let refined = if self.settings.refine == Refinement::None {
            let none = Schedule { max_iterations: 0, ..Schedule::settled(reach, keep) };
            refine(&icp, &few, &hypothesis.pose, &none)
        } else {
            // A guess may be further off than what the coarse level brings near.
            let first = if hypothesis.method == Method::Prior { 3.0 * reach } else { 1.5 * reach };
            let found = refine(&icp, &few, &hypothesis.pose, &Schedule::fine(first, reach, keep));
            if few.len() == moved.len() || self.call.is_over() {
                found
            } else {
                let all = Level::thin(&moved, FINE_POINTS);
                let settled = refine(&icp, &all, &found.pose, &Schedule::settled(reach, keep));
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
        let score = score * closeness * self.clearance(&refined.pose);
        Candidate { method: hypothesis.method, refined, score, closeness, complete: true }
    }

    /// What is left of a pose's score for the points that it sets where a sensor saw past them, 1 where there are none.
    pub(super) fn clearance(&self, pose: &Rigid) -> f64 {
        let seen = |cloud: &Prepared| cloud.fine.spread(CLEARING_POINTS);
        let share = self.in_free_space(pose, [&seen(self.source), &seen(self.target)]);
        share.map_or(1.0, |share| (-share / TOLERATED_IN_FREE_SPACE).exp())
    }

    /// Share of the points of source and target that `pose` sets in free space, where that is known.
    pub(super) fn in_free_space(&self, pose: &Rigid, points: [&[u32]; 2]) -> Option<f64> {
        let [source, target] = points;
        let [seen_source, seen_target] = &self.views;
        let source = Seen { level: &self.source.fine, points: source, view: seen_source.as_ref() };
        let target = Seen { level: &self.target.fine, points: target, view: seen_target.as_ref() };
        in_free_space(source, target, pose)
    }

    /// Whether two poses, finely refined, are one answer.
    fn same(&self, a: &Candidate, b: &Candidate) -> bool {
        let radius = f64::from(self.source.fine.radius);
        separation(&a.refined.pose, &b.refined.pose, radius) <= DISTINCT_VOXELS * self.voxel_size
    }

    /// Whether another source of hypotheses came to the best pose too.
    pub(super) fn sources_agree(&self) -> bool {
        let Some(best) = self.candidates.first() else { return false };
        self.candidates.iter().any(|c| c.method != best.method && self.same(c, best))
    }

    /// Candidates that are clearly different from `best` and from each other, best first.
    pub(super) fn others(&self, best: &Candidate) -> Vec<&Candidate> {
        let mut others: Vec<&Candidate> = Vec::new();
        for candidate in &self.candidates {
            if !self.same(candidate, best) && others.iter().all(|other| !self.same(candidate, other)) {
                others.push(candidate);
            }
        }
        others
    }
}
