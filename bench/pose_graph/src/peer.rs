//! What the other solvers have in common: they minimise, and what begins and ends a solution is written here, as ours does it.

use std::collections::BinaryHeap;

use nalgebra::{Rotation3, UnitQuaternion, Vector3, Vector6};
use upcr::Rigid;
use upcr::multiway::{Edge, PoseGraph};

/// χ² of six degrees of freedom that one right edge in a hundred exceeds: where the kernels end.
pub const THRESHOLD: f64 = 16.81;
/// The kernel of graduated non-convexity narrows by this factor at each step.
pub const ANNEALING: f64 = 1.4;
/// Steps of the minimiser under one kernel.
pub const STEPS: usize = 5;
/// Rounds in which edges may still be dropped or taken back.
const MOST_ROUNDS: usize = 10;

/// What a solver makes of a graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// `T_model_scan`
    pub poses: Vec<Rigid>,
    pub kept: Vec<bool>,
    /// Steps of the minimiser.
    pub steps: usize,
}

/// A crate that minimises. Scans' centres are their origins; the first scan of each connected part is to be held.
pub trait Minimiser {
    /// By graduated non-convexity, all edges under a robust kernel; with the number of steps.
    fn robust(&self, edges: &[&Edge], held: &[usize], start: &[Rigid])
    -> Result<(Vec<Rigid>, usize), String>;
    /// Least squares.
    fn plain(&self, edges: &[&Edge], held: &[usize], start: &[Rigid]) -> Result<(Vec<Rigid>, usize), String>;
}

/// The graph in frames whose origins are the scans' centres: there a twist about the centre is a twist.
fn centered(graph: &PoseGraph) -> PoseGraph {
    let to_center: Vec<Rigid> = graph.centers.iter().map(|&c| Rigid::from_translation(c)).collect();
    let edges = graph
        .edges
        .iter()
        .map(|e| Edge {
            T_target_source: to_center[e.target].inverse() * e.T_target_source * to_center[e.source],
            ..e.clone()
        })
        .collect();
    PoseGraph { centers: vec![[0.0; 3]; graph.centers.len()], edges }
}

/// Squared error of an edge of a centred graph.
pub fn chi_sq(edge: &Edge, poses: &[Rigid]) -> f64 {
    let error = poses[edge.target].inverse() * poses[edge.source] * edge.T_target_source.inverse();
    let omega =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(error.rotation)).scaled_axis();
    let twist = Vector6::from_iterator(omega.iter().chain(error.translation.iter()).copied());
    edge.covariance.cholesky().map_or(f64::INFINITY, |root| twist.dot(&root.solve(&twist)))
}

/// Of each scan the first one that edges join it with.
pub fn parts<'a>(scans: usize, edges: impl IntoIterator<Item = &'a Edge>) -> Vec<usize> {
    let mut first: Vec<usize> = (0..scans).collect();
    fn root(first: &[usize], mut scan: usize) -> usize {
        while first[scan] != scan {
            scan = first[scan];
        }
        scan
    }
    for edge in edges {
        let (a, b) = (root(&first, edge.source), root(&first, edge.target));
        first[a.max(b)] = a.min(b);
    }
    (0..scans).map(|scan| root(&first, scan)).collect()
}

fn held(scans: usize, edges: &[&Edge]) -> Vec<usize> {
    let first = parts(scans, edges.iter().copied());
    (0..scans).filter(|&scan| first[scan] == scan).collect()
}

/// Poses along the tree of the most probable edges, of equals those that take the fewest steps.
pub fn along_a_tree(graph: &PoseGraph) -> Vec<Rigid> {
    let scans = graph.centers.len();
    let mut met: Vec<Vec<usize>> = vec![Vec::new(); scans];
    for (e, edge) in graph.edges.iter().enumerate() {
        met[edge.source].push(e);
        met[edge.target].push(e);
    }
    let mut poses: Vec<Option<Rigid>> = vec![None; scans];
    for root in 0..scans {
        // Probabilities are positive: their bits are in order as they are.
        let mut next = BinaryHeap::from([(
            u64::MAX,
            0_isize,
            0_isize,
            root,
            Rigid::identity().to_rows().map(|r| r.map(f64::to_bits)),
        )]);
        while let Some((_, depth, _, scan, pose)) = next.pop() {
            if poses[scan].is_some() {
                continue;
            }
            let pose =
                Rigid::from_rows(&pose.map(|r| r.map(f64::from_bits))).unwrap_or_else(|_| Rigid::identity());
            poses[scan] = Some(pose);
            for &e in &met[scan] {
                let edge = &graph.edges[e];
                let (other, lies) = if edge.target == scan {
                    (edge.source, pose * edge.T_target_source)
                } else {
                    (edge.target, pose * edge.T_target_source.inverse())
                };
                let bits = lies.to_rows().map(|r| r.map(f64::to_bits));
                next.push((edge.probability.to_bits(), depth - 1, -(e as isize), other, bits));
            }
        }
    }
    poses.into_iter().map(|pose| pose.unwrap_or_else(Rigid::identity)).collect()
}

/// Robustly from the start; then without the edges that do not fit, until no edge changes sides.
pub fn solve(minimiser: &dyn Minimiser, graph: &PoseGraph, start: &[Rigid]) -> Result<Found, String> {
    let scans = graph.centers.len();
    let inner = centered(graph);
    let to_center: Vec<Rigid> = graph.centers.iter().map(|&c| Rigid::from_translation(c)).collect();
    let start: Vec<Rigid> = start.iter().zip(&to_center).map(|(pose, c)| *pose * *c).collect();
    let all: Vec<&Edge> = inner.edges.iter().collect();
    let most: Vec<f64> = (all.iter())
        .map(|e| {
            let p = e.probability.clamp(0.01, 0.99);
            THRESHOLD + 2.0 * (p / (1.0 - p)).ln()
        })
        .collect();
    let (mut poses, mut steps) = minimiser.robust(&all, &held(scans, &all), &start)?;
    let mut kept = vec![true; all.len()];
    for round in 0..MOST_ROUNDS {
        let now: Vec<bool> = all.iter().zip(&most).map(|(e, most)| chi_sq(e, &poses) <= *most).collect();
        if round > 0 && now == kept {
            break;
        }
        kept = now;
        let those: Vec<&Edge> = all.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(e, _)| *e).collect();
        let more;
        (poses, more) = minimiser.plain(&those, &held(scans, &those), &poses)?;
        steps += more;
    }
    let poses = poses.iter().zip(&to_center).map(|(pose, c)| *pose * c.inverse()).collect();
    Ok(Found { poses, kept, steps })
}

/// Rotation as (w, x, y, z).
pub fn quaternion(pose: &Rigid) -> [f64; 4] {
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(pose.rotation));
    [q.w, q.i, q.j, q.k]
}

pub fn pose_of([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Rigid {
    let q = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
    Rigid { rotation: q.to_rotation_matrix().into_inner(), translation: Vector3::from(translation) }
}
