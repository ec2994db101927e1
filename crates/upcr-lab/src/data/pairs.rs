//! The pairs the learned-registration literature evaluates on, made from one shape each.
//!
//! The source is the shape's leading points, or in training some of them at random; the target is the same points
//! moved by a random motion. What else happens to the two is the [`Protocol`]'s to say. Shapes are expected in the unit
//! sphere or cube.

use std::f64::consts::{FRAC_PI_3, FRAC_PI_4};
use std::fmt;

use nalgebra::{Rotation3, Vector3};
use rand::seq::SliceRandom;
use rand::{Rng, RngCore};
use serde::{Deserialize, Serialize};
use upcr::{CloudRole, Error, PointCloud, Result, Rigid};

use crate::random;

/// Points of a shape that make a cloud, where nothing else is said.
pub const POINTS: usize = 1024;
/// Distance of a partial cloud's viewpoint from the origin.
const VIEWPOINT_DISTANCE: f64 = 500.0;
/// Largest absolute translation along an axis.
const MAX_TRANSLATION: f64 = 0.5;

/// How the target is moved against the source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionLaw {
    #[default]
    /// `Rx·Ry·Rz` of three angles uniform in 0° to 45°; translations uniform in ±0.5 along each axis.
    Euler45,
    /// A rotation uniform over SO(3); translations as above.
    AnyRotation,
    /// The usage on 7-Scenes: along one axis of the three at random, a rotation uniform in 0° to 60° about it and a
    /// translation uniform in 0 to 1.
    OneAxis60,
}

/// Which part of its points a cloud keeps.
///
/// A partial cloud keeps the points nearest to a viewpoint in a random direction, far away. The viewpoint is fixed
/// in the clouds' own frames: the same coordinates see another side of the moved target.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Coverage {
    /// Both clouds hold the same points, moved.
    #[default]
    #[serde(rename = "consistent")]
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
    /// The same noise on both clouds, added before the motion, which leaves them consistent; else each has its own.
    pub shared: bool,
}

/// A recipe for pairs; its text names it, and with an item's index seeds all that is random about the pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Protocol {
    /// Points of the shape that each cloud is made of.
    pub points: usize,
    /// How the target is moved.
    pub motion: MotionLaw,
    /// Which part of its points each cloud keeps: all, or where it is partial three quarters.
    pub coverage: Coverage,
    /// Noise on the clouds.
    pub noise: Option<ClippedNoise>,
    /// Share of each cloud's points replaced by points uniform in its bounding box.
    pub outlier_ratio: f64,
}

/// Protocols and how often each is taken, relative to the others.
pub type Mixture = Vec<(Protocol, f64)>;

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
    /// N(0, 0.01) cut off at ±0.05, on each cloud its own.
    pub const STANDARD: Self = Self { sigma: 0.01, limit: 0.05, shared: false };
}

impl Protocol {
    /// The same points in both clouds, up to order.
    pub const CONSISTENT: Self = Self {
        points: POINTS,
        motion: MotionLaw::Euler45,
        coverage: Coverage::Full,
        noise: None,
        outlier_ratio: 0.0,
    };

    /// Both clouds partial, seen from the same coordinates.
    pub const PARTIAL_SHARED: Self = Self { coverage: Coverage::PartialShared, ..Self::CONSISTENT };

    /// Both clouds partial, each seen from its own viewpoint.
    pub const PARTIAL_INDEPENDENT: Self = Self { coverage: Coverage::PartialIndependent, ..Self::CONSISTENT };

    /// The same with the standard noise.
    #[must_use]
    pub fn noisy(self) -> Self {
        Self { noise: Some(ClippedNoise::STANDARD), ..self }
    }

    /// The same with the standard noise, shared by both clouds.
    #[must_use]
    pub fn noisy_alike(self) -> Self {
        Self { noise: Some(ClippedNoise { shared: true, ..ClippedNoise::STANDARD }), ..self }
    }

    /// The same with another law of motion.
    #[must_use]
    pub fn moved_by(self, motion: MotionLaw) -> Self {
        Self { motion, ..self }
    }

    /// The same with a share of outliers in each cloud.
    #[must_use]
    pub fn with_outliers(self, outlier_ratio: f64) -> Self {
        Self { outlier_ratio, ..self }
    }

    /// The same with as many points to start from as leave each cloud with `kept`.
    #[must_use]
    pub fn keeping(self, kept: usize) -> Self {
        let points = if self.coverage == Coverage::Full { kept } else { kept.saturating_mul(4).div_ceil(3) };
        Self { points, ..self }
    }

    /// Points of each cloud of a pair.
    pub fn kept(&self) -> usize {
        if self.coverage == Coverage::Full { self.points } else { self.points - self.points.div_ceil(4) }
    }

    /// Whether pairs can be made from shapes of `len` points.
    ///
    /// # Errors
    /// Where such a shape has fewer points than the protocol asks for, or the outlier ratio is no ratio.
    pub fn check(&self, len: usize) -> Result<()> {
        if self.kept() == 0 {
            return Err(Error::InvalidSetting { name: "points", reason: "must leave 1 at least".into() });
        }
        if !(0.0..=1.0).contains(&self.outlier_ratio) {
            return Err(Error::InvalidSetting { name: "outlier_ratio", reason: "must lie in 0 to 1".into() });
        }
        if len < self.points {
            return Err(Error::TooFewPoints { role: CloudRole::Cloud, found: len, needed: self.points });
        }
        Ok(())
    }

    /// The pair of the item `index`, made of the leading points of `shape`: the same for the same arguments, always.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn pair(&self, shape: &[[f64; 3]], index: u64) -> Result<Pair> {
        self.check(shape.len())?;
        let rng = &mut random::stream(random::fnv1a(&self.to_string()), index);
        Ok(self.pair_of(shape[..self.points].to_vec(), rng))
    }

    /// A pair made of points of `shape` at random, for training.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn random_pair(&self, shape: &[[f64; 3]], rng: &mut impl Rng) -> Result<Pair> {
        self.check(shape.len())?;
        let mut points = shape.to_vec();
        let (chosen, _) = points.partial_shuffle(rng, self.points);
        Ok(self.pair_of(chosen.to_vec(), rng))
    }

    fn pair_of(&self, mut points: Vec<[f64; 3]>, rng: &mut impl Rng) -> Pair {
        let T_target_source = self.motion.draw(rng);
        let (shared, own) = match self.noise {
            Some(noise) if noise.shared => (Some(noise), None),
            noise => (None, noise),
        };
        if let Some(noise) = shared {
            noise.apply(&mut points, rng);
        }
        let mut target: Vec<_> = points.iter().map(|&p| T_target_source.apply(p)).collect();
        let mut source = points;
        source.shuffle(rng);
        target.shuffle(rng);
        if let Some(noise) = own {
            noise.apply(&mut source, rng);
            noise.apply(&mut target, rng);
        }
        if self.coverage != Coverage::Full {
            let viewpoint = random::direction(rng) * VIEWPOINT_DISTANCE;
            keep_nearest(&mut source, &viewpoint, self.kept());
            let viewpoint = match self.coverage {
                Coverage::PartialIndependent => random::direction(rng) * VIEWPOINT_DISTANCE,
                _ => viewpoint,
            };
            keep_nearest(&mut target, &viewpoint, self.kept());
        }
        replace_by_outliers(&mut source, self.outlier_ratio, rng);
        replace_by_outliers(&mut target, self.outlier_ratio, rng);
        Pair {
            source: PointCloud::from_points(source),
            target: PointCloud::from_points(target),
            T_target_source,
        }
    }
}

impl fmt::Display for Protocol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.coverage {
            Coverage::Full => "consistent",
            Coverage::PartialShared => "partial-shared",
            Coverage::PartialIndependent => "partial-independent",
        })?;
        f.write_str(match self.motion {
            MotionLaw::Euler45 => " euler45",
            MotionLaw::AnyRotation => " so3",
            MotionLaw::OneAxis60 => " one-axis60",
        })?;
        if self.points != POINTS {
            write!(f, " points {}", self.points)?;
        }
        if let Some(noise) = self.noise {
            write!(f, " noise {}/{}{}", noise.sigma, noise.limit, if noise.shared { " shared" } else { "" })?;
        }
        if self.outlier_ratio > 0.0 {
            write!(f, " outliers {}", self.outlier_ratio)?;
        }
        Ok(())
    }
}

impl MotionLaw {
    fn draw(self, rng: &mut impl Rng) -> Rigid {
        let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
        let rotation = match self {
            Self::Euler45 => {
                let [x, y, z] =
                    axes.map(|axis| Rotation3::from_axis_angle(&axis, rng.random_range(0.0..FRAC_PI_4)));
                (x * y * z).into_inner()
            }
            Self::AnyRotation => random::rotation(rng),
            Self::OneAxis60 => {
                let axis = axes[rng.random_range(0..axes.len() as u32) as usize];
                let rotation =
                    Rotation3::from_axis_angle(&axis, rng.random_range(0.0..FRAC_PI_3)).into_inner();
                return Rigid { rotation, translation: axis.scale(rng.random_range(0.0..1.0)) };
            }
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

/// Keeps the `count` points nearest to `viewpoint`, in their order.
fn keep_nearest(points: &mut Vec<[f64; 3]>, viewpoint: &Vector3<f64>, count: usize) {
    let distance = |p: &[f64; 3]| (Vector3::from(*p) - viewpoint).norm_squared();
    let mut nearest: Vec<(f64, usize)> = points.iter().map(distance).zip(0..).collect();
    if count < nearest.len() {
        nearest.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        nearest.truncate(count);
        nearest.sort_unstable_by_key(|&(_, i)| i);
    }
    *points = nearest.into_iter().map(|(_, i)| points[i]).collect();
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
                Protocol::CONSISTENT
                    .moved_by(MotionLaw::AnyRotation)
                    .pair(&shape, index)
                    .unwrap()
                    .T_target_source
                    .angle(),
            );
        }
        assert!(largest > 3.0, "{largest}");
    }

    #[test]
    fn partial_clouds_keep_the_side_toward_their_viewpoint() {
        let shape = shape();
        for protocol in [Protocol::PARTIAL_SHARED, Protocol::PARTIAL_INDEPENDENT] {
            let pair = protocol.pair(&shape, 4).unwrap();
            assert_eq!((pair.source.len(), pair.target.len()), (768, 768));
            // Half of each cloud is shared at the least: 2 · 768 - 1024.
            let both = shared(&pair, 1e-9);
            assert!((512..768).contains(&both), "{both}");
        }
    }

    #[test]
    fn noise_is_clipped_and_of_its_size() {
        let mut points = vec![[0.0; 3]; 20_000];
        ClippedNoise { limit: 0.015, ..ClippedNoise::STANDARD }.apply(&mut points, &mut random::stream(1, 1));
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
    }

    #[test]
    fn pairs_are_those_of_the_published_numbers() {
        let coordinates = |i: u64| [i * 7919 % 2003, i * 104_729 % 1009, i * 1_299_709 % 509];
        let shape: Vec<_> = (0..2048).map(|i| coordinates(i).map(|v| v as f64 / 2003.0 - 0.5)).collect();
        // Of item 3: translation, first point of the source, point 700 of the target. Made by the first version.
        let pinned = [
            (
                Protocol::CONSISTENT,
                [
                    [0.269_508_989_534_700_26, -0.372_973_634_060_302_04, 0.431_502_631_152_959_5],
                    [-0.098_102_845_731_402_88, -0.318_272_591_113_33, -0.247_878_182_725_911_1],
                    [-0.169_764_420_078_819_53, -0.538_306_306_586_013_9, 0.233_982_625_752_155_7],
                ],
            ),
            (
                Protocol::PARTIAL_SHARED.noisy(),
                [
                    [0.073_781_124_297_503_28, -0.252_292_396_653_314_4, -0.273_371_774_172_677_55],
                    [-0.034_536_824_420_335_4, -0.417_524_659_416_260_9, -0.311_677_766_913_504_6],
                    [0.262_590_693_283_093_2, -0.170_397_222_815_982_63, -0.901_299_000_169_818_1],
                ],
            ),
            (
                Protocol::PARTIAL_INDEPENDENT.moved_by(MotionLaw::AnyRotation).with_outliers(0.25),
                [
                    [-0.035_576_172_832_815_22, 0.480_277_168_323_986_37, -0.391_623_613_863_471],
                    [0.392_574_391_626_603_07, -0.143_604_002_917_478_43, -0.292_535_837_575_173_2],
                    [-0.045_951_168_741_404_994, -0.261_720_056_444_029_96, -0.139_933_848_315_548_95],
                ],
            ),
        ];
        for (protocol, expected) in pinned {
            let Pair { source, target, T_target_source } = protocol.pair(&shape, 3).unwrap();
            let found = [T_target_source.translation.into(), source.points[0], target.points[700]];
            for (found, expected) in found.as_flattened().iter().zip(expected.as_flattened()) {
                assert!((found - expected).abs() < 1e-12, "{protocol}: {found} {expected}");
            }
        }
    }

    #[test]
    fn motions_along_one_axis_are_screws() {
        let shape = shape();
        let mut seen = [false; 3];
        for index in 0..60 {
            let protocol = Protocol::CONSISTENT.moved_by(MotionLaw::OneAxis60);
            let motion = protocol.pair(&shape, index).unwrap().T_target_source;
            let axis = motion.translation.imax();
            seen[axis] = true;
            let length = motion.translation[axis];
            assert!((0.0..1.0).contains(&length) && motion.translation.norm() == length);
            assert!((motion.rotation * motion.translation - motion.translation).norm() < 1e-12);
            assert!(motion.angle() <= FRAC_PI_3 + 1e-12);
        }
        assert_eq!(seen, [true; 3]);
    }

    #[test]
    fn clouds_have_the_size_that_is_asked_for() {
        let shape = shape();
        for protocol in [Protocol::CONSISTENT, Protocol::PARTIAL_SHARED, Protocol::PARTIAL_INDEPENDENT] {
            for kept in [1, 2, 3, 256, 511, 512, 1024] {
                let protocol = protocol.keeping(kept);
                let pair = protocol.pair(&shape, 0).unwrap();
                assert_eq!((protocol.kept(), pair.source.len(), pair.target.len()), (kept, kept, kept));
            }
        }
        assert_eq!(Protocol::PARTIAL_SHARED.kept(), 768);
    }

    #[test]
    fn shared_noise_leaves_the_clouds_consistent() {
        let shape = shape();
        let pair = Protocol::CONSISTENT.noisy_alike().pair(&shape, 0).unwrap();
        assert_eq!(shared(&pair, 1e-12), POINTS);
        assert!(!pair.source.points.iter().any(|p| shape.contains(p)));
    }

    #[test]
    fn random_pairs_are_of_other_points_each_time() {
        let shape = shape();
        let rng = &mut random::stream(5, 0);
        let mut pair = || Protocol::CONSISTENT.keeping(500).random_pair(&shape, rng).unwrap();
        let (first, second) = (pair(), pair());
        assert_eq!(shared(&first, 1e-12), 500);
        assert!(first.source.points.iter().all(|p| shape.contains(p)));
        let again = first.source.points.iter().filter(|p| second.source.points.contains(p)).count();
        // 500 · 500 / 2000 are expected.
        assert!((80..170).contains(&again), "{again}");
    }

    #[test]
    fn bad_input_is_refused() {
        assert!(Protocol::CONSISTENT.pair(&shape()[..1000], 0).is_err());
        assert!(Protocol::CONSISTENT.with_outliers(1.1).pair(&shape(), 0).is_err());
        assert!(Protocol::CONSISTENT.keeping(0).pair(&shape(), 0).is_err());
        assert!(Protocol { points: 1, ..Protocol::PARTIAL_SHARED }.pair(&shape(), 0).is_err());
        assert!(Protocol::PARTIAL_SHARED.keeping(1600).pair(&shape(), 0).is_err());
    }
}
