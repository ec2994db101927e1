//! How points are spread: what of a cloud's size and proportions no motion changes.

use nalgebra::{Matrix3, SymmetricEigen, U3, Vector3};

use super::PointCloud;

/// Points that tell how a cloud is spread.
const POINTS: usize = 4096;

/// Standard deviations along the principal axes, largest first.
pub(crate) fn deviations(cloud: &PointCloud) -> Vector3<f64> {
    let step = cloud.len().div_ceil(POINTS).max(1);
    let mut deviations = principal_axes(cloud.points.iter().step_by(step).copied()).eigenvalues;
    deviations.as_mut_slice().sort_by(|a, b| b.total_cmp(a));
    deviations.map(|variance| variance.max(0.0).sqrt())
}

/// Eigenvectors and eigenvalues of the covariance.
pub(crate) fn principal_axes(
    points: impl ExactSizeIterator<Item = [f64; 3]> + Clone,
) -> SymmetricEigen<f64, U3> {
    let weight = 1.0 / points.len().max(1) as f64;
    let mean = mean(points.clone());
    let covariance: Matrix3<f64> = points
        .map(|p| {
            let d = Vector3::from(p) - mean;
            d * d.transpose() * weight
        })
        .sum();
    covariance.symmetric_eigen()
}

/// The centroid.
pub(crate) fn mean(points: impl ExactSizeIterator<Item = [f64; 3]>) -> Vector3<f64> {
    let weight = 1.0 / points.len().max(1) as f64;
    points.map(|p| Vector3::from(p) * weight).sum()
}
