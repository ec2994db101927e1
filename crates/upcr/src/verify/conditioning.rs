//! How firmly the geometry holds the pose: its covariance, and the motions that it leaves free.

use std::f64::consts::PI;

use nalgebra::{DMatrix, DVector, Dyn, Matrix6, Matrix6xX, SymmetricEigen, Vector6};

use crate::refine::{Information, Patch};

/// A motion is free where both clouds' normals agree on no more information about it than this share of what their errors
/// alone would feign (beside [`Information::agreement_by_choice`]), plus this share of what they agree on about the best
/// held one. Free motions of 400 planes and 400 corridors came to 0.24, that share aside.
const BY_CHANCE: f64 = 0.3;
const NEGLIGIBLE: f64 = 5e-4;
/// Where this share of a slide pulls pairs apart, the samples hold the pose, whatever the shape does.
const ADHERENT: f64 = 0.3;
/// Residuals are taken as no better known than this share of the radius: single precision has no more.
const ROUNDING: f64 = 1e-6;
/// Variance over what the pairs' scatter explains. Fitted on 600 pairs of training shapes and virtual scans, of which it
/// brings 95 % into their 95 % ellipsoids.
const INFLATION: f64 = 1.5;

/// How far a pose may be off.
pub(crate) struct Uncertainty {
    /// Of the left twist (rotation rad, translation) about the target's local origin.
    pub covariance: Matrix6<f64>,
    /// Orthonormal basis of the twists that leave the surfaces on each other, rotations in units of 1/radius.
    pub free: Matrix6xX<f64>,
    /// What both clouds' normals agree on about the motion held least, over that about the one held best.
    pub conditioning: f64,
}

impl Uncertainty {
    /// Of a pose that nothing is known of, between clouds of this radius.
    pub fn unknown(radius: f64) -> Self {
        let scale = rotation_scale(radius);
        let covariance = scale * Matrix6::from_diagonal(&prior(radius)) * scale;
        Self { covariance, free: Matrix6xX::zeros(0), conditioning: 0.0 }
    }

    /// Of a pose that may move along the columns of `tangent` (twists).
    pub fn of(information: &Information, tangent: &Matrix6xX<f64>, radius: f64) -> Self {
        // Lengths at the rim in place of angles, so that all coordinates of a twist have one unit; of these twists an
        // orthonormal basis of the possible ones, in which all that follows is written.
        let scale = rotation_scale(radius);
        let rim = Vector6::new(radius, radius, radius, 1.0, 1.0, 1.0);
        let basis = (Matrix6::from_diagonal(&rim) * tangent).qr().q();
        let twists = scale * &basis;
        let unknowns = basis.ncols();
        if unknowns == 0 {
            return Self { covariance: Matrix6::zeros(), free: Matrix6xX::zeros(0), conditioning: 1.0 };
        }
        let reduced = |m: &Matrix6<f64>| twists.transpose() * m * &twists;

        let sum = |of: fn(&Patch) -> Matrix6<f64>| reduced(&information.patches.iter().map(of).sum());
        let agreement = SymmetricEigen::new(sum(|p| p.agreement));
        let free = if information.adherence < ADHERENT {
            free(&agreement, &sum(|p| p.disagreement), BY_CHANCE + information.agreement_by_choice)
        } else {
            DMatrix::zeros(unknowns, 0)
        };
        let held = DMatrix::identity(unknowns, unknowns) - &free * free.transpose();
        let stiffness = positive(&(&held * reduced(&information.stiffness) * &held));
        let scatter = scatter(information, &twists, radius);
        let prior = basis.transpose() * Matrix6::from_diagonal(&prior(radius).map(f64::recip)) * &basis;
        // A sandwich (Huber 1967), inverted: a direction without stiffness is left what is known of it anyhow.
        let precision = match scatter.cholesky() {
            Some(scatter) => &stiffness * scatter.solve(&stiffness) + &prior,
            None => prior,
        };
        let precision = (&precision + precision.transpose()) / 2.0;
        let covariance =
            precision.cholesky().map_or_else(|| DMatrix::zeros(unknowns, unknowns), |p| p.inverse());
        let covariance = &twists * covariance * twists.transpose();
        Self {
            covariance: Matrix6::from_fn(|r, c| f64::midpoint(covariance[(r, c)], covariance[(c, r)])),
            free: &basis * free,
            conditioning: conditioning(&agreement.eigenvalues),
        }
    }
}

/// Covariance of the gradient, in the coordinates whose unit steps are the columns of `twists`.
fn scatter(information: &Information, twists: &Matrix6xX<f64>, radius: f64) -> DMatrix<f64> {
    // Pairs of one patch err together, those of different ones do not.
    let pulls = information.patches.iter().map(|patch| twists.transpose() * patch.gradient);
    let firmest = (twists.transpose() * information.hessian * twists).trace();
    let rounding =
        DMatrix::identity(twists.ncols(), twists.ncols()) * (firmest * (ROUNDING * radius).powi(2));
    let mut scatter = pulls.fold(rounding, |sum, pull| sum + &pull * pull.transpose());
    // The pose has followed a share of each patch's error, and so has the residual that tells it.
    let (patches, unknowns) = (information.patches.len() as f64, twists.ncols() as f64);
    scatter *= INFLATION * (patches / (patches - unknowns).max(1.0)).powi(2);
    // What the refinement has left to do (nothing, where it has settled): the step itself, and as much doubt about the
    // rest as makes a step of that length an ordinary error.
    let pull = twists.transpose() * information.gradient;
    let unfinished = scatter.clone().cholesky().map_or(0.0, |s| pull.dot(&s.solve(&pull)));
    scatter * (1.0 + unfinished / unknowns) + &pull * pull.transpose()
}

/// Smallest over largest of the motions' shares of what both clouds' normals agree on.
fn conditioning(agreed: &DVector<f64>) -> f64 {
    if agreed.max() <= 0.0 { 0.0 } else { agreed.min().max(0.0) / agreed.max() }
}

/// Orthonormal basis of the motions that the surfaces do not resist, in the reduced coordinates; of what errors feign,
/// `by_chance` is no resistance.
fn free(agreement: &SymmetricEigen<f64, Dyn>, feigned: &DMatrix<f64>, by_chance: f64) -> DMatrix<f64> {
    let negligible = NEGLIGIBLE * agreement.eigenvalues.max();
    let motions = agreement.eigenvalues.iter().zip(agreement.eigenvectors.column_iter());
    let free: Vec<DVector<f64>> = motions
        .filter(|(agreed, motion)| **agreed <= negligible + by_chance * motion.dot(&(feigned * motion)))
        .map(|(_, motion)| motion.into_owned())
        .collect();
    if free.is_empty() { DMatrix::zeros(feigned.nrows(), 0) } else { DMatrix::from_columns(&free) }
}

/// The nearest matrix without a negative eigenvalue.
fn positive(m: &DMatrix<f64>) -> DMatrix<f64> {
    let eigen = SymmetricEigen::new((m + m.transpose()) / 2.0);
    let q = &eigen.eigenvectors;
    q * DMatrix::from_diagonal(&eigen.eigenvalues.map(|v| v.max(0.0))) * q.transpose()
}

/// Variances where nothing is known: of an angle uniform over the circle, at the rim, and of a length of a radius.
fn prior(radius: f64) -> Vector6<f64> {
    let length = radius * radius;
    let angle = length * PI * PI / 3.0;
    Vector6::new(angle, angle, angle, length, length, length)
}

/// Turns lengths at the rim into radians.
fn rotation_scale(radius: f64) -> Matrix6<f64> {
    let r = 1.0 / radius.max(f64::MIN_POSITIVE);
    Matrix6::from_diagonal(&Vector6::new(r, r, r, 1.0, 1.0, 1.0))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const RADIUS: f64 = 2.0;

    fn all() -> Matrix6xX<f64> {
        Matrix6xX::identity(6)
    }

    /// What pairs with the point-to-plane rows `rows` say that pull with `pulls`, one patch each.
    fn information(rows: &[Vector6<f64>], pulls: &[f64], normals_error: f64) -> Information {
        let patches = rows.iter().zip(pulls).map(|(row, pull)| Patch {
            gradient: row * *pull,
            agreement: row * row.transpose(),
            disagreement: Matrix6::identity() * normals_error.powi(2),
            stiffness: row * row.transpose(),
            hessian: row * row.transpose(),
        });
        Information::of(patches.collect(), 0.0)
    }

    fn row(point: Vector3<f64>, normal: Vector3<f64>) -> Vector6<f64> {
        let turn = point.cross(&normal);
        Vector6::new(turn[0], turn[1], turn[2], normal[0], normal[1], normal[2])
    }

    fn normal(rng: &mut impl Rng) -> f64 {
        (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
    }

    /// Linear least squares, whose errors are known: the covariance is theirs.
    #[test]
    fn covariance_is_that_of_the_errors() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let (trials, sigma) = (400, 0.01);
        let mut total = 0.0;
        for _ in 0..trials {
            let rows: Vec<Vector6<f64>> =
                (0..200).map(|_| Vector6::from_fn(|k, _| normal(&mut rng) / (1.0 + k as f64))).collect();
            let noise: Vec<f64> = rows.iter().map(|_| sigma * normal(&mut rng)).collect();
            let hessian: Matrix6<f64> = rows.iter().map(|a| a * a.transpose()).sum();
            let error =
                hessian.cholesky().unwrap().solve(&rows.iter().zip(&noise).map(|(a, e)| a * *e).sum());
            let pulls: Vec<f64> = rows.iter().zip(&noise).map(|(a, e)| a.dot(&error) - e).collect();
            let found = Uncertainty::of(&information(&rows, &pulls, 0.0), &all(), RADIUS);
            assert_eq!(found.free.ncols(), 0);
            total += error.dot(&found.covariance.cholesky().unwrap().solve(&error));
        }
        let nees = total / f64::from(trials) * INFLATION;
        assert!((5.5..6.5).contains(&nees), "{nees}");
    }

    #[test]
    fn a_step_not_taken_is_an_error_to_expect() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let rows: Vec<Vector6<f64>> = (0..100).map(|_| Vector6::from_fn(|_, _| normal(&mut rng))).collect();
        let hessian: Matrix6<f64> = rows.iter().map(|a| a * a.transpose()).sum();
        let step = Vector6::new(0.1, -0.05, 0.02, 0.2, -0.1, 0.3);
        let noise = 1e-3;
        let pulls: Vec<f64> = rows.iter().map(|a| noise * normal(&mut rng) - a.dot(&step)).collect();
        let found = Uncertainty::of(&information(&rows, &pulls, 0.0), &all(), RADIUS);
        let nees = step.dot(&found.covariance.cholesky().unwrap().solve(&step));
        assert!(nees < 6.0, "{nees} with {hessian}");
    }

    #[test]
    fn a_plane_is_held_in_three_directions_and_free_in_three() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let rows: Vec<Vector6<f64>> = (0..200)
            .map(|_| row(Vector3::new(normal(&mut rng), normal(&mut rng), 0.0), Vector3::z()))
            .collect();
        let pulls: Vec<f64> = rows.iter().map(|_| 0.01 * normal(&mut rng)).collect();
        let found = Uncertainty::of(&information(&rows, &pulls, 0.05), &all(), RADIUS);
        assert_eq!(found.free.ncols(), 3);
        assert!((found.free.transpose() * &found.free - DMatrix::identity(3, 3)).amax() < 1e-12);
        // Turning about z, sliding along x and y.
        assert!(found.free.rows(0, 2).amax() < 1e-9 && found.free.row(5).amax() < 1e-9, "{}", found.free);
        let variances = found.covariance.diagonal();
        for (k, expected) in [(2, PI * PI / 3.0), (3, RADIUS * RADIUS), (4, RADIUS * RADIUS)] {
            assert!((variances[k] / expected - 1.0).abs() < 1e-6, "{variances}");
        }
        assert!([0, 1, 5].iter().all(|&k| variances[k] < 1e-4), "{variances}");
    }

    /// A plane as two clouds see it whose noise exceeds their spacing: of the pairs those remain whose normals are alike,
    /// and their errors seem to hold it.
    #[test]
    fn normals_chosen_alike_hold_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let patches: Vec<Patch> = (0..1000)
            .filter_map(|_| {
                let point = Vector3::new(normal(&mut rng), normal(&mut rng), 0.0);
                let [n, m] = [0, 1]
                    .map(|_| Vector3::new(0.6 * normal(&mut rng), 0.6 * normal(&mut rng), 1.0).normalize());
                let (a, b) = (row(point, n), row(point, m));
                let patch = Patch {
                    gradient: 0.01 * normal(&mut rng) * a,
                    agreement: (a * b.transpose() + b * a.transpose()) / 2.0,
                    disagreement: (a - b) * (a - b).transpose() / 2.0,
                    stiffness: a * a.transpose(),
                    hessian: a * a.transpose(),
                };
                (n.dot(&m) > 0.5).then_some(patch)
            })
            .collect();
        let taken_as_they_come =
            Information { agreement_by_choice: 0.0, ..Information::of(patches.clone(), 0.0) };
        assert_ne!(Uncertainty::of(&taken_as_they_come, &all(), RADIUS).free.ncols(), 3);
        assert_eq!(Uncertainty::of(&Information::of(patches, 0.0), &all(), RADIUS).free.ncols(), 3);
    }

    #[test]
    fn what_is_locked_has_no_variance() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let rows: Vec<Vector6<f64>> = (0..100).map(|_| Vector6::from_fn(|_, _| normal(&mut rng))).collect();
        let pulls: Vec<f64> = rows.iter().map(|_| 0.01 * normal(&mut rng)).collect();
        let information = information(&rows, &pulls, 0.0);
        let mut tangent = Matrix6xX::zeros(2);
        tangent[(2, 0)] = 1.0;
        tangent[(4, 0)] = 0.5;
        tangent[(3, 1)] = 1.0;
        let found = Uncertainty::of(&information, &tangent, RADIUS).covariance;
        assert!([0, 1, 5].iter().all(|&k| found.row(k).amax() < 1e-15), "{found}");
        assert!(found[(2, 2)] > 0.0 && (found[(2, 4)] / found[(2, 2)] - 0.5).abs() < 1e-9, "{found}");
        let nothing = Uncertainty::of(&information, &Matrix6xX::zeros(0), RADIUS);
        assert_eq!((nothing.covariance.amax(), nothing.free.ncols()), (0.0, 0));
    }
}
