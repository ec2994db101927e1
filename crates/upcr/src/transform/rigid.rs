//! A rotation and a translation in double precision.

use nalgebra::{Matrix3, Matrix4, Rotation3, UnitQuaternion, Vector3, Vector6};
use serde::{Serialize, Serializer};

/// A rigid motion `y = R x + t`.
///
/// `T_target_source` takes source coordinates to target coordinates; `a * b` is first `b`, then `a`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rigid {
    /// Proper rotation.
    pub rotation: Matrix3<f64>,
    /// Translation, in the clouds' unit.
    pub translation: Vector3<f64>,
}

/// Largest departure from `Rᵀ R = I` that is taken for rounding in a matrix somebody wrote down.
const ORTHONORMAL_TOLERANCE: f64 = 1e-3;

impl Rigid {
    /// The motion that moves nothing.
    pub fn identity() -> Self {
        Self { rotation: Matrix3::identity(), translation: Vector3::zeros() }
    }

    /// A pure translation.
    pub fn from_translation(translation: [f64; 3]) -> Self {
        Self { rotation: Matrix3::identity(), translation: translation.into() }
    }

    /// From a row-major 4×4 matrix; its rotation is replaced by the nearest proper one.
    ///
    /// # Errors
    /// Says what is wrong where the matrix is not a rigid motion (beyond rounding), or not finite.
    pub fn from_rows(rows: &[[f64; 4]; 4]) -> Result<Self, String> {
        let m = Matrix4::from_fn(|r, c| rows[r][c]);
        if !m.iter().all(|v| v.is_finite()) {
            return Err("the matrix has NaN or infinite entries".into());
        }
        if (m.row(3) - Matrix4::<f64>::identity().row(3)).amax() > ORTHONORMAL_TOLERANCE {
            return Err("the last row is not 0 0 0 1".into());
        }
        let rotation: Matrix3<f64> = m.fixed_view::<3, 3>(0, 0).into();
        if (rotation.transpose() * rotation - Matrix3::identity()).amax() > ORTHONORMAL_TOLERANCE {
            return Err("the upper left 3×3 block is not a rotation (scale or shear)".into());
        }
        if rotation.determinant() < 0.0 {
            return Err("the upper left 3×3 block is a reflection".into());
        }
        Ok(Self { rotation: nearest_rotation(&rotation), translation: m.fixed_view::<3, 1>(0, 3).into() })
    }

    /// Row-major 4×4 matrix.
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        let (r, t) = (&self.rotation, &self.translation);
        [
            [r[(0, 0)], r[(0, 1)], r[(0, 2)], t[0]],
            [r[(1, 0)], r[(1, 1)], r[(1, 2)], t[1]],
            [r[(2, 0)], r[(2, 1)], r[(2, 2)], t[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    }

    /// The motion that undoes this one.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// `R x + t`.
    pub fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        (self.rotation * Vector3::from(x) + self.translation).into()
    }

    /// Exponential of a twist (rotation vector in rad, then translation part), SE(3).
    pub fn exp(twist: &Vector6<f64>) -> Self {
        let omega: Vector3<f64> = twist.fixed_rows::<3>(0).into();
        let v: Vector3<f64> = twist.fixed_rows::<3>(3).into();
        Self { rotation: Rotation3::new(omega).into_inner(), translation: left_jacobian(&omega) * v }
    }

    /// The twist whose exponential this is, rotation vector of length at most π.
    pub fn log(&self) -> Vector6<f64> {
        // By way of the quaternion, which keeps its accuracy at angle π.
        let rotation = Rotation3::from_matrix_unchecked(self.rotation);
        let omega = UnitQuaternion::from_rotation_matrix(&rotation).scaled_axis();
        let v = left_jacobian(&omega).try_inverse().unwrap_or_else(Matrix3::identity) * self.translation;
        Vector6::new(omega[0], omega[1], omega[2], v[0], v[1], v[2])
    }

    /// Angle of the rotation in rad, 0 to π.
    pub fn angle(&self) -> f64 {
        // atan2 keeps its accuracy at 0 and π, where the arc cosine of the trace loses half the digits.
        let r = &self.rotation;
        let sine = Vector3::new(r[(2, 1)] - r[(1, 2)], r[(0, 2)] - r[(2, 0)], r[(1, 0)] - r[(0, 1)]).norm();
        sine.atan2(r.trace() - 1.0)
    }
}

impl std::ops::Mul for Rigid {
    type Output = Self;

    fn mul(self, b: Self) -> Self {
        Self {
            rotation: self.rotation * b.rotation,
            translation: self.rotation * b.translation + self.translation,
        }
    }
}

impl Serialize for Rigid {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.to_rows().serialize(serializer)
    }
}

/// The proper rotation nearest to `m` in the Frobenius norm.
pub(crate) fn nearest_rotation(m: &Matrix3<f64>) -> Matrix3<f64> {
    let svd = m.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Matrix3::identity() };
    let sign = (u * v_t).determinant().signum();
    u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t
}

/// Left Jacobian of SO(3) at the rotation vector `omega`.
fn left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle_sq = omega.norm_squared();
    let hat = omega.cross_matrix();
    let (a, b) = if angle_sq < 1e-8 {
        (0.5 - angle_sq / 24.0, 1.0 / 6.0 - angle_sq / 120.0)
    } else {
        let angle = angle_sq.sqrt();
        ((1.0 - angle.cos()) / angle_sq, (angle - angle.sin()) / (angle_sq * angle))
    };
    Matrix3::identity() + hat * a + hat * hat * b
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;

    /// Motions with every size of rotation, 0 and π and their surroundings among them.
    fn twists() -> impl Strategy<Value = Vector6<f64>> {
        let angle = prop_oneof![
            Just(0.0),
            Just(PI),
            (-16.0_f64..-1.0).prop_map(|e| 10_f64.powf(e)),
            (-16.0_f64..-1.0).prop_map(|e| PI - 10_f64.powf(e)),
            0.0..PI,
        ];
        let vector = || prop::array::uniform3(-1.0_f64..1.0).prop_map(Vector3::from);
        (angle, vector(), vector()).prop_filter_map("no axis", |(angle, axis, v)| {
            let omega = axis.try_normalize(1e-3)? * angle;
            Some(Vector6::new(omega[0], omega[1], omega[2], 5.0 * v[0], 5.0 * v[1], 5.0 * v[2]))
        })
    }

    fn distance(a: &Rigid, b: &Rigid) -> f64 {
        (a.rotation - b.rotation).amax().max((a.translation - b.translation).amax())
    }

    proptest! {
        #[test]
        fn logarithm_undoes_exponential(twist in twists()) {
            let motion = Rigid::exp(&twist);
            let log = motion.log();
            prop_assert!(log.fixed_rows::<3>(0).norm() <= PI + 1e-12);
            prop_assert!(distance(&Rigid::exp(&log), &motion) < 1e-12);
            // At π the axis has two signs.
            if twist.fixed_rows::<3>(0).norm() < 3.1 {
                prop_assert!((log - twist).amax() < 1e-11);
            }
        }

        #[test]
        fn angle_is_the_twist_s(twist in twists()) {
            prop_assert!((Rigid::exp(&twist).angle() - twist.fixed_rows::<3>(0).norm()).abs() < 1e-12);
        }

        #[test]
        fn motions_form_a_group(a in twists(), b in twists(), x in prop::array::uniform3(-9.0_f64..9.0)) {
            let (a, b) = (Rigid::exp(&a), Rigid::exp(&b));
            prop_assert!(distance(&(a * a.inverse()), &Rigid::identity()) < 1e-12);
            prop_assert!(distance(&(a * b).inverse(), &(b.inverse() * a.inverse())) < 1e-12);
            let (chained, composed) = (a.apply(b.apply(x)), (a * b).apply(x));
            prop_assert!((0..3).all(|i| (chained[i] - composed[i]).abs() < 1e-12));
            prop_assert!((a.rotation.determinant() - 1.0).abs() < 1e-12);
        }

        #[test]
        fn rows_come_back(twist in twists()) {
            let motion = Rigid::exp(&twist);
            prop_assert!(distance(&Rigid::from_rows(&motion.to_rows()).unwrap(), &motion) < 1e-12);
        }
    }

    #[test]
    fn rows_that_are_no_motion_are_refused() {
        let refused = |change: fn(&mut [[f64; 4]; 4])| {
            let mut rows = Rigid::identity().to_rows();
            change(&mut rows);
            Rigid::from_rows(&rows).is_err()
        };
        assert!(refused(|m| m[0][3] = f64::NAN));
        assert!(refused(|m| m[3][0] = 1.0));
        assert!(refused(|m| m[1][1] = 2.0));
        assert!(refused(|m| m[2][2] = -1.0));
        assert!(!refused(|m| m[0][1] = 1e-6));
    }
}
