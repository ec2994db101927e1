//! What the tests share: pairs of clouds with known poses, and how far a pose is off.

// Each test file uses a part of it.
#![allow(dead_code)]

pub mod consistent;

use std::path::{Path, PathBuf};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use upcr::{PointCloud, Rigid, io};

/// Two clouds and the true `T_target_source`.
#[derive(Debug, Clone)]
pub struct Pair {
    pub name: String,
    pub source: PointCloud,
    pub target: PointCloud,
    pub truth: Rigid,
}

/// How far a pose is off.
#[derive(Debug, Clone, Copy)]
pub struct PoseError {
    /// Angle of the rotation between estimate and truth.
    pub degrees: f64,
    /// How far apart the two lay the source's centroid, which does not depend on where the origin is.
    pub centroid: f64,
}

impl PoseError {
    pub fn within(&self, degrees: f64, centroid: f64) -> bool {
        self.degrees < degrees && self.centroid < centroid
    }
}

impl std::fmt::Display for PoseError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "off by {:.3}° and {:.3e}", self.degrees, self.centroid)
    }
}

impl Pair {
    /// The committed pair, every `step`-th point of it.
    pub fn sample(step: usize) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../samples");
        let cloud = |name: &str| {
            let whole = io::read_cloud(folder.join(name)).unwrap();
            PointCloud::from_points(whole.points.into_iter().step_by(step).collect())
        };
        Self {
            name: "sample".into(),
            source: cloud("source.ply"),
            target: cloud("target.ply"),
            truth: io::read_transform(folder.join("T_target_source.txt")).unwrap(),
        }
    }

    /// The pair with `source` moved by `motion` beforehand.
    #[must_use]
    pub fn with_source_moved(&self, motion: &Rigid) -> Self {
        let source = self.source.transformed(motion);
        Self { source, truth: self.truth * motion.inverse(), ..self.clone() }
    }

    /// The pair with its source turned about the origin by a rotation from all of SO(3).
    #[must_use]
    pub fn turned(self) -> Self {
        let seed =
            self.name.bytes().fold(0_u64, |seed, byte| seed.wrapping_mul(31).wrapping_add(byte.into()));
        self.with_source_moved(&rotation(&mut seeded(seed)))
    }

    /// Target and source in each other's place.
    #[must_use]
    pub fn reversed(self) -> Self {
        Self {
            source: self.target,
            target: self.source,
            truth: self.truth.inverse(),
            name: format!("reversed {}", self.name),
        }
    }

    /// How far `found` is off.
    pub fn error(&self, found: &Rigid) -> PoseError {
        between(found, &self.truth, centroid(&self.source))
    }

    /// Root mean square distance of the source's points from their centroid.
    pub fn size(&self) -> f64 {
        let middle = centroid(&self.source);
        let sum: f64 = self.source.points.iter().map(|&p| (Vector3::from(p) - middle).norm_squared()).sum();
        (sum / self.source.len() as f64).sqrt()
    }
}

/// How far apart two poses are for points about `middle`.
pub fn between(a: &Rigid, b: &Rigid, middle: Vector3<f64>) -> PoseError {
    let apart = Vector3::from(a.apply(middle.into())) - Vector3::from(b.apply(middle.into()));
    PoseError { degrees: (a.inverse() * *b).angle().to_degrees(), centroid: apart.norm() }
}

pub fn centroid(cloud: &PointCloud) -> Vector3<f64> {
    cloud.points.iter().map(|&p| Vector3::from(p)).sum::<Vector3<f64>>() / cloud.len() as f64
}

pub fn seeded(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// A draw from N(0, 1).
pub fn normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// A rotation uniform over SO(3).
pub fn rotation(rng: &mut impl Rng) -> Rigid {
    let quaternion = Quaternion::new(normal(rng), normal(rng), normal(rng), normal(rng));
    let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner();
    Rigid { rotation, translation: Vector3::zeros() }
}

/// A flat or curved square of `n * n` points over `size` by `size`, its height told by `height` in units of `size`.
pub fn sheet(n: usize, size: f64, height: impl Fn(f64, f64) -> f64) -> PointCloud {
    let at = |i: usize| i as f64 / (n - 1) as f64;
    let point = |(u, v): (f64, f64)| [size * u, size * v, size * height(u, v)];
    PointCloud::from_points((0..n * n).map(|i| point((at(i / n), at(i % n)))).collect())
}

/// A height without symmetry.
pub fn bumps(u: f64, v: f64) -> f64 {
    0.2 * (5.0 * u).sin() + 0.15 * (7.0 * v + 2.0 * u).cos() + 0.3 * u * v
}

/// A folder of the public data sets; where it is absent, says so.
pub fn data(folder: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let root = std::env::var_os("UPCR_DATA").filter(|v| !v.is_empty()).map_or(beside, PathBuf::from);
    let path = root.join(folder);
    if path.is_dir() {
        return Some(path);
    }
    say(&format!("skipped: {folder} is absent (looked for at {}; UPCR_DATA tells where)", path.display()));
    None
}

/// Writes a line to stderr past the test harness, which keeps passing tests' output to itself.
pub fn say(line: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{line}");
}
