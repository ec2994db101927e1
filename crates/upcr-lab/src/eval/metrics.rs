//! Errors of estimated poses: those of the literature's tables, and those a user can rely on.

use nalgebra::{Matrix3, Vector3};
use upcr::Rigid;

/// Errors over many items. Lengths are in the clouds' unit; all is NaN over no items.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseErrors {
    /// Root mean square over the items' three extrinsic zyx Euler angles, taken one by one, without wrapping.
    pub euler_rmse_deg: f64,
    /// Mean absolute error of the same angles.
    pub euler_mae_deg: f64,
    /// Root mean square over the translations' components.
    pub translation_rmse: f64,
    /// Mean absolute error of the translations' components.
    pub translation_mae: f64,
    /// Mean angle of the rotation between estimate and truth.
    pub rotation_mean_deg: f64,
    /// Mean length of the difference of the translations.
    pub translation_mean: f64,
}

/// Where a shape's points lie: enough to tell how far a change of pose moves them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShapeSpread {
    /// Mean of the points.
    pub centroid: Vector3<f64>,
    /// Λ², the covariance about the centroid.
    pub covariance: Matrix3<f64>,
}

impl PoseErrors {
    /// Errors of (estimate, truth) pairs.
    pub fn of(poses: &[(Rigid, Rigid)]) -> Self {
        let items = poses.len() as f64;
        let mut sums = [0.0; 6];
        for (estimate, truth) in poses {
            let angles_deg = euler_zyx_deg(&estimate.rotation) - euler_zyx_deg(&truth.rotation);
            let translation = estimate.translation - truth.translation;
            let terms = [
                angles_deg.norm_squared() / 3.0,
                angles_deg.abs().sum() / 3.0,
                translation.norm_squared() / 3.0,
                translation.abs().sum() / 3.0,
                rotation_error_deg(estimate, truth),
                translation.norm(),
            ];
            for (sum, term) in sums.iter_mut().zip(terms) {
                *sum += term / items;
            }
        }
        if poses.is_empty() {
            sums = [f64::NAN; 6];
        }
        Self {
            euler_rmse_deg: sums[0].sqrt(),
            euler_mae_deg: sums[1],
            translation_rmse: sums[2].sqrt(),
            translation_mae: sums[3],
            rotation_mean_deg: sums[4],
            translation_mean: sums[5],
        }
    }
}

/// How far off a pose may be to count as found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Angle between the rotations.
    pub rotation_deg: f64,
    /// Length of the difference of the translations, in the clouds' unit.
    pub translation: f64,
}

/// How many poses are found, of how many.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Recall {
    /// Poses within the tolerance.
    pub found: usize,
    /// All poses.
    pub of: usize,
}

impl Tolerance {
    /// Indoor scenes, in metres.
    pub const INDOOR: Self = Self { rotation_deg: 5.0, translation: 0.3 };

    /// Lidar on a car, in metres.
    pub const DRIVING: Self = Self { rotation_deg: 2.0, translation: 0.6 };

    /// An object of a given diameter.
    pub fn object(diameter: f64) -> Self {
        Self { rotation_deg: 5.0, translation: 0.1 * diameter }
    }

    /// Whether an estimate lies within it.
    pub fn holds(&self, estimate: &Rigid, truth: &Rigid) -> bool {
        rotation_error_deg(estimate, truth) <= self.rotation_deg
            && (estimate.translation - truth.translation).norm() <= self.translation
    }
}

impl Recall {
    /// Of (estimate, truth) pairs, each with its tolerance.
    pub fn of(poses: &[(Rigid, Rigid)], tolerance: impl Fn(usize) -> Tolerance) -> Self {
        let found = (poses.iter().enumerate())
            .filter(|(i, (estimate, truth))| tolerance(*i).holds(estimate, truth))
            .count();
        Self { found, of: poses.len() }
    }

    /// Share of the poses, 0 to 1; NaN over none.
    pub fn share(&self) -> f64 {
        self.found as f64 / self.of as f64
    }
}

/// Largest distance between two of the points; 0 for none. Takes time quadratic in their number.
pub fn diameter(points: &[[f64; 3]]) -> f64 {
    let farthest = |(i, p): (usize, &[f64; 3])| {
        let distance_sq = |q: &[f64; 3]| (Vector3::from(*p) - Vector3::from(*q)).norm_squared();
        points[i + 1..].iter().map(distance_sq).fold(0.0, f64::max)
    };
    points.iter().enumerate().map(farthest).fold(0.0, f64::max).sqrt()
}

/// Angle of the rotation between two poses, 0 to 180 degrees.
pub fn rotation_error_deg(estimate: &Rigid, truth: &Rigid) -> f64 {
    (truth.inverse() * *estimate).angle().to_degrees()
}

/// Angles in degrees about the fixed axes z, y and x, applied in this order: `R = Rx(c) Ry(b) Rz(a)`, returned as
/// (a, b, c), with b within ±90°. Where b is ±90° only a ± c is determined and c is 0.
pub fn euler_zyx_deg(rotation: &Matrix3<f64>) -> Vector3<f64> {
    let r = rotation;
    let cos_b = r[(0, 0)].hypot(r[(0, 1)]);
    let b = r[(0, 2)].atan2(cos_b);
    let (a, c) = if cos_b > 1e-7 {
        ((-r[(0, 1)]).atan2(r[(0, 0)]), (-r[(1, 2)]).atan2(r[(2, 2)]))
    } else {
        (r[(1, 0)].atan2(r[(1, 1)]), 0.0)
    };
    Vector3::new(a, b, c).map(f64::to_degrees)
}

impl ShapeSpread {
    /// Of a shape's points; all zero for none.
    pub fn of(points: &[[f64; 3]]) -> Self {
        let weight = 1.0 / points.len().max(1) as f64;
        let centroid = points.iter().map(|&p| Vector3::from(p) * weight).sum::<Vector3<f64>>();
        let covariance = points
            .iter()
            .map(|&p| {
                let d = Vector3::from(p) - centroid;
                d * d.transpose() * weight
            })
            .sum();
        Self { centroid, covariance }
    }

    /// Brégier's distance of two poses of the shape (no symmetries), `sqrt(|Δt|² + |ΔR Λ|²)`, Δt being the
    /// displacement of the centroid: the root mean square displacement of the shape's points.
    pub fn distance(&self, a: &Rigid, b: &Rigid) -> f64 {
        let turned = a.rotation - b.rotation;
        let moved = turned * self.centroid + a.translation - b.translation;
        let spread = (turned * self.covariance * turned.transpose()).trace();
        (moved.norm_squared() + spread.max(0.0)).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;
    use nalgebra::Rotation3;

    fn about(axis: [f64; 3], angle_deg: f64) -> Rigid {
        let axis = Vector3::from(axis).normalize();
        let rotation = Rotation3::new(axis * angle_deg.to_radians()).into_inner();
        Rigid { rotation, translation: Vector3::zeros() }
    }

    #[test]
    fn euler_angles_compose_back() {
        let axes = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]];
        for angles in [[10.0, 20.0, 30.0], [-170.0, -80.0, 100.0], [30.0, 90.0, 0.0], [-40.0, -90.0, 0.0]] {
            let [z, y, x] = [0, 1, 2].map(|i| about(axes[i], angles[i]));
            let found = euler_zyx_deg(&(x * y * z).rotation);
            assert!((found - Vector3::from(angles)).amax() < 1e-6, "{angles:?} {found:?}");
        }
    }

    #[test]
    fn tables_are_those_worked_by_hand() {
        let mut off = about([0.0, 0.0, 1.0], 6.0);
        off.translation = Vector3::new(3.0, 0.0, -4.0);
        let poses = [(off, Rigid::identity()), (off, off)];
        let errors = PoseErrors::of(&poses);
        let expected = [(36.0_f64 / 6.0).sqrt(), 1.0, (25.0_f64 / 6.0).sqrt(), 7.0 / 6.0, 3.0, 2.5];
        let found = [
            errors.euler_rmse_deg,
            errors.euler_mae_deg,
            errors.translation_rmse,
            errors.translation_mae,
            errors.rotation_mean_deg,
            errors.translation_mean,
        ];
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
        assert!(PoseErrors::of(&[]).euler_rmse_deg.is_nan());
    }

    #[test]
    fn recall_counts_what_is_within_both_tolerances() {
        let mut off = about([0.0, 0.0, 1.0], 6.0);
        off.translation = Vector3::new(3.0, 0.0, -4.0);
        let poses = [(off, Rigid::identity()), (off, off)];
        for (rotation_deg, translation, found) in [(5.9, 9.0, 1), (6.1, 4.9, 1), (6.1, 5.1, 2)] {
            let recall = Recall::of(&poses, |_| Tolerance { rotation_deg, translation });
            assert_eq!(recall, Recall { found, of: 2 });
            assert_eq!(recall.share(), found as f64 / 2.0);
        }
        let wide = Tolerance { rotation_deg: 7.0, ..Tolerance::object(51.0) };
        assert_eq!(Recall::of(&poses, |i| if i == 0 { Tolerance::DRIVING } else { wide }).found, 1);
        assert_eq!(Recall::of(&poses, |_| wide).found, 2);
        assert!(Recall::of(&[], |_| wide).share().is_nan());
    }

    #[test]
    fn diameters_are_those_of_the_farthest_points() {
        let corners = (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2].map(f64::from).map(|v| 3.0 * v + 1.0));
        assert!((diameter(&corners.collect::<Vec<_>>()) - 27.0_f64.sqrt()).abs() < 1e-12);
        assert_eq!((diameter(&[]), diameter(&[[1.0; 3]])), (0.0, 0.0));
    }

    #[test]
    fn rotation_error_is_the_angle_between() {
        let a = about([1.0, 2.0, -1.0], 130.0);
        let b = a * about([0.0, 1.0, 1.0], 25.0);
        assert!((rotation_error_deg(&a, &b) - 25.0).abs() < 1e-9);
    }

    #[test]
    fn distance_is_the_root_mean_square_displacement() {
        let mut rng = random::stream(2, 0);
        let points: Vec<[f64; 3]> = (0..50)
            .map(|_| {
                Vector3::new(2.0, 1.0, 0.2).component_mul(&random::direction(&mut rng)).add_scalar(3.0).into()
            })
            .collect();
        let a = Rigid { translation: Vector3::new(0.3, -0.2, 0.1), ..about([1.0, 0.2, 0.4], 40.0) };
        let b = Rigid { translation: Vector3::new(-0.1, 0.5, 0.0), ..about([-1.0, 0.7, 0.1], 75.0) };
        let displacement =
            |&p: &[f64; 3]| (Vector3::from(a.apply(p)) - Vector3::from(b.apply(p))).norm_squared();
        let expected = (points.iter().map(displacement).sum::<f64>() / 50.0).sqrt();
        let spread = ShapeSpread::of(&points);
        assert!((spread.distance(&a, &b) - expected).abs() < 1e-9);
        assert!(spread.distance(&a, &a) < 1e-12);
    }
}
