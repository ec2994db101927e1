//! The pairs the learned-registration literature evaluates on, made from one shape each.
//!
//! The source is the shape's leading points; the target is the same points moved by a random motion. What else
//! happens to the two is the [`Protocol`]'s to say. Shapes are expected in the unit sphere or cube.

use std::f64::consts::FRAC_PI_4;
use std::fmt;

use nalgebra::{Rotation3, Vector3};
use rand::seq::SliceRandom;
use rand::{Rng, RngCore};
use upcr::{CloudRole, Error, PointCloud, Result, Rigid};

use crate::random;

/// Leading points of a shape that make a cloud.
pub const POINTS: usize = 1024;
/// Points a cloud keeps where the protocol makes it partial.
pub const PARTIAL_POINTS: usize = 768;
/// Distance of a partial cloud's viewpoint from the origin.
const VIEWPOINT_DISTANCE: f64 = 500.0;
/// Largest absolute translation along an axis.
const MAX_TRANSLATION: f64 = 0.5;

/// How the target is turned against the source.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RotationLaw {
    /// `Rx·Ry·Rz` of three angles uniform in 0° to 45°.
    Euler45,
    /// Uniform over SO(3).
    Uniform,
}

/// Which part of its points a cloud keeps.
///
/// A partial cloud keeps the points nearest to a viewpoint in a random direction, far away. The viewpoint is fixed
/// in the clouds' own frames: the same coordinates see another side of the moved target.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coverage {
    /// Both clouds hold the same points, moved.
    Full,
    /// Both clouds are seen from the same coordinates.
    PartialShared,
    /// Each cloud is seen from a viewpoint of its own.
    PartialIndependent,
}

/// Gaussian noise on every coordinate, cut off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClippedNoise {
    /// Standard deviation before the cut.
    pub sigma: f64,
    /// Largest absolute value.
    pub limit: f64,
}

/// A recipe for pairs; its text names it, and with an item's index seeds all that is random about the pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Protocol {
    /// How the target is turned.
    pub rotation: RotationLaw,
    /// Which part of its points each cloud keeps.
    pub coverage: Coverage,
    /// Noise on each cloud, independent of the other's.
    pub noise: Option<ClippedNoise>,
    /// Share of each cloud's points replaced by points uniform in its bounding box.
    pub outlier_ratio: f64,
}

/// Two clouds and the motion between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// The cloud that is to be moved.
    pub source: PointCloud,
    /// The cloud it is to be laid on.
    pub target: PointCloud,
    /// The true motion.
    pub T_target_source: Rigid,
}

impl ClippedNoise {
    /// N(0, 0.01) cut off at ±0.05.
    pub const STANDARD: Self = Self { sigma: 0.01, limit: 0.05 };
}

impl Protocol {
    /// The same points in both clouds, up to order.
    pub const CONSISTENT: Self =
        Self { rotation: RotationLaw::Euler45, coverage: Coverage::Full, noise: None, outlier_ratio: 0.0 };

    /// Both clouds partial, seen from the same coordinates.
    pub const PARTIAL_SHARED: Self = Self { coverage: Coverage::PartialShared, ..Self::CONSISTENT };

    /// Both clouds partial, each seen from its own viewpoint.
    pub const PARTIAL_INDEPENDENT: Self = Self { coverage: Coverage::PartialIndependent, ..Self::CONSISTENT };

    /// The same with the standard noise.
    #[must_use]
    pub fn noisy(self) -> Self {
        Self { noise: Some(ClippedNoise::STANDARD), ..self }
    }

    /// The same with any rotation.
    #[must_use]
    pub fn any_rotation(self) -> Self {
        Self { rotation: RotationLaw::Uniform, ..self }
    }

    /// The same with a share of outliers in each cloud.
    #[must_use]
    pub fn with_outliers(self, outlier_ratio: f64) -> Self {
        Self { outlier_ratio, ..self }
    }

    /// The pair of the item `index`, whose points are `shape`: the same for the same arguments, always.
    ///
    /// # Errors
    /// Where the shape has fewer than [`POINTS`] points or the outlier ratio is no ratio.
    pub fn pair(&self, shape: &[[f64; 3]], index: u64) -> Result<Pair> {
        let Some(points) = shape.get(..POINTS) else {
            return Err(Error::TooFewPoints { role: CloudRole::Cloud, found: shape.len(), needed: POINTS });
        };
        if !(0.0..=1.0).contains(&self.outlier_ratio) {
            return Err(Error::InvalidSetting { name: "outlier_ratio", reason: "must lie in 0 to 1".into() });
        }
        let mut rng = random::stream(fnv1a(&self.to_string()), index);
        let T_target_source = self.rotation.motion(&mut rng);
        let mut source = points.to_vec();
        let mut target: Vec<_> = points.iter().map(|&p| T_target_source.apply(p)).collect();
        source.shuffle(&mut rng);
        target.shuffle(&mut rng);
        if let Some(noise) = self.noise {
            noise.apply(&mut source, &mut rng);
            noise.apply(&mut target, &mut rng);
        }
        if self.coverage != Coverage::Full {
            let viewpoint = random::direction(&mut rng) * VIEWPOINT_DISTANCE;
            keep_nearest(&mut source, &viewpoint);
            let viewpoint = match self.coverage {
                Coverage::PartialIndependent => random::direction(&mut rng) * VIEWPOINT_DISTANCE,
                _ => viewpoint,
            };
            keep_nearest(&mut target, &viewpoint);
        }
        replace_by_outliers(&mut source, self.outlier_ratio, &mut rng);
        replace_by_outliers(&mut target, self.outlier_ratio, &mut rng);
        Ok(Pair {
            source: PointCloud::from_points(source),
            target: PointCloud::from_points(target),
            T_target_source,
        })
    }
}

impl fmt::Display for Protocol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.coverage {
            Coverage::Full => "consistent",
            Coverage::PartialShared => "partial-shared",
            Coverage::PartialIndependent => "partial-independent",
        })?;
        f.write_str(match self.rotation {
            RotationLaw::Euler45 => " euler45",
            RotationLaw::Uniform => " so3",
        })?;
        if let Some(noise) = self.noise {
            write!(f, " noise {}/{}", noise.sigma, noise.limit)?;
        }
        if self.outlier_ratio > 0.0 {
            write!(f, " outliers {}", self.outlier_ratio)?;
        }
        Ok(())
    }
}

impl RotationLaw {
    fn motion(self, rng: &mut impl Rng) -> Rigid {
        let rotation = match self {
            Self::Euler45 => {
                let [x, y, z] = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()]
                    .map(|axis| Rotation3::from_axis_angle(&axis, rng.random_range(0.0..FRAC_PI_4)));
                (x * y * z).into_inner()
            }
            Self::Uniform => random::rotation(rng),
        };
        let translation = Vector3::from_fn(|_, _| rng.random_range(-MAX_TRANSLATION..MAX_TRANSLATION));
        Rigid { rotation, translation }
    }
}

impl ClippedNoise {
    fn apply(&self, points: &mut [[f64; 3]], rng: &mut impl Rng) {
        for coordinate in points.as_flattened_mut() {
            *coordinate += (self.sigma * random::normal(rng)).clamp(-self.limit, self.limit);
        }
    }
}

/// Keeps the [`PARTIAL_POINTS`] points nearest to `viewpoint`, in their order.
fn keep_nearest(points: &mut Vec<[f64; 3]>, viewpoint: &Vector3<f64>) {
    let distance = |p: &[f64; 3]| (Vector3::from(*p) - viewpoint).norm_squared();
    let mut nearest: Vec<usize> = (0..points.len()).collect();
    nearest.sort_by(|&a, &b| distance(&points[a]).total_cmp(&distance(&points[b])));
    nearest.truncate(PARTIAL_POINTS);
    nearest.sort_unstable();
    *points = nearest.into_iter().map(|i| points[i]).collect();
}

/// Replaces the leading points, whose order is random already, by points uniform in the bounding box.
fn replace_by_outliers(points: &mut [[f64; 3]], ratio: f64, rng: &mut impl RngCore) {
    let bound =
        |axis: usize, pick: fn(f64, f64) -> f64, from: f64| points.iter().map(|p| p[axis]).fold(from, pick);
    let low = [0, 1, 2].map(|axis| bound(axis, f64::min, f64::INFINITY));
    let high = [0, 1, 2].map(|axis| bound(axis, f64::max, f64::NEG_INFINITY));
    let count = (ratio * points.len() as f64).round() as usize;
    for point in &mut points[..count] {
        *point = [0, 1, 2].map(|axis| low[axis] + rng.random::<f64>() * (high[axis] - low[axis]));
    }
}

/// The 64-bit Fowler–Noll–Vo hash (1a), which unlike the standard library's never changes.
fn fnv1a(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape() -> Vec<[f64; 3]> {
        let mut rng = random::stream(11, 0);
        (0..2000)
            .map(|_| random::direction(&mut rng).component_mul(&Vector3::new(1.0, 0.7, 0.4)).into())
            .collect()
    }

    /// How many points of the source, moved, are points of the target up to `tolerance`.
    fn shared(pair: &Pair, tolerance: f64) -> usize {
        let close = |p: [f64; 3]| {
            pair.target.points.iter().any(|&q| (Vector3::from(p) - Vector3::from(q)).amax() <= tolerance)
        };
        pair.source.points.iter().filter(|&&p| close(pair.T_target_source.apply(p))).count()
    }

    #[test]
    fn consistent_clouds_hold_the_same_points_in_another_order() {
        let shape = shape();
        let pair = Protocol::CONSISTENT.pair(&shape, 0).unwrap();
        assert_eq!((pair.source.len(), pair.target.len()), (POINTS, POINTS));
        assert_eq!(shared(&pair, 1e-12), POINTS);
        let same_place = pair.source.points.iter().zip(&pair.target.points);
        let in_order = same_place.filter(|&(&p, &q)| {
            (Vector3::from(pair.T_target_source.apply(p)) - Vector3::from(q)).norm() < 1e-12
        });
        assert!(in_order.count() < 10);
        assert!(pair.source.points.iter().all(|p| shape[..POINTS].contains(p)));
    }

    #[test]
    fn motions_follow_their_laws() {
        let shape = shape();
        let mut largest = 0.0_f64;
        for index in 0..300 {
            let Rigid { rotation: r, translation: t } =
                Protocol::CONSISTENT.pair(&shape, index).unwrap().T_target_source;
            // R = Rx(a) Ry(b) Rz(c)
            let angles = [(-r[(1, 2)]).atan2(r[(2, 2)]), r[(0, 2)].asin(), (-r[(0, 1)]).atan2(r[(0, 0)])];
            assert!(angles.iter().all(|a| (0.0..=FRAC_PI_4).contains(a)), "{angles:?}");
            assert!(t.amax() <= 0.5);
            largest = largest.max(
                Protocol::CONSISTENT.any_rotation().pair(&shape, index).unwrap().T_target_source.angle(),
            );
        }
        assert!(largest > 3.0, "{largest}");
    }

    #[test]
    fn partial_clouds_keep_the_side_toward_their_viewpoint() {
        let shape = shape();
        for protocol in [Protocol::PARTIAL_SHARED, Protocol::PARTIAL_INDEPENDENT] {
            let pair = protocol.pair(&shape, 4).unwrap();
            assert_eq!((pair.source.len(), pair.target.len()), (PARTIAL_POINTS, PARTIAL_POINTS));
            // Half of each cloud is shared at the least: 2 · 768 - 1024.
            let both = shared(&pair, 1e-9);
            assert!((512..PARTIAL_POINTS).contains(&both), "{both}");
        }
    }

    #[test]
    fn noise_is_clipped_and_of_its_size() {
        let mut points = vec![[0.0; 3]; 20_000];
        ClippedNoise { sigma: 0.01, limit: 0.015 }.apply(&mut points, &mut random::stream(1, 1));
        let values = points.as_flattened();
        assert!(values.iter().all(|v| v.abs() <= 0.015));
        assert!(values.iter().any(|v| v.abs() > 0.015 - 1e-12));

        let pair = Protocol::CONSISTENT.noisy().pair(&shape(), 0).unwrap();
        assert!(shared(&pair, 1e-6) < 10);
        assert_eq!(shared(&pair, 0.1), POINTS);
    }

    #[test]
    fn outliers_replace_their_share() {
        let pair = Protocol::CONSISTENT.with_outliers(0.25).pair(&shape(), 0).unwrap();
        assert_eq!(pair.source.len(), POINTS);
        let expected = (0.75_f64 * 0.75 * POINTS as f64) as usize;
        assert!(shared(&pair, 1e-9).abs_diff(expected) < 60);
    }

    #[test]
    fn pairs_depend_on_protocol_and_index_alone() {
        let shape = shape();
        let pair = |protocol: Protocol, index| protocol.pair(&shape, index).unwrap().T_target_source;
        assert_eq!(pair(Protocol::CONSISTENT, 7), pair(Protocol::CONSISTENT, 7));
        assert_ne!(pair(Protocol::CONSISTENT, 7), pair(Protocol::CONSISTENT, 8));
        assert_ne!(pair(Protocol::CONSISTENT, 7), pair(Protocol::PARTIAL_SHARED, 7));
        assert_eq!(fnv1a("a"), 0xaf63_dc4c_8601_ec8c);
    }

    #[test]
    fn bad_input_is_refused() {
        assert!(Protocol::CONSISTENT.pair(&shape()[..1000], 0).is_err());
        assert!(Protocol::CONSISTENT.with_outliers(1.1).pair(&shape(), 0).is_err());
    }
}
