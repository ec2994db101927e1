//! Angles about the coordinate axes, x, y, z in this order, in rad.

use nalgebra::{Matrix3, Rotation3};

/// How rotations about the fixed axes are chained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EulerOrder {
    /// R = Rz·Ry·Rx: first about x (roll), then y (pitch), then z (yaw).
    #[default]
    Xyz,
    /// R = Rx·Ry·Rz: first about z, then y, then x, as UPCR draws its training poses.
    Zyx,
}

/// The rotation by `angles`.
pub fn to_rotation([x, y, z]: [f64; 3], order: EulerOrder) -> Matrix3<f64> {
    match order {
        EulerOrder::Xyz => Rotation3::from_euler_angles(x, y, z).into_inner(),
        // (Rx Ry Rz)ᵀ = Rz⁻¹ Ry⁻¹ Rx⁻¹
        EulerOrder::Zyx => to_rotation([-x, -y, -z], EulerOrder::Xyz).transpose(),
    }
}

/// The angles of a rotation: x and z in (-π, π], y in [-π/2, π/2].
///
/// At y = ±π/2, where only x and z together are determined, z is 0.
pub fn from_rotation(r: &Matrix3<f64>, order: EulerOrder) -> [f64; 3] {
    match order {
        EulerOrder::Xyz => {
            let cos_y = r[(0, 0)].hypot(r[(1, 0)]);
            let y = (-r[(2, 0)]).atan2(cos_y);
            if cos_y > 1e-9 {
                [r[(2, 1)].atan2(r[(2, 2)]), y, r[(1, 0)].atan2(r[(0, 0)])]
            } else {
                [(-r[(1, 2)]).atan2(r[(1, 1)]), y, 0.0]
            }
        }
        EulerOrder::Zyx => from_rotation(&r.transpose(), EulerOrder::Xyz).map(|a| -a),
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use nalgebra::{Rotation3, Vector3};
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn angles_come_back(x in -3.1..3.1, y in -1.5..1.5, z in -3.1..3.1) {
            for order in [EulerOrder::Xyz, EulerOrder::Zyx] {
                let back = from_rotation(&to_rotation([x, y, z], order), order);
                prop_assert!((Vector3::from(back) - Vector3::new(x, y, z)).amax() < 1e-12);
            }
        }

        #[test]
        fn orders_chain_as_documented(x in -PI..PI, y in -PI..PI, z in -PI..PI) {
            let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
            let [rx, ry, rz] = [0, 1, 2].map(|a| Rotation3::from_axis_angle(&axes[a], [x, y, z][a]).into_inner());
            prop_assert!((to_rotation([x, y, z], EulerOrder::Xyz) - rz * ry * rx).amax() < 1e-12);
            prop_assert!((to_rotation([x, y, z], EulerOrder::Zyx) - rx * ry * rz).amax() < 1e-12);
        }

        #[test]
        fn gimbal_lock_keeps_the_rotation(x in -PI..PI, z in -PI..PI, up: bool) {
            let y = if up { FRAC_PI_2 } else { -FRAC_PI_2 };
            for order in [EulerOrder::Xyz, EulerOrder::Zyx] {
                let r = to_rotation([x, y, z], order);
                prop_assert!((to_rotation(from_rotation(&r, order), order) - r).amax() < 1e-8);
            }
        }
    }
}
