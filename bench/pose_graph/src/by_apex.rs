//! apex-solver: Levenberg–Marquardt. It has the kernel of Geman and McClure, and how that one narrows is written here.

use apex_solver::core::loss_functions::{GemanMcClureLoss, LossFunction};
use apex_solver::core::problem::Problem;
use apex_solver::manifold::ManifoldType;
use apex_solver::manifold::se3::SE3;
use apex_solver::optimizer::levenberg_marquardt::{LevenbergMarquardt, LevenbergMarquardtConfig};
use apex_solver::{BetweenFactor, JacobianMode, NoiseModel, PriorFactor};
use nalgebra_apex::{DMatrix, DVector, Quaternion, Vector3};
use upcr::Rigid;
use upcr::multiway::Edge;

use crate::peer::{ANNEALING, Minimiser, STEPS, THRESHOLD, chi_sq, pose_of, quaternion};

const MOST_STEPS: usize = 100;

pub struct Apex {
    /// Whether the kernel begins as wide as ours does, four times the middle error, and not as wide as it takes for the cost to
    /// be convex, which forgets the start.
    pub near: bool,
}

fn variable(pose: &Rigid) -> SE3 {
    let [w, x, y, z] = quaternion(pose);
    SE3::from_translation_quaternion(
        Vector3::from_row_slice(pose.translation.as_slice()),
        Quaternion::new(w, x, y, z),
    )
}

/// From a start, under a kernel of so wide a scale (χ²).
fn minimised(
    edges: &[&Edge],
    held: &[usize],
    start: &[Rigid],
    scale: Option<f64>,
    most_steps: usize,
) -> Result<(Vec<Rigid>, usize), String> {
    let mut problem = Problem::new(JacobianMode::Sparse);
    let keys: Vec<_> = start
        .iter()
        .map(|pose| {
            problem.add_variable(ManifoldType::SE3, DVector::from_row_slice(&variable(pose).coeffs()))
        })
        .collect();
    for &scan in held {
        problem.add_residual_block_with_noise(
            &[keys[scan]],
            Box::new(PriorFactor::new(variable(&start[scan]))),
            None,
            NoiseModel::from_sigmas(&[1e-4; 6]).map_err(|e| e.to_string())?,
        );
    }
    for edge in edges {
        // Its twists have the translation first.
        let covariance = DMatrix::from_fn(6, 6, |r, c| edge.covariance[((r + 3) % 6, (c + 3) % 6)]);
        let information = covariance.try_inverse().ok_or("not a covariance")?;
        let kernel = match scale {
            Some(scale) => {
                let kernel = GemanMcClureLoss::new(scale.sqrt()).map_err(|e| e.to_string())?;
                Some(Box::new(kernel) as Box<dyn LossFunction + Send + Sync>)
            }
            None => None,
        };
        problem.add_residual_block_with_noise(
            &[keys[edge.source], keys[edge.target]],
            Box::new(BetweenFactor::new(variable(&edge.T_target_source.inverse()))),
            kernel,
            NoiseModel::from_information(information).map_err(|e| e.to_string())?,
        );
    }
    let config = LevenbergMarquardtConfig::new().with_max_iterations(most_steps);
    let result = LevenbergMarquardt::with_config(config).optimize(&mut problem).map_err(|e| e.to_string())?;
    let poses = keys
        .iter()
        .map(|&key| {
            let v = result.parameters[key].as_param_slice();
            pose_of([v[3], v[4], v[5], v[6]], [v[0], v[1], v[2]])
        })
        .collect();
    Ok((poses, result.iterations))
}

impl Minimiser for Apex {
    fn robust(
        &self,
        edges: &[&Edge],
        held: &[usize],
        start: &[Rigid],
    ) -> Result<(Vec<Rigid>, usize), String> {
        let mut exceeding: Vec<f64> = edges.iter().map(|e| chi_sq(e, start) / THRESHOLD).collect();
        exceeding.sort_by(f64::total_cmp);
        let middle = exceeding.get(exceeding.len() / 2).copied().unwrap_or(0.0);
        let most = exceeding.last().copied().unwrap_or(0.0);
        let (mut poses, mut steps) = (start.to_vec(), 0);
        let mut width = if self.near { 4.0 * middle } else { 2.0 * most }.max(ANNEALING);
        while width > 1.0 {
            width = (width / ANNEALING).max(1.0);
            let most_steps = if width > 1.0 { STEPS } else { MOST_STEPS };
            let more;
            (poses, more) = minimised(edges, held, &poses, Some(width * THRESHOLD), most_steps)?;
            steps += more;
        }
        Ok((poses, steps))
    }

    fn plain(&self, edges: &[&Edge], held: &[usize], start: &[Rigid]) -> Result<(Vec<Rigid>, usize), String> {
        minimised(edges, held, start, None, MOST_STEPS)
    }
}
