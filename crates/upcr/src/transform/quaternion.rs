//! Unit quaternions `[w, x, y, z]`.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion};

/// The rotation a quaternion stands for, its length divided out; `None` where that is zero or not finite.
pub fn to_rotation([w, x, y, z]: [f64; 4]) -> Option<Matrix3<f64>> {
    let q = Quaternion::new(w, x, y, z);
    let length = q.norm();
    (length > 0.0 && length.is_finite())
        .then(|| UnitQuaternion::new_unchecked(q / length).to_rotation_matrix().into_inner())
}

/// The unit quaternion of a rotation; of the two, the one with w ≥ 0.
pub fn from_rotation(r: &Matrix3<f64>) -> [f64; 4] {
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*r));
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [q.w, q.i, q.j, q.k].map(|v| v * sign)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rotations_come_back(axis in prop::array::uniform3(-1.0_f64..1.0), turns in 0..=8) {
            prop_assume!(Vector3::from(axis).norm() > 1e-3);
            // Half turns among them, where w vanishes.
            let omega = Vector3::from(axis).normalize() * f64::from(turns) * std::f64::consts::FRAC_PI_4;
            let r = Rotation3::new(omega).into_inner();
            let q = from_rotation(&r);
            prop_assert!(q[0] >= 0.0);
            prop_assert!((to_rotation(q.map(|v| 3.0 * v)).unwrap() - r).amax() < 1e-12);
        }
    }

    #[test]
    fn known_values() {
        assert_eq!(to_rotation([2.0, 0.0, 0.0, 0.0]), Some(Matrix3::identity()));
        let half_turn = Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 1.0));
        assert_eq!(to_rotation([0.0, 0.0, 0.0, 1.0]), Some(half_turn));
        assert_eq!(to_rotation([0.0; 4]), None);
        assert_eq!(to_rotation([f64::NAN; 4]), None);
    }
}
