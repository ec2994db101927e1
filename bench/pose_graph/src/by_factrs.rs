//! factrs: Levenberg–Marquardt, and graduated non-convexity with the kernel of Geman and McClure.

use std::cell::Cell;

use factrs::assign_symbols;
use factrs::containers::{FactorBuilder, Graph, Values};
use factrs::linalg::{Matrix6, Vector3};
use factrs::noise::GaussianNoise;
use factrs::optimizers::{
    BaseOptParams, GncGemanMcClure, GncParams, GraduatedNonConvexity, LevenMarquardt, LevenParams, OptError,
    OptObserverVec, OptResult, Optimizer,
};
use factrs::residuals::{BetweenResidual, PriorResidual};
use factrs::variables::{SE3, SO3};
use upcr::Rigid;
use upcr::multiway::Edge;

use crate::peer::{ANNEALING, Minimiser, STEPS, pose_of, quaternion};

assign_symbols!(X: SE3);

thread_local! {
    static COUNT: Cell<usize> = const { Cell::new(0) };
}

pub struct Factrs;

/// Its minimiser, with its steps counted.
struct Counted(LevenMarquardt);

impl Optimizer for Counted {
    type Params = LevenParams;

    fn new(params: LevenParams, graph: Graph) -> Self {
        Self(LevenMarquardt::new(params, graph))
    }

    fn observers(&self) -> &OptObserverVec {
        self.0.observers()
    }

    fn observers_mut(&mut self) -> &mut OptObserverVec {
        self.0.observers_mut()
    }

    fn graph(&self) -> &Graph {
        self.0.graph()
    }

    fn graph_mut(&mut self) -> &mut Graph {
        self.0.graph_mut()
    }

    fn params(&self) -> &BaseOptParams {
        self.0.params()
    }

    fn init(&mut self, values: &Values) -> Vec<&'static str> {
        self.0.init(values)
    }

    fn step(&mut self, values: Values, number: usize) -> OptResult<(Values, String)> {
        COUNT.set(COUNT.get() + 1);
        self.0.step(values, number)
    }

    fn error(&self, values: &Values) -> f64 {
        self.0.error(values)
    }
}

/// Between neighbouring numbers it takes an edge for odometry, of which none is wrong.
fn symbol(scan: usize) -> X {
    X(2 * scan as u32)
}

fn variable(pose: &Rigid) -> SE3 {
    let [w, x, y, z] = quaternion(pose);
    SE3::from_rot_trans(SO3::from_xyzw(x, y, z, w), Vector3::from_row_slice(pose.translation.as_slice()))
}

fn problem(edges: &[&Edge], held: &[usize], start: &[Rigid]) -> Result<(Graph, Values), String> {
    let (mut graph, mut values) = (Graph::new(), Values::new());
    for (scan, pose) in start.iter().enumerate() {
        values.insert(symbol(scan), variable(pose));
    }
    for &scan in held {
        let factor = FactorBuilder::new1(PriorResidual::new(variable(&start[scan])), symbol(scan))
            .noise(GaussianNoise::<6>::from_scalar_sigma(1e-4))
            .build();
        graph.add_factor(factor);
    }
    for edge in edges {
        let covariance = Matrix6::from_column_slice(edge.covariance.as_slice());
        let noise = GaussianNoise::from_matrix_cov(covariance.as_view()).ok_or("not a covariance")?;
        let delta = variable(&edge.T_target_source.inverse());
        let factor =
            FactorBuilder::new2(BetweenResidual::new(delta), symbol(edge.source), symbol(edge.target))
                .noise(noise)
                .build();
        graph.add_factor(factor);
    }
    Ok((graph, values))
}

fn minimised(
    mut optimizer: impl Optimizer,
    values: Values,
    scans: usize,
) -> Result<(Vec<Rigid>, usize), String> {
    COUNT.set(0);
    let values = match optimizer.optimize(values) {
        Ok(values) | Err(OptError::MaxIterations(values)) => values,
        Err(error) => {
            return Err(match error {
                OptError::FailedToStep => "no step lowers the cost",
                _ => "singular",
            }
            .into());
        }
    };
    let poses = (0..scans)
        .map(|scan| {
            let pose: &SE3 = values.get(symbol(scan)).ok_or("a pose is missing")?;
            let (q, t) = (pose.rot(), pose.xyz());
            Ok(pose_of([q.w(), q.x(), q.y(), q.z()], [t[0], t[1], t[2]]))
        })
        .collect::<Result<_, String>>()?;
    Ok((poses, COUNT.get()))
}

impl Minimiser for Factrs {
    fn robust(
        &self,
        edges: &[&Edge],
        held: &[usize],
        start: &[Rigid],
    ) -> Result<(Vec<Rigid>, usize), String> {
        let (graph, values) = problem(edges, held, start)?;
        let mut params: GncParams<Counted> = GncParams::default();
        params.mu_step_size = ANNEALING;
        params.percentile = 0.99;
        params.inner.base.max_iterations = STEPS;
        params.inner.min_model_fidelity = -1e4;
        let optimizer: GraduatedNonConvexity<GncGemanMcClure, Counted> =
            GraduatedNonConvexity::new(params, graph);
        minimised(optimizer, values, start.len())
    }

    fn plain(&self, edges: &[&Edge], held: &[usize], start: &[Rigid]) -> Result<(Vec<Rigid>, usize), String> {
        let (graph, values) = problem(edges, held, start)?;
        minimised(Counted::new(LevenParams::default(), graph), values, start.len())
    }
}
