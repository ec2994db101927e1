//! How firmly the geometry holds the pose: its covariance, and the directions that it leaves free.

use std::f64::consts::PI;

use nalgebra::{DMatrix, DVector, Matrix6, Matrix6xX, SymmetricEigen, Vector6};

use crate::refine::{Information, Patch};

/// A motion is free where both clouds' normals agree on less information about it than this share of what their errors
/// alone would feign, or than this share of what they agree on about the best held one.
const BY_CHANCE: f64 = 0.5;
const NEGLIGIBLE: f64 = 5e-4;
/// Where this share of a slide pulls pairs apart, the samples hold the pose, whatever the shape does.
const ADHERENT: f64 = 0.3;
/// Residuals are taken as no better known than this share of the radius: single precision has no more.
const ROUNDING: f64 = 1e-6;

/// How far a pose may be off.
pub(crate) struct Uncertainty {
    /// Of the left twist (rotation rad, translation) about the target's local origin.
    pub covariance: Matrix6<f64>,
    /// Orthonormal basis of the twists that leave the surfaces on each other, rotations in units of 1/radius.
    pub free: Matrix6xX<f64>,
}

impl Uncertainty {
    /// Of a pose that nothing is known of, between clouds of this radius: turned by any angle, moved by a radius.
    pub fn unknown(radius: f64) -> Self {
        let everywhere = Matrix6::from_diagonal(&prior(radius));
        let scale = rotation_scale(radius);
        Self { covariance: scale * everywhere * scale, free: Matrix6xX::zeros(0) }
    }

    /// Of a pose that may move along the columns of `tangent` (twists).
    pub fn of(information: &Information, tangent: &Matrix6xX<f64>, radius: f64) -> Self {
        // Lengths at the rim in place of angles: all six coordinates of a twist have one unit.
        let scale = rotation_scale(radius);
        let basis = scale.try_inverse().map_or_else(|| tangent.clone(), |rim| rim * tangent).qr().q();
        let to_free = scale * &basis;
        let reduced = |m: &Matrix6<f64>| to_free.transpose() * m * &to_free;

        let free = if information.adherence < ADHERENT { free(information, &reduced) } else { DMatrix::zeros(basis.ncols(), 0) };
        let held = DMatrix::identity(basis.ncols(), basis.ncols()) - &free * free.transpose();
        let stiffness = positive(&(&held * reduced(&information.stiffness) * &held));
        let hessian = reduced(&information.hessian);

        // A sandwich (Huber 1967): pairs of one patch err together, those of different ones do not.
        let mut scatter = &hessian * (ROUNDING * radius).powi(2);
        for patch in &information.patches {
            let pull = to_free.transpose() * patch.gradient;
            scatter += &pull * pull.transpose();
        }
        let (patches, unknowns) = (information.patches.len() as f64, basis.ncols() as f64);
        // The pose has taken its share of each patch's error, and of the estimate of it.
        scatter *= (patches / (patches - unknowns).max(1.0)).powi(2);
        // What the refinement has left to do (nothing, where it has settled): the step itself, and as much doubt about
        // the rest as makes a step of that length an ordinary error.
        let pull = to_free.transpose() * information.gradient;
        let unfinished = scatter.clone().cholesky().map_or(0.0, |s| pull.dot(&s.solve(&pull)));
        if std::env::var_os("NOUNF").is_none() { scatter *= 1.0 + unfinished / unknowns; }
        scatter += &pull * pull.transpose();
        if std::env::var_os("DEBUG_COV").is_some() {
            let g = to_free.transpose() * information.gradient;
            let (v, h, k) = (scatter.clone(), stiffness.clone(), hessian.clone());
            let d = v.clone().cholesky().map_or(0.0, |c| g.dot(&c.solve(&g)));
            eprintln!("  DBG unfinished {d:.3} adherence {:.2} patches {} pairs {} spectrum {:.4?} ratio {:.2?}", information.adherence, information.patches.len(), information.pairs,
             h.symmetric_eigenvalues().as_slice(), (0..6).map(|i| h[(i,i)]/k[(i,i)]).collect::<Vec<_>>());
        }
        let prior = basis.transpose() * Matrix6::from_diagonal(&prior(radius).map(f64::recip)) * &basis;
        let precision = match scatter.cholesky() {
            Some(scatter) => &stiffness * scatter.solve(&stiffness) + &prior,
            None => prior,
        };
        let covariance = (&precision + precision.transpose()) / 2.0;
        let covariance = covariance.cholesky().map_or_else(|| DMatrix::zeros(basis.ncols(), basis.ncols()), |c| c.inverse());
        let full = &to_free * &covariance * to_free.transpose();
        let full = Matrix6::from_fn(|r, c| f64::midpoint(full[(r, c)], full[(c, r)]));
        Self { covariance: full, free: &basis * free }
    }
}

/// Orthonormal basis of the motions that the surfaces do not resist, in the reduced coordinates.
fn free(information: &Information, reduced: &impl Fn(&Matrix6<f64>) -> DMatrix<f64>) -> DMatrix<f64> {
    let sum = |of: fn(&Patch) -> Matrix6<f64>| reduced(&information.patches.iter().map(of).sum());
    let (agreement, disagreement) = (sum(|p| p.agreement), sum(|p| p.disagreement));
    let eigen = SymmetricEigen::new(agreement);
    let largest = eigen.eigenvalues.max();
    let is_free = |(k, agreed): (usize, &f64)| {
        let direction = eigen.eigenvectors.column(k);
        let by_chance = direction.dot(&(&disagreement * direction));
        if std::env::var_os("DEBUG_FREE").is_some() {
            eprint!(" [{:.5} {:.2}]", agreed / largest, agreed / by_chance);
        }
        (*agreed <= (BY_CHANCE * by_chance).max(NEGLIGIBLE * largest)).then_some(k)
    };
    let found: Vec<DVector<f64>> = eigen
        .eigenvalues
        .iter()
        .enumerate()
        .filter_map(is_free)
        .map(|k| eigen.eigenvectors.column(k).into_owned())
        .collect();
    if std::env::var_os("DEBUG_FREE").is_some() { eprintln!(" adherence {:.3} pairs {}", information.adherence, information.pairs); }
    if found.is_empty() { DMatrix::zeros(eigen.eigenvectors.nrows(), 0) } else { DMatrix::from_columns(&found) }
}

/// The nearest matrix without a negative eigenvalue.
fn positive(m: &DMatrix<f64>) -> DMatrix<f64> {
    let eigen = SymmetricEigen::new((m + m.transpose()) / 2.0);
    let q = &eigen.eigenvectors;
    q * DMatrix::from_diagonal(&eigen.eigenvalues.map(|v| v.max(0.0))) * q.transpose()
}

/// Variances of a pose of which nothing is known: an angle uniform over the circle, a length of a radius.
fn prior(radius: f64) -> Vector6<f64> {
    let length = radius * radius;
    let angle = length * PI * PI / 3.0;
    Vector6::new(angle, angle, angle, length, length, length)
}

/// Turns lengths at the cloud's rim into radians.
fn rotation_scale(radius: f64) -> Matrix6<f64> {
    let r = 1.0 / radius.max(f64::MIN_POSITIVE);
    Matrix6::from_diagonal(&Vector6::new(r, r, r, 1.0, 1.0, 1.0))
}
