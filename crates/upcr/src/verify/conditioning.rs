//! How firmly the geometry holds the pose.

use nalgebra::{Matrix6, SymmetricEigen, Vector6};

/// Covariance of the left twist (rotation rad, translation) from the information matrix.
///
/// A direction without information gets the variance that an uncertainty of `radius` along it would have.
pub(crate) fn covariance(hessian: &Matrix6<f64>, variance: f64, radius: f64) -> Matrix6<f64> {
    let scale = rotation_scale(radius);
    let eigen = SymmetricEigen::new(scale * hessian * scale);
    let ceiling = radius * radius;
    let spread = eigen
        .eigenvalues
        .map(|information| if information > 0.0 { (variance / information).min(ceiling) } else { ceiling });
    let q = eigen.eigenvectors;
    scale * (q * Matrix6::from_diagonal(&spread) * q.transpose()) * scale
}

/// The direction (left twist, rotation in units of 1/radius) that the geometry holds least, and how firmly: the
/// ratio of the smallest to the largest eigenvalue of the information matrix.
pub(crate) fn weakest_direction(hessian: &Matrix6<f64>, radius: f64) -> (Vector6<f64>, f64) {
    let scale = rotation_scale(radius);
    let eigen = SymmetricEigen::new(scale * hessian * scale);
    let most = eigen.eigenvalues.amax();
    let (index, &least) =
        eigen.eigenvalues.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1)).unwrap_or((0, &0.0));
    (eigen.eigenvectors.column(index).into(), if most > 0.0 { least.max(0.0) / most } else { 0.0 })
}

/// Turns radians into lengths at the cloud's rim, so that all six entries have one unit.
fn rotation_scale(radius: f64) -> Matrix6<f64> {
    let r = 1.0 / radius.max(f64::MIN_POSITIVE);
    Matrix6::from_diagonal(&Vector6::new(r, r, r, 1.0, 1.0, 1.0))
}
