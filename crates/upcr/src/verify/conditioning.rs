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

/// How firmly the geometry holds the direction that it holds least: the ratio of the smallest to the largest
/// eigenvalue of the information matrix, its rotations in units of 1/radius.
pub(crate) fn conditioning(hessian: &Matrix6<f64>, radius: f64) -> f64 {
    let scale = rotation_scale(radius);
    let information = (scale * hessian * scale).symmetric_eigenvalues();
    if information.max() > 0.0 { information.min().max(0.0) / information.max() } else { 0.0 }
}

/// Turns radians into lengths at the cloud's rim, so that all six entries have one unit.
fn rotation_scale(radius: f64) -> Matrix6<f64> {
    let r = 1.0 / radius.max(f64::MIN_POSITIVE);
    Matrix6::from_diagonal(&Vector6::new(r, r, r, 1.0, 1.0, 1.0))
}
