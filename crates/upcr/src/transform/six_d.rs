//! The continuous 6-D representation of rotations (Zhou et al. 2019): the matrix' first two columns.

use nalgebra::{Matrix3, Vector3};

/// Smallest sine, to either vector's length, of the angle between two vectors that span a plane.
const MIN_SINE: f64 = 1e-12;

/// The rotation that Gram-Schmidt makes of two columns, the first kept in direction; `None` where they do not
/// span a plane.
pub fn to_rotation([ax, ay, az, bx, by, bz]: [f64; 6]) -> Option<Matrix3<f64>> {
    let (a, b) = (Vector3::new(ax, ay, az), Vector3::new(bx, by, bz));
    let x = a.try_normalize(0.0)?;
    let b = b.try_normalize(0.0)?;
    let y = (b - x * x.dot(&b)).try_normalize(MIN_SINE)?;
    let r = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    r.iter().all(|v| v.is_finite()).then_some(r)
}

/// The first two columns, one after the other.
pub fn from_rotation(r: &Matrix3<f64>) -> [f64; 6] {
    [r[(0, 0)], r[(1, 0)], r[(2, 0)], r[(0, 1)], r[(1, 1)], r[(2, 1)]]
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rotations_come_back(omega in prop::array::uniform3(-3.0_f64..3.0)) {
            let r = Rotation3::new(Vector3::from(omega)).into_inner();
            prop_assert!((to_rotation(from_rotation(&r)).unwrap() - r).amax() < 1e-12);
        }

        #[test]
        fn any_two_columns_make_a_rotation(v in prop::array::uniform6(-1.0_f64..1.0)) {
            if let Some(r) = to_rotation(v) {
                prop_assert!((r.transpose() * r - Matrix3::identity()).amax() < 1e-9);
                prop_assert!((r.determinant() - 1.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn columns_on_a_line_make_none() {
        assert_eq!(to_rotation([1.0, 2.0, 3.0, 2.0, 4.0, 6.0]), None);
        assert_eq!(to_rotation([0.0, 0.0, 0.0, 2.0, 4.0, 6.0]), None);
        assert_eq!(to_rotation([f64::NAN; 6]), None);
    }
}
