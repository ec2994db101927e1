//! The rotation that lays centred points on their partners, and its gradient.

use burn::tensor::{Tensor, TensorData};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};

/// Least sum of two singular values, as a share of the largest: where they cancel, the rotation is not determined.
const LEAST: f64 = 1e-4;

/// The rotations R that maximise tr(RᵀM) for `covariance` M `[batch, 3, 3]` of targets with sources, Σ y xᵀ.
///
/// The way through a singular value decomposition has no gradient where singular values are equal. R has one: with
/// S = RᵀM symmetric, dR = R·[ω]ₓ and (tr(S)·I − S)·ω = the axis of RᵀdM − dMᵀR, whose matrix has the sums of two
/// singular values as eigenvalues. So R is found on the side, and returned as R·(I + [ω(M)]ₓ), whose ω is zero.
pub fn rotation(covariance: Tensor<3>) -> Tensor<3> {
    let [batch, ..] = covariance.dims();
    let device = covariance.device();
    let values: Vec<f32> = covariance.clone().detach().into_data().iter::<f32>().collect();
    let (mut rotations, mut inverses) = (Vec::with_capacity(9 * batch), Vec::with_capacity(9 * batch));
    for m in values.chunks_exact(9) {
        let m = Matrix3::from_row_iterator(m.iter().map(|&v| f64::from(v)));
        let r = nearest_rotation(&m);
        // Matrices are symmetric or written column by column.
        rotations.extend(r.transpose().iter().map(|&v| v as f32));
        inverses.extend(inverse(&(r.transpose() * m)).iter().map(|&v| v as f32));
    }
    let constant = |values: Vec<f32>| Tensor::<3>::from_data(TensorData::new(values, [batch, 3, 3]), &device);
    let (r, inverse) = (constant(rotations), constant(inverses));
    let s = r.clone().transpose().matmul(covariance);
    let entry = |row: usize, column: usize| s.clone().narrow(1, row, 1).narrow(2, column, 1);
    let axis = [(2, 1), (0, 2), (1, 0)].map(|(a, b)| entry(a, b) - entry(b, a));
    let omega = inverse.matmul(Tensor::cat(axis.to_vec(), 1));
    r.clone() + r.matmul(cross_matrix(&omega))
}

/// `[batch, 3, 1]` → `[batch, 3, 3]`, the matrices of the cross products.
pub(super) fn cross_matrix(v: &Tensor<3>) -> Tensor<3> {
    let [x, y, z] = [0, 1, 2].map(|axis| v.clone().narrow(1, axis, 1));
    let zero = x.zeros_like();
    let row = |entries: [Tensor<3>; 3]| Tensor::cat(entries.to_vec(), 2);
    let rows =
        [row([zero.clone(), -z.clone(), y.clone()]), row([z, zero.clone(), -x.clone()]), row([-y, x, zero])];
    Tensor::cat(rows.to_vec(), 1)
}

/// Where M is not finite or zero, the identity.
fn nearest_rotation(m: &Matrix3<f64>) -> Matrix3<f64> {
    if !m.iter().all(|v| v.is_finite()) {
        return Matrix3::identity();
    }
    let svd = m.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Matrix3::identity() };
    // The least singular value's direction is turned round where the product is a reflection.
    let least = svd.singular_values.imin();
    let mut signs = Vector3::repeat(1.0);
    signs[least] = (u.determinant() * v_t.determinant()).signum();
    u * Matrix3::from_diagonal(&signs) * v_t
}

/// (tr(S)·I − S)⁻¹, of which no eigenvalue is larger than what [`LEAST`] gives.
fn inverse(s: &Matrix3<f64>) -> Matrix3<f64> {
    if !s.iter().all(|v| v.is_finite()) {
        return Matrix3::zeros();
    }
    let s = (s + s.transpose()) * 0.5;
    let SymmetricEigen { eigenvectors, eigenvalues } =
        (Matrix3::identity() * s.trace() - s).symmetric_eigen();
    let least = (LEAST * eigenvalues.amax()).max(1e-12);
    let inverses = eigenvalues.map(|value| 1.0 / value.max(least));
    eigenvectors * Matrix3::from_diagonal(&inverses) * eigenvectors.transpose()
}
