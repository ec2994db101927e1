//! From a pose head's output to rotation matrices, differentiably.

use burn::tensor::Tensor;
use upcr::net::RotationKind;

/// Steps of Newton's iteration to the nearest rotation.
const POLAR_STEPS: usize = 12;

/// `[batch, kind.values()]` → `[batch, 9]`, row by row.
pub fn rotations(kind: RotationKind, values: Tensor<2>) -> Tensor<2> {
    match kind {
        RotationKind::Euler => from_euler(values),
        RotationKind::Quaternion => from_quaternion(values),
        RotationKind::SixD => from_six_d(values),
        RotationKind::Matrix => from_matrix(values),
    }
}

fn column(values: &Tensor<2>, at: usize) -> Tensor<2> {
    values.clone().narrow(1, at, 1)
}

/// R = Rx(a)·Ry(b)·Rz(c).
fn from_euler(angles: Tensor<2>) -> Tensor<2> {
    let (sin, cos) = (angles.clone().sin(), angles.cos());
    let [sa, sb, sc] = [0, 1, 2].map(|axis| column(&sin, axis));
    let [ca, cb, cc] = [0, 1, 2].map(|axis| column(&cos, axis));
    let (sa_sb, ca_sb) = (sa.clone() * sb.clone(), ca.clone() * sb.clone());
    let rows = vec![
        cb.clone() * cc.clone(),
        -cb.clone() * sc.clone(),
        sb,
        ca.clone() * sc.clone() + sa_sb.clone() * cc.clone(),
        ca.clone() * cc.clone() - sa_sb * sc.clone(),
        -sa.clone() * cb.clone(),
        sa.clone() * sc.clone() - ca_sb.clone() * cc.clone(),
        sa * cc + ca_sb * sc,
        ca * cb,
    ];
    Tensor::cat(rows, 1)
}

fn normalized(v: Tensor<2>) -> Tensor<2> {
    let length = (v.clone().square().sum_dim(1) + 1e-12).sqrt();
    v / length
}

fn plus<const N: usize>(values: Tensor<2>, identity: [f32; N]) -> Tensor<2> {
    let device = values.device();
    values + Tensor::<1>::from_floats(identity, &device).unsqueeze()
}

fn from_quaternion(values: Tensor<2>) -> Tensor<2> {
    let q = normalized(plus(values, [1.0, 0.0, 0.0, 0.0]));
    let [w, x, y, z] = [0, 1, 2, 3].map(|part| column(&q, part));
    let twice = |a: &Tensor<2>, b: &Tensor<2>| a.clone() * b.clone() * 2.0;
    let rows = vec![
        -(twice(&y, &y) + twice(&z, &z)) + 1.0,
        twice(&x, &y) - twice(&w, &z),
        twice(&x, &z) + twice(&w, &y),
        twice(&x, &y) + twice(&w, &z),
        -(twice(&x, &x) + twice(&z, &z)) + 1.0,
        twice(&y, &z) - twice(&w, &x),
        twice(&x, &z) - twice(&w, &y),
        twice(&y, &z) + twice(&w, &x),
        -(twice(&x, &x) + twice(&y, &y)) + 1.0,
    ];
    Tensor::cat(rows, 1)
}

fn cross(a: &Tensor<2>, b: &Tensor<2>) -> Tensor<2> {
    let [ax, ay, az] = [0, 1, 2].map(|axis| column(a, axis));
    let [bx, by, bz] = [0, 1, 2].map(|axis| column(b, axis));
    let parts = vec![
        ay.clone() * bz.clone() - az.clone() * by.clone(),
        az * bx.clone() - ax.clone() * bz,
        ax * by - ay * bx,
    ];
    Tensor::cat(parts, 1)
}

/// Row by row from three columns.
fn from_columns(columns: &[Tensor<2>; 3]) -> Tensor<2> {
    let entries = (0..9).map(|entry| column(&columns[entry % 3], entry / 3));
    Tensor::cat(entries.collect(), 1)
}

fn from_six_d(values: Tensor<2>) -> Tensor<2> {
    let values = plus(values, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    let x = normalized(values.clone().narrow(1, 0, 3));
    let b = values.narrow(1, 3, 3);
    let along = (x.clone() * b.clone()).sum_dim(1);
    let y = normalized(b - x.clone() * along);
    let z = cross(&x, &y);
    from_columns(&[x, y, z])
}

/// The orthogonal matrix nearest to I plus the values, by Newton and Schulz' iteration; its third column is turned
/// where it is a reflection.
fn from_matrix(values: Tensor<2>) -> Tensor<2> {
    let batch = values.dims()[0];
    let m = plus(values, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    // Singular values below √3 converge to 1.
    let size = (m.clone().square().sum_dim(1) + 1e-12).sqrt();
    let mut x: Tensor<3> = (m / size).reshape([batch, 3, 3]);
    for _ in 0..POLAR_STEPS {
        let squared = x.clone().transpose().matmul(x.clone());
        x = x.clone() * 1.5 - x.matmul(squared) * 0.5;
    }
    let columns = |at: usize| x.clone().narrow(2, at, 1).reshape([batch, 3]);
    let (a, b) = (columns(0), columns(1));
    let c = cross(&a, &b);
    from_columns(&[a, b, c])
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};
    use nalgebra::{Matrix3, Quaternion, UnitQuaternion};
    use rand::Rng;
    use upcr::transform::{euler, six_d};

    use super::*;
    use crate::random;

    fn matrices(kind: RotationKind, values: &[f32]) -> Vec<Matrix3<f64>> {
        let width = kind.values();
        let batch = values.len() / width;
        let tensor = Tensor::from_data(TensorData::new(values.to_vec(), [batch, width]), &Device::flex());
        let found = rotations(kind, tensor).into_data().try_to_vec::<f32>().unwrap();
        found.chunks(9).map(|m| Matrix3::from_row_iterator(m.iter().map(|&v| f64::from(v)))).collect()
    }

    #[test]
    fn all_kinds_follow_the_library() {
        let mut rng = random::stream(3, 0);
        for kind in [RotationKind::Euler, RotationKind::Quaternion, RotationKind::SixD, RotationKind::Matrix]
        {
            let width = kind.values();
            let values: Vec<f32> = (0..20 * width).map(|_| rng.random_range(-0.6..0.6)).collect();
            for (found, values) in matrices(kind, &values).iter().zip(values.chunks(width)) {
                let v: Vec<f64> = values.iter().map(|&v| f64::from(v)).collect();
                let expected = match kind {
                    RotationKind::Euler => euler::to_rotation([v[0], v[1], v[2]], euler::EulerOrder::Zyx),
                    RotationKind::Quaternion => {
                        let q = Quaternion::new(1.0 + v[0], v[1], v[2], v[3]);
                        UnitQuaternion::from_quaternion(q).to_rotation_matrix().into_inner()
                    }
                    RotationKind::SixD => {
                        six_d::to_rotation([1.0 + v[0], v[1], v[2], v[3], 1.0 + v[4], v[5]]).unwrap()
                    }
                    RotationKind::Matrix => {
                        let m = Matrix3::identity() + Matrix3::from_row_slice(&v);
                        if m.determinant() < 0.1 {
                            continue;
                        }
                        let svd = m.svd(true, true);
                        svd.u.unwrap() * svd.v_t.unwrap()
                    }
                };
                assert!((found - expected).amax() < 2e-3, "{kind:?} {found} {expected}");
            }
        }
    }
}
