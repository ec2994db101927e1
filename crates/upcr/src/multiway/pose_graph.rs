//! Poses of many scans from poses of pairs: robust least squares over rigid motions.
//!
//! Each scan i has a pose X_i, `T_model_i`; each edge a measured pose Z of its source in the frame of its target. The error
//! of an edge is the left twist that takes Z to X_j⁻¹ X_i, about a centre c of the target: ω, and where it takes c. Wrong
//! edges are found by graduated non-convexity (Yang et al., "Graduated Non-Convexity for Robust Spatial Perception", 2020):
//! truncated least squares, reached from a wider cost.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};

use super::block_cholesky::Pattern;
use crate::transform::Rigid;

/// χ² of six degrees of freedom that one right edge in a hundred exceeds; of three quarters that are above it.
const CHI_SQ_MOST: f64 = 16.81;
const CHI_SQ_QUARTILE: f64 = 3.455;
/// Chances beyond these say no more.
const SUREST: f64 = 0.99;
/// The cost's scale begins at so many times the middle error along the tree, and falls by this factor.
const WIDELY: f64 = 4.0;
const ANNEALING: f64 = 1.6;
/// Steps under one scale, and to the end.
const STEPS: usize = 2;
const MOST_STEPS: usize = 50;
/// Rounds in which edges may still be dropped or taken back.
const MOST_ROUNDS: usize = 10;
const SETTLED: f64 = 1e-10;

/// What is known of how one scan lies to another.
#[derive(Debug, Clone, PartialEq)]
pub struct Edge {
    /// The scan that is moved.
    pub source: usize,
    /// The scan that stays.
    pub target: usize,
    /// Takes the source's coordinates to the target's.
    pub T_target_source: Rigid,
    /// Covariance of the left twist (ω, v) that takes this pose to the right one: `y + ω × (y − c) + v`, with c the centre of
    /// the target; as [`crate::Registration::covariance`]. Positive definite.
    pub covariance: Matrix6<f64>,
    /// Probability that the pose is right.
    pub probability: f64,
}

/// Scans and the edges between them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PoseGraph {
    /// A centre of each scan, in its own frame.
    pub centers: Vec<[f64; 3]>,
    /// The edges.
    pub edges: Vec<Edge>,
}

/// Where the scans lie.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// `T_model_scan` of each scan.
    pub poses: Vec<Rigid>,
    /// The model that each scan belongs to: scans that kept edges join, in the order of their first scans. Poses are those in the
    /// frame of the model's anchor.
    pub models: Vec<usize>,
    /// What became of each edge.
    pub edges: Vec<Judged>,
    /// By how much covariances were multiplied, so that edges agree about cycles as they should; at least 1.
    pub inflation: f64,
}

/// What became of an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judged {
    /// Whether it was kept.
    pub kept: bool,
    /// Whether it would have joined parts that other pairs speak against joining so: see [`Joining`].
    pub contradicted: bool,
    /// Squared error under its inflated covariance; `None` where its scans are not of one model.
    pub chi_sq: Option<f64>,
    /// Triangles of edges about which it agrees with two others, and does not.
    pub agreeing: usize,
    /// See `agreeing`.
    pub disagreeing: usize,
}

/// An edge that is about to join two parts, each of scans whose poses are known in a frame of its own.
#[derive(Debug, Clone, Copy)]
pub struct Joining<'a> {
    /// The edge, by its number.
    pub edge: usize,
    /// The scans of its source's part and of its target's.
    pub parts: [&'a [usize]; 2],
    /// Of each scan, in the frame of its part.
    pub poses: &'a [Rigid],
    /// Takes the frame of the source's part to that of the target's, if the edge is right.
    pub T_target_source: Rigid,
}

impl Edge {
    /// The same, told from its target to its source.
    fn reversed(&self, centers: &[[f64; 3]]) -> Self {
        let T_target_source = self.T_target_source.inverse();
        let carry = carried(&T_target_source, centers[self.target], centers[self.source]);
        Self {
            source: self.target,
            target: self.source,
            T_target_source,
            covariance: carry * self.covariance * carry.transpose(),
            probability: self.probability,
        }
    }
}

/// Takes a left twist about `from` to the twist of the same motion after `T`, about `to` in its frame.
fn carried(T: &Rigid, from: [f64; 3], to: [f64; 3]) -> Matrix6<f64> {
    let arm = Vector3::from(T.inverse().apply(to)) - Vector3::from(from);
    let mut carry = Matrix6::zeros();
    carry.fixed_view_mut::<3, 3>(0, 0).copy_from(&T.rotation);
    carry.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-T.rotation * arm.cross_matrix()));
    carry.fixed_view_mut::<3, 3>(3, 3).copy_from(&T.rotation);
    carry
}

/// Left twist about `center` of a motion: its rotation vector, and where it takes the centre.
fn twist_about(error: &Rigid, center: [f64; 3]) -> Vector6<f64> {
    let rotation = Rotation3::from_matrix_unchecked(error.rotation);
    let omega = UnitQuaternion::from_rotation_matrix(&rotation).scaled_axis();
    let v = Vector3::from(error.apply(center)) - Vector3::from(center);
    Vector6::new(omega[0], omega[1], omega[2], v[0], v[1], v[2])
}

/// Inverse of the left Jacobian of the rotations at ω.
fn inverse_left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle_sq = omega.norm_squared();
    let hat = omega.cross_matrix();
    let second = if angle_sq < 1e-8 {
        1.0 / 12.0 + angle_sq / 720.0
    } else {
        let angle = angle_sq.sqrt();
        (1.0 - 0.5 * angle * (0.5 * angle).cos() / (0.5 * angle).sin()) / angle_sq
    };
    Matrix3::identity() - 0.5 * hat + second * hat * hat
}

/// A pose after a step (ω, v) about the scan's centre, in the scan's frame.
fn stepped(pose: &Rigid, center: [f64; 3], step: &Vector6<f64>) -> Rigid {
    let rotation = Rotation3::new(Vector3::new(step[0], step[1], step[2])).into_inner();
    let (center, v) = (Vector3::from(center), Vector3::new(step[3], step[4], step[5]));
    *pose * Rigid { rotation, translation: center + v - rotation * center }
}

impl PoseGraph {
    /// Finds the poses, and the edges that do not fit.
    pub fn solve(&self) -> Solution {
        let parts = self.grown(|_| true);
        self.solved(parts, &|_| ())
    }

    /// As [`Self::solve`]. `joins` says of each edge that would join two parts whether it may, after all that is known of their
    /// scans: parts that are not joined become models of their own. `hear` hears the poses after each step, the last time those
    /// of the solution.
    ///
    /// # Errors
    /// Those of `joins`.
    pub fn solve_asking<E>(
        &self,
        mut joins: impl FnMut(Joining) -> Result<bool, E>,
        hear: &dyn Fn(&[Rigid]),
    ) -> Result<Solution, E> {
        let mut failed = None;
        let parts = self.grown(|joining| {
            failed.is_none()
                && joins(joining).unwrap_or_else(|error| {
                    failed = Some(error);
                    false
                })
        });
        match failed {
            Some(error) => Err(error),
            None => Ok(self.solved(parts, hear)),
        }
    }

    /// Parts along the most trusted edges.
    fn grown(&self, mut joins: impl FnMut(Joining) -> bool) -> Grown {
        let cycles = self.cycles();
        let mut parts = Parts::new(self.centers.len());
        for e in self.by_trust(&cycles.votes) {
            let edge = &self.edges[e];
            let [source, target] = [edge.source, edge.target].map(|scan| parts.of[scan]);
            if source == target {
                continue;
            }
            let T_target_source =
                parts.poses[edge.target] * edge.T_target_source * parts.poses[edge.source].inverse();
            let members = [source, target].map(|part| parts.members[part].as_slice());
            if joins(Joining { edge: e, parts: members, poses: &parts.poses, T_target_source }) {
                parts.join(source, target, &T_target_source);
            }
        }
        Grown { parts, cycles }
    }

    fn solved(&self, Grown { parts, cycles }: Grown, hear: &dyn Fn(&[Rigid])) -> Solution {
        let scans = self.centers.len();
        let within: Vec<bool> =
            self.edges.iter().map(|edge| parts.of[edge.source] == parts.of[edge.target]).collect();
        let mut poses = parts.poses.clone();
        let information: Vec<Matrix6<f64>> = self
            .edges
            .iter()
            .map(|e| (e.covariance * cycles.inflation).try_inverse().unwrap_or_else(Matrix6::zeros))
            .collect();
        let most: Vec<f64> = self.edges.iter().map(|e| CHI_SQ_MOST + 2.0 * odds(e.probability)).collect();

        let mut problem = Problem { graph: self, information: &information, free: Vec::new() };
        problem.anchor(&parts);
        let error = |poses: &[Rigid]| -> Vec<f64> {
            (0..self.edges.len()).map(|e| problem.chi_sq(poses, e)).collect()
        };
        // The poses along the tree are near the right ones where most edges agree with them: from a scale under which these
        // count, and not from one under which all do, the surest of the wrong ones cannot carry them off.
        let ratios = error(&poses).into_iter().zip(&most).map(|(x, m)| x / m);
        let mut exceeding: Vec<f64> =
            ratios.zip(&within).filter(|(_, within)| **within).map(|(x, _)| x).collect();
        exceeding.sort_by(f64::total_cmp);
        let mut scale = exceeding.get(exceeding.len() / 2).map_or(1.0, |middle| WIDELY * middle);
        let agreement: Vec<f64> = (cycles.votes.iter().zip(&within))
            .map(|([yes, no], within)| {
                f64::from(u8::from(*within)) * (yes + 1) as f64 / (yes + no + 1) as f64
            })
            .collect();
        let pattern = problem.pattern(|e| within[e]);
        while scale > 1.0 {
            for _ in 0..STEPS {
                let weights: Vec<f64> = (error(&poses).iter().zip(&most).zip(&agreement))
                    .map(|((x, m), agreement)| agreement * (scale * m / (scale * m + x)).powi(2))
                    .collect();
                problem.step(&pattern, &mut poses, &weights);
                hear(&poses);
            }
            scale /= ANNEALING;
        }
        let mut kept = within.clone();
        for round in 0..MOST_ROUNDS {
            let now: Vec<bool> = (error(&poses).iter().zip(&most).zip(&within))
                .map(|((x, m), within)| *within && x <= m)
                .collect();
            if round > 0 && now == kept {
                break;
            }
            kept = now;
            let weights: Vec<f64> = kept.iter().map(|&k| f64::from(u8::from(k))).collect();
            // Wrong edges join what lies apart: without them the factor has far fewer blocks.
            let pattern = problem.pattern(|e| kept[e]);
            for _ in 0..MOST_STEPS {
                let saved = problem.step(&pattern, &mut poses, &weights);
                hear(&poses);
                if saved < SETTLED {
                    break;
                }
            }
        }
        let chi_sq = error(&poses);
        let mut forest = Forest::new(scans);
        for (edge, _) in self.edges.iter().zip(&kept).filter(|(_, kept)| **kept) {
            forest.join(edge.source, edge.target);
        }
        let models = forest.names();
        self.to_anchors(&mut poses, &models, &kept);
        hear(&poses);
        let edges = (0..self.edges.len())
            .map(|e| Judged {
                kept: kept[e],
                contradicted: !within[e],
                chi_sq: within[e].then_some(chi_sq[e]),
                agreeing: cycles.votes[e][0],
                disagreeing: cycles.votes[e][1],
            })
            .collect();
        Solution { poses, models, edges, inflation: cycles.inflation }
    }

    /// Poses in the frame of each model's scan with the most kept edges.
    fn to_anchors(&self, poses: &mut [Rigid], models: &[usize], kept: &[bool]) {
        let mut degree = vec![0; poses.len()];
        for (edge, _) in self.edges.iter().zip(kept).filter(|(_, kept)| **kept) {
            degree[edge.source] += 1;
            degree[edge.target] += 1;
        }
        let mut anchors: BTreeMap<usize, usize> = BTreeMap::new();
        for (scan, &model) in models.iter().enumerate() {
            let anchor = anchors.entry(model).or_insert(scan);
            if degree[scan] > degree[*anchor] {
                *anchor = scan;
            }
        }
        let inverses: BTreeMap<usize, Rigid> =
            anchors.iter().map(|(&model, &scan)| (model, poses[scan].inverse())).collect();
        for (pose, model) in poses.iter_mut().zip(models) {
            *pose = inverses[model] * *pose;
        }
        for &scan in anchors.values() {
            poses[scan] = Rigid::identity();
        }
    }

    /// Triangles of edges: how much their errors exceed what covariances say, and with how many each edge agrees.
    fn cycles(&self) -> Cycles {
        let mut at: Vec<BTreeMap<usize, Vec<usize>>> = vec![BTreeMap::new(); self.centers.len()];
        for (e, edge) in self.edges.iter().enumerate() {
            at[edge.source].entry(edge.target).or_default().push(e);
            at[edge.target].entry(edge.source).or_default().push(e);
        }
        let mut found: Vec<([usize; 3], f64)> = Vec::new();
        for (a, of_a) in at.iter().enumerate() {
            for (&b, ab) in of_a.range(a + 1..) {
                for (&c, bc) in at[b].range(b + 1..) {
                    let Some(ca) = of_a.get(&c) else { continue };
                    for &x in ab {
                        for &y in bc {
                            found
                                .extend(ca.iter().map(|&z| ([x, y, z], self.mismatch([x, y, z], [a, b, c]))));
                        }
                    }
                }
            }
        }
        let mut errors: Vec<f64> = found.iter().map(|(_, x)| *x).collect();
        errors.sort_by(f64::total_cmp);
        let inflation = errors.get(errors.len() / 4).map_or(1.0, |x| (x / CHI_SQ_QUARTILE).max(1.0));
        let mut votes = vec![[0; 2]; self.edges.len()];
        for (edges, x) in found {
            for e in edges {
                votes[e][usize::from(x > CHI_SQ_MOST * inflation)] += 1;
            }
        }
        Cycles { inflation, votes }
    }

    /// χ² of a way a → b → c against the edge between a and c.
    fn mismatch(&self, [ab, bc, ac]: [usize; 3], [a, b, c]: [usize; 3]) -> f64 {
        let directed = |e: usize, from: usize| {
            let edge = &self.edges[e];
            if edge.source == from { edge.clone() } else { edge.reversed(&self.centers) }
        };
        let (ab, bc, ac) = (directed(ab, a), directed(bc, b), directed(ac, a));
        let way = bc.T_target_source * ab.T_target_source;
        let carry = carried(&bc.T_target_source, self.centers[b], self.centers[c]);
        let covariance = bc.covariance + carry * ab.covariance * carry.transpose() + ac.covariance;
        let error = twist_about(&(way * ac.T_target_source.inverse()), self.centers[c]);
        covariance.cholesky().map_or(f64::INFINITY, |l| error.dot(&l.solve(&error)))
    }

    /// Edges, those first that a way through the scans should take.
    fn by_trust(&self, votes: &[[usize; 2]]) -> Vec<usize> {
        let trust = |e: usize| {
            let [agreeing, disagreeing] = votes[e].map(|n| n as f64);
            // As a share of one more of each: what is in no triangle stands between what agrees and what does not.
            let share = (agreeing + 1.0) / (agreeing + disagreeing + 2.0);
            odds(self.edges[e].probability) + (1.0 + agreeing).ln() + 4.0 * (share / (1.0 - share)).ln()
        };
        let mut order: Vec<usize> = (0..self.edges.len()).collect();
        order.sort_by(|&a, &b| trust(b).total_cmp(&trust(a)).then(a.cmp(&b)));
        order
    }
}

/// Logarithm of the odds of a probability.
pub(super) fn odds(probability: f64) -> f64 {
    let p = probability.clamp(1.0 - SUREST, SUREST);
    (p / (1.0 - p)).ln()
}

/// Parts that edges join, and what triangles say of the edges.
struct Grown {
    parts: Parts,
    cycles: Cycles,
}

/// Scans whose poses are known in common frames.
struct Parts {
    /// The part of each scan, and the scans of each part.
    of: Vec<usize>,
    members: Vec<Vec<usize>>,
    /// Of each scan, in its part's frame.
    poses: Vec<Rigid>,
}

impl Parts {
    fn new(scans: usize) -> Self {
        Self {
            of: (0..scans).collect(),
            members: (0..scans).map(|scan| vec![scan]).collect(),
            poses: vec![Rigid::identity(); scans],
        }
    }

    /// Puts the smaller part into the frame of the larger one.
    fn join(&mut self, source: usize, target: usize, T_target_source: &Rigid) {
        let (from, into, T) = if self.members[source].len() <= self.members[target].len() {
            (source, target, *T_target_source)
        } else {
            (target, source, T_target_source.inverse())
        };
        for scan in std::mem::take(&mut self.members[from]) {
            self.of[scan] = into;
            self.poses[scan] = T * self.poses[scan];
            self.members[into].push(scan);
        }
    }
}

struct Cycles {
    inflation: f64,
    /// Of each edge: triangles about which it agrees, and does not.
    votes: Vec<[usize; 2]>,
}

/// The least squares problem of weighted edges.
struct Problem<'a> {
    graph: &'a PoseGraph,
    information: &'a [Matrix6<f64>],
    /// The number of each scan among those that may move; none for anchors.
    free: Vec<Option<usize>>,
}

impl Problem<'_> {
    /// Holds the first scan of each part.
    fn anchor(&mut self, parts: &Parts) {
        let mut count = 0;
        let mut seen = std::collections::BTreeSet::new();
        self.free = (0..self.graph.centers.len())
            .map(|scan| {
                if seen.insert(parts.of[scan]) {
                    return None;
                }
                count += 1;
                Some(count - 1)
            })
            .collect();
    }

    /// The error of an edge, and where its source's centre and its own are seen from the target.
    fn error(&self, poses: &[Rigid], e: usize) -> (Rigid, Vector6<f64>) {
        let edge = &self.graph.edges[e];
        let predicted = poses[edge.target].inverse() * poses[edge.source];
        let error =
            twist_about(&(predicted * edge.T_target_source.inverse()), self.graph.centers[edge.target]);
        (predicted, error)
    }

    fn chi_sq(&self, poses: &[Rigid], e: usize) -> f64 {
        let (_, error) = self.error(poses, e);
        error.dot(&(self.information[e] * error))
    }

    fn cost(&self, poses: &[Rigid], weights: &[f64]) -> f64 {
        weights.iter().enumerate().filter(|(_, w)| **w > 0.0).map(|(e, w)| w * self.chi_sq(poses, e)).sum()
    }

    /// Derivatives of an edge's error by steps of its source and its target.
    fn derivatives(&self, predicted: &Rigid, error: &Vector6<f64>, e: usize) -> [Matrix6<f64>; 2] {
        let edge = &self.graph.edges[e];
        let center = Vector3::from(self.graph.centers[edge.target]);
        let (omega, v) =
            (Vector3::new(error[0], error[1], error[2]), Vector3::new(error[3], error[4], error[5]));
        let bend = inverse_left_jacobian(&omega);
        let arm = center + v - Vector3::from(predicted.apply(self.graph.centers[edge.source]));
        let (mut by_source, mut by_target) = (Matrix6::zeros(), Matrix6::zeros());
        let R = &predicted.rotation;
        by_source.fixed_view_mut::<3, 3>(0, 0).copy_from(&(bend * R));
        by_source.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-arm.cross_matrix() * R));
        by_source.fixed_view_mut::<3, 3>(3, 3).copy_from(R);
        by_target.fixed_view_mut::<3, 3>(0, 0).copy_from(&-bend);
        by_target.fixed_view_mut::<3, 3>(3, 0).copy_from(&v.cross_matrix());
        by_target.fixed_view_mut::<3, 3>(3, 3).copy_from(&-Matrix3::identity());
        [by_source, by_target]
    }

    /// What the factor is made of when these edges have weight.
    fn pattern(&self, weighty: impl Fn(usize) -> bool) -> Pattern {
        let count = self.free.iter().flatten().count();
        let edges = self.graph.edges.iter().enumerate().filter(|(e, _)| weighty(*e));
        Pattern::new(count, edges.filter_map(|(_, edge)| self.free[edge.source].zip(self.free[edge.target])))
    }

    /// One step of Levenberg and Marquardt; the share of the cost that it saved. Edges with weight are in the pattern.
    fn step(&self, pattern: &Pattern, poses: &mut Vec<Rigid>, weights: &[f64]) -> f64 {
        let count = self.free.iter().flatten().count();
        let mut diagonal = vec![Matrix6::zeros(); count];
        let mut above: BTreeMap<(usize, usize), Matrix6<f64>> = BTreeMap::new();
        let mut right = vec![Vector6::zeros(); count];
        for (e, (edge, &weight)) in self.graph.edges.iter().zip(weights).enumerate() {
            if weight == 0.0 {
                continue;
            }
            let ends = [edge.source, edge.target].map(|scan| self.free[scan]);
            let (predicted, error) = self.error(poses, e);
            let by = self.derivatives(&predicted, &error, e);
            let information = self.information[e] * weight;
            for (end, derivative) in ends.iter().zip(&by) {
                if let Some(i) = *end {
                    diagonal[i] += derivative.transpose() * information * derivative;
                    right[i] -= derivative.transpose() * information * error;
                }
            }
            if let [Some(i), Some(j)] = ends {
                let block = by[0].transpose() * information * by[1];
                let (place, block) = if i < j { ((i, j), block) } else { ((j, i), block.transpose()) };
                *above.entry(place).or_insert_with(Matrix6::zeros) += block;
            }
        }
        let before = self.cost(poses, weights);
        let mut damping = 1e-9;
        while damping < 1e6 {
            let damped: Vec<Matrix6<f64>> = diagonal
                .iter()
                .map(|block| {
                    let held = block.diagonal().map(|v| damping * v + f64::MIN_POSITIVE.sqrt());
                    block + Matrix6::from_diagonal(&held)
                })
                .collect();
            if let Some(steps) = pattern.solve(&damped, &above, &right) {
                let next: Vec<Rigid> = poses
                    .iter()
                    .enumerate()
                    .map(|(scan, pose)| match self.free[scan] {
                        Some(i) => stepped(pose, self.graph.centers[scan], &steps[i]),
                        None => *pose,
                    })
                    .collect();
                let after = self.cost(&next, weights);
                if after <= before {
                    *poses = next;
                    return (before - after) / before.max(f64::MIN_POSITIVE);
                }
            }
            damping *= 100.0;
        }
        0.0
    }
}

/// Disjoint sets of scans.
struct Forest {
    parent: Vec<usize>,
}

impl Forest {
    fn new(scans: usize) -> Self {
        Self { parent: (0..scans).collect() }
    }

    fn root(&mut self, scan: usize) -> usize {
        let mut root = scan;
        while self.parent[root] != root {
            root = self.parent[root];
        }
        let mut at = scan;
        while self.parent[at] != root {
            at = std::mem::replace(&mut self.parent[at], root);
        }
        root
    }

    /// Whether they were apart.
    fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b)] = a.min(b);
        a != b
    }

    /// The set of each scan, numbered in the order of their first scans.
    fn names(&mut self) -> Vec<usize> {
        let mut names = BTreeMap::new();
        (0..self.parent.len())
            .map(|scan| {
                let root = self.root(scan);
                let next = names.len();
                *names.entry(root).or_insert(next)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn random(rng: &mut ChaCha8Rng, turn: f64, shift: f64) -> Rigid {
        let mut value = |size: f64| size * (2.0 * rng.random::<f64>() - 1.0);
        Rigid::exp(&Vector6::new(
            value(turn),
            value(turn),
            value(turn),
            value(shift),
            value(shift),
            value(shift),
        ))
    }

    /// Scans in a row that comes back, each with edges to the next few; far from any origin. With the true poses.
    fn ring(scans: usize, reach: usize, noise: f64, seed: u64) -> (PoseGraph, Vec<Rigid>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let centers: Vec<[f64; 3]> = (0..scans).map(|i| [1000.0 + i as f64, -500.0, 20.0]).collect();
        let truth: Vec<Rigid> = (0..scans)
            .map(|i| {
                let rotation = random(&mut rng, 2.0, 0.0).rotation;
                let (sine, cosine) = (std::f64::consts::TAU * i as f64 / scans as f64).sin_cos();
                let place = 5.0 * Vector3::new(cosine, sine, 0.1 * sine);
                Rigid { rotation, translation: place - rotation * Vector3::from(centers[i]) }
            })
            .collect();
        let mut edges = Vec::new();
        for i in 0..scans {
            for k in 1..=reach {
                let j = (i + k) % scans;
                let exact = truth[j].inverse() * truth[i];
                let off = Vector6::from_fn(|_, _| {
                    noise * (rng.random::<f64>() + rng.random::<f64>() + rng.random::<f64>() - 1.5) * 2.0
                });
                edges.push(Edge {
                    source: i,
                    target: j,
                    T_target_source: about(&off, centers[j]) * exact,
                    covariance: Matrix6::identity() * noise.max(1e-6).powi(2),
                    probability: 0.95,
                });
            }
        }
        (PoseGraph { centers, edges }, truth)
    }

    fn about(twist: &Vector6<f64>, center: [f64; 3]) -> Rigid {
        stepped(&Rigid::identity(), center, twist)
    }

    /// Largest angle and distance at the centres of the poses found from the true ones, seen from one scan.
    fn off(graph: &PoseGraph, found: &[Rigid], truth: &[Rigid]) -> (f64, f64) {
        let to_truth = truth[0] * found[0].inverse();
        let mut worst = (0.0_f64, 0.0_f64);
        for ((found, truth), &center) in found.iter().zip(truth).zip(&graph.centers) {
            let found = to_truth * *found;
            let apart = Vector3::from(found.apply(center)) - Vector3::from(truth.apply(center));
            worst = (worst.0.max((truth.inverse() * found).angle()), worst.1.max(apart.norm()));
        }
        worst
    }

    #[test]
    fn exact_edges_give_exact_poses() {
        let (graph, truth) = ring(12, 2, 0.0, 1);
        let solution = graph.solve();
        let (turn, shift) = off(&graph, &solution.poses, &truth);
        assert!(turn < 1e-9 && shift < 1e-8, "{turn} {shift}");
        assert!(solution.edges.iter().all(|e| e.kept) && solution.models.iter().all(|&m| m == 0));
        assert_eq!(solution.inflation, 1.0);
    }

    #[test]
    fn derivatives_are_those_of_the_error() {
        let (graph, mut poses) = ring(5, 2, 0.0, 2);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for pose in &mut poses {
            *pose = *pose * random(&mut rng, 0.4, 0.4);
        }
        let information = vec![Matrix6::identity(); graph.edges.len()];
        let problem = Problem { graph: &graph, information: &information, free: Vec::new() };
        for e in 0..graph.edges.len() {
            let (predicted, error) = problem.error(&poses, e);
            let by = problem.derivatives(&predicted, &error, e);
            for (scan, by) in [graph.edges[e].source, graph.edges[e].target].into_iter().zip(by) {
                for k in 0..6 {
                    let at = |h: f64| {
                        let mut step = Vector6::zeros();
                        step[k] = h;
                        let mut moved = poses.clone();
                        moved[scan] = stepped(&moved[scan], graph.centers[scan], &step);
                        problem.error(&moved, e).1
                    };
                    let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
                    assert!(
                        (numeric - by.column(k)).amax() < 1e-5 * (1.0 + by.amax()),
                        "{e} {scan} {k}: {numeric} {}",
                        by.column(k)
                    );
                }
            }
        }
    }

    #[test]
    fn noise_is_averaged_and_wrong_edges_are_found() {
        for seed in 0..6 {
            let (mut graph, truth) = ring(30, 3, 1e-3, 10 + seed);
            let before = graph.solve();
            let (turn, shift) = off(&graph, &before.poses, &truth);
            assert!(turn < 5e-3 && shift < 2e-2, "{turn} {shift}");
            assert!(before.edges.iter().filter(|e| !e.kept).count() <= 2);

            // A fifth more, wrong by anything.
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (right, centers) = (graph.edges.len(), graph.centers.clone());
            for _ in 0..right / 5 {
                let (i, j) = (rng.random_range(0..30u64) as usize, rng.random_range(0..30u64) as usize);
                if i != j {
                    let at_source = Rigid::from_translation(centers[i]).inverse();
                    let wrong = Rigid::from_translation(centers[j]) * random(&mut rng, 3.0, 8.0) * at_source;
                    graph.edges.push(Edge {
                        source: i,
                        target: j,
                        T_target_source: wrong,
                        ..graph.edges[0].clone()
                    });
                }
            }
            let after = graph.solve();
            assert!(after.edges[right..].iter().all(|e| !e.kept), "{seed}");
            let (turn, shift) = off(&graph, &after.poses, &before.poses);
            assert!(turn < 1e-3 && shift < 1e-3, "{seed}: {turn} {shift}");
        }
    }

    #[test]
    fn scans_that_nothing_joins_are_models_of_their_own() {
        let (mut graph, _) = ring(6, 2, 0.0, 4);
        let (other, _) = ring(5, 2, 0.0, 5);
        graph.centers.extend(&other.centers);
        graph.edges.extend(other.edges.into_iter().map(|e| Edge {
            source: e.source + 6,
            target: e.target + 6,
            ..e
        }));
        graph.centers.push([0.0; 3]);
        let solution = graph.solve();
        assert_eq!(solution.models, [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 2]);
        assert_eq!(solution.poses[11], Rigid::identity());
        assert_eq!(PoseGraph::default().solve().poses, []);
    }

    #[test]
    fn parts_are_joined_only_by_edges_that_may() {
        // Two rings, and two edges between them that agree with each other.
        let (mut graph, mut truth) = ring(6, 2, 0.0, 4);
        let (other, there) = ring(5, 2, 0.0, 5);
        graph.centers.extend(&other.centers);
        truth.extend(&there);
        let moved = other.edges.into_iter().map(|e| Edge { source: e.source + 6, target: e.target + 6, ..e });
        graph.edges.extend(moved);
        for (source, target) in [(6, 0), (7, 1)] {
            let T_target_source = truth[target].inverse() * truth[source];
            graph.edges.push(Edge { source, target, T_target_source, ..graph.edges[0].clone() });
        }
        let between = graph.edges.len() - 2;
        let mut asked = 0;
        let mut ask = |joining: Joining, may: bool| {
            let edge = &graph.edges[joining.edge];
            let [sources, targets] = joining.parts;
            assert!(sources.contains(&edge.source) && targets.contains(&edge.target));
            // The frames of the parts are such that the edge's own pose comes out.
            let laid = joining.T_target_source * joining.poses[edge.source];
            let told = joining.poses[edge.target] * edge.T_target_source;
            assert!((laid.translation - told.translation).norm() < 1e-9);
            asked += 1;
            Ok::<bool, ()>(may || joining.edge < between)
        };
        let apart = graph.solve_asking(|joining| ask(joining, false), &|_| ()).unwrap();
        assert_eq!(apart.models, [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1]);
        for (e, edge) in apart.edges.iter().enumerate() {
            assert_eq!((edge.kept, edge.contradicted), (e < between, e >= between));
            assert_eq!(edge.chi_sq.is_none(), edge.contradicted);
        }
        let joined = graph.solve_asking(|joining| ask(joining, true), &|_| ()).unwrap();
        assert_eq!(joined, graph.solve());
        assert_eq!(joined.models, [0; 11]);
        // Each edge of the two trees is asked for, and of those between them every one that is refused.
        assert_eq!(asked, (5 + 4 + 2) + (5 + 4 + 1));
        assert_eq!(graph.solve_asking(|_| Err("full"), &|_| ()), Err("full"));
    }
}
