//! A storm of pairs that hardly are any, each through every method, refinements taking turns: an error, or an answer that
//! is honest.
//!
//! `UPCR_DEGENERATE` tells how many (`50000`), or which (`1234..1235`).

#![allow(clippy::unwrap_used, clippy::panic)]

mod common;

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use common::consistent::choices::{FEATURES, KERNELS, METHODS, REFINEMENTS};
use common::consistent::inconsistencies;
use common::{bumps, normal, rotation, seeded};
use nalgebra::Vector3;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use upcr::{Locks, Method, PointCloud, Registration, Rigid, Settings, register};

/// Pairs of an ordinary run.
const FEW: u64 = 500;
/// No pair of so few points takes longer.
const LONGEST: Duration = Duration::from_secs(2);
/// An answer above this is called sure.
const SURE: f64 = 0.9;
/// What a cloud looks like, all of about unit size.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shape {
    Equal,
    Duplicates,
    Line,
    NearLine,
    NoisyLine,
    Circle,
    Disc,
    FlatGrid,
    Grid,
    Lattice,
    Sphere,
    Cylinder,
    Cluster,
    TwoClusters,
    Noise,
    Outlier,
    Sheet,
}

/// What is wrong with an answer.
#[derive(Debug)]
enum Mistake {
    /// It must never be.
    Broken(String),
    /// It is sure of a pose that is wrong.
    Sure(String),
}

const SHAPES: [Shape; 17] = [
    Shape::Equal,
    Shape::Duplicates,
    Shape::Line,
    Shape::NearLine,
    Shape::NoisyLine,
    Shape::Circle,
    Shape::Disc,
    Shape::FlatGrid,
    Shape::Grid,
    Shape::Lattice,
    Shape::Sphere,
    Shape::Cylinder,
    Shape::Cluster,
    Shape::TwoClusters,
    Shape::Noise,
    Shape::Outlier,
    Shape::Sheet,
];

impl Shape {
    /// Whether the verdict is never sure of a wrong pose of it.
    fn is_told_apart(self) -> bool {
        use Shape::{Circle, Disc, Duplicates, Equal, Line, NearLine, NoisyLine, Outlier, TwoClusters};
        matches!(
            self,
            Equal | Duplicates | Line | NearLine | NoisyLine | Circle | Disc | TwoClusters | Outlier
        )
    }

    fn points(self, n: usize, rng: &mut ChaCha8Rng) -> Vec<[f64; 3]> {
        let mut uniform = |low: f64, high: f64| rng.random_range(low..high);
        let line = |t: f64| [0.6 * t, -0.3 * t, 0.74 * t];
        let side = (n as f64).sqrt().ceil() as usize;
        let edge = (n as f64).cbrt().ceil() as usize;
        let (turn, distinct) = (std::f64::consts::TAU, 1 + n / 10);
        let points = 0..n;
        match self {
            Self::Equal => vec![[0.3, -0.2, 0.5]; n],
            Self::Duplicates => {
                let few: Vec<[f64; 3]> = (0..distinct).map(|_| [0; 3].map(|_| uniform(-1.0, 1.0))).collect();
                points.map(|i| few[i % distinct]).collect()
            }
            Self::Line => points.map(|_| line(uniform(-1.0, 1.0))).collect(),
            Self::NearLine => {
                points.map(|_| line(uniform(-1.0, 1.0)).map(|v| v + uniform(-1e-5, 1e-5))).collect()
            }
            Self::NoisyLine => {
                points.map(|_| line(uniform(-1.0, 1.0)).map(|v| v + uniform(-0.02, 0.02))).collect()
            }
            Self::Circle => {
                points.map(|_| uniform(0.0, turn)).map(|angle| [angle.cos(), angle.sin(), 0.0]).collect()
            }
            Self::Disc => points
                .map(|_| (uniform(0.0, 1.0).sqrt(), uniform(0.0, turn)))
                .map(|(r, angle)| [r * angle.cos(), r * angle.sin(), 0.0])
                .collect(),
            Self::FlatGrid => points.map(|i| [(i / side) as f64, (i % side) as f64, 0.0]).collect(),
            Self::Grid => {
                points.map(|i| [i / edge / edge, i / edge % edge, i % edge].map(|v| v as f64)).collect()
            }
            Self::Lattice => points.map(|_| [0; 3].map(|_| uniform(0.0, 5.0).floor())).collect(),
            Self::Sphere => {
                let mut directions = || Vector3::from_fn(|_, _| normal(rng)).normalize().into();
                points.map(|_| directions()).collect()
            }
            Self::Cylinder => points
                .map(|_| (uniform(0.0, turn), uniform(-1.0, 1.0)))
                .map(|(angle, z)| [0.5 * angle.cos(), 0.5 * angle.sin(), z])
                .collect(),
            Self::Cluster => points.map(|_| [0; 3].map(|_| normal(rng))).collect(),
            Self::TwoClusters => {
                let at = |i: usize| if i.is_multiple_of(2) { 0.0 } else { 1.0 };
                points.map(|i| [0; 3].map(|_| at(i) + 0.01 * normal(rng))).collect()
            }
            Self::Noise => points.map(|_| [0; 3].map(|_| uniform(-1.0, 1.0))).collect(),
            Self::Outlier => {
                let away = 10f64.powf(uniform(1.0, 7.0));
                let mut cloud: Vec<[f64; 3]> = points.map(|_| [0; 3].map(|_| uniform(-1.0, 1.0))).collect();
                if let Some(last) = cloud.last_mut() {
                    *last = [away; 3];
                }
                cloud
            }
            Self::Sheet => points
                .map(|_| (uniform(0.0, 1.0), uniform(0.0, 1.0)))
                .map(|(u, v)| [u, v, bumps(u, v)])
                .collect(),
        }
    }
}

/// How the target came from the source.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Relation {
    Identical,
    Moved,
    Shuffled,
    Noisy,
    Half,
    /// Other points of the same shape.
    SameShape,
    /// Points of another shape, or of the same in another size.
    Other,
    Mirrored,
}

const RELATIONS: [Relation; 8] = [
    Relation::Identical,
    Relation::Moved,
    Relation::Shuffled,
    Relation::Noisy,
    Relation::Half,
    Relation::SameShape,
    Relation::Other,
    Relation::Mirrored,
];

/// A pair and what it is registered with.
#[derive(Debug)]
struct Case {
    name: String,
    shape: Shape,
    source: PointCloud,
    target: PointCloud,
    /// The motion that made the target, where one did.
    truth: Option<Rigid>,
    /// Whether the target's points are the source's, so that whatever lays them on each other is right.
    same_samples: bool,
    settings: Settings,
}

impl Case {
    /// The pair `seed`, to be registered by `method`; refinements take turns.
    fn new(seed: u64, method: Method) -> Self {
        let mut rng = seeded(seed);
        let refine = REFINEMENTS[seed as usize % REFINEMENTS.len()];

        let shape = SHAPES[rng.random_range(0..SHAPES.len())];
        let relation = RELATIONS[rng.random_range(0..RELATIONS.len())];
        let count = if rng.random_bool(0.15) { rng.random_range(0..11) } else { rng.random_range(3..151) };
        let scale = if rng.random_bool(0.5) { 1.0 } else { 10f64.powi(rng.random_range(-6..7)) };
        let offset = |rng: &mut ChaCha8Rng| {
            if rng.random_bool(0.7) { [0.0; 3] } else { [0; 3].map(|_| 1e7 * scale * normal(rng)) }
        };
        let mut points = shape.points(count, &mut rng);
        points.iter_mut().flatten().for_each(|v| *v *= scale);
        let here = offset(&mut rng);
        let source: Vec<[f64; 3]> = points.iter().map(|p| [0, 1, 2].map(|k| p[k] + here[k])).collect();

        let mut motion = rotation(&mut rng);
        if relation == Relation::Identical || rng.random_bool(0.2) {
            motion = Rigid::identity();
        } else if rng.random_bool(0.5) {
            let small = nalgebra::Vector6::from_fn(|_, _| 0.05 * normal(&mut rng));
            motion = Rigid::exp(&small);
        }
        motion.translation *= scale;
        let there = if relation == Relation::Identical { here } else { offset(&mut rng) };
        let truth = Rigid::from_translation(there) * motion * Rigid::from_translation(here.map(|v| -v));

        let mut target = match relation {
            Relation::SameShape => shape.points(count, &mut rng),
            Relation::Other => {
                let other = SHAPES[rng.random_range(0..SHAPES.len())];
                let size = 10f64.powi(if rng.random_bool(0.5) { 0 } else { rng.random_range(-12..13) });
                let count = rng.random_range(0..151);
                other.points(count, &mut rng).iter().map(|p| p.map(|v| v * size)).collect()
            }
            Relation::Mirrored => {
                points.iter().map(|&[x, y, z]| [x / scale, y / scale, -z / scale]).collect()
            }
            _ => points.iter().map(|p| p.map(|v| v / scale)).collect(),
        };
        match relation {
            Relation::Shuffled => target.shuffle(&mut rng),
            Relation::Noisy => {
                let sigma = 10f64.powf(rng.random_range(-4.0..-1.3));
                target.iter_mut().flatten().for_each(|v| *v += sigma * normal(&mut rng));
            }
            Relation::Half => target.truncate(count.div_ceil(2)),
            _ => {}
        }
        let place = Rigid::from_translation(there) * motion;
        let target = if relation == Relation::Identical {
            source.clone()
        } else {
            target.iter().map(|p| place.apply(p.map(|v| v * scale))).collect()
        };

        let (mut source, mut target) = (PointCloud::from_points(source), PointCloud::from_points(target));
        let lost = rng.random_bool(0.03);
        if lost {
            let cloud = if rng.random_bool(0.5) { &mut source } else { &mut target };
            let odd = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX][rng.random_range(0..4)];
            if let Some(point) = cloud.points.first_mut() {
                point[rng.random_range(0..3)] = odd;
            }
        }
        let settings = Settings { method, refine, ..settings(scale, &truth, &mut rng) };
        for cloud in [&mut source, &mut target] {
            let odd = [f64::NAN, f64::INFINITY, f64::MAX, 0.0, 1e-3 * scale, 1e3 * scale];
            cloud.viewpoint = match rng.random_range(0..6) {
                0 => Some([0; 3].map(|_| scale * normal(&mut rng))),
                1 => Some([0; 3].map(|_| odd[rng.random_range(0..odd.len())])),
                2 => cloud.points.first().copied(),
                _ => None,
            };
        }
        let known = !lost && !matches!(relation, Relation::Other | Relation::Mirrored);
        let case = format!(
            "{seed}: {shape:?} {relation:?} of {count} points, scale {scale:e}, {method:?} {refine:?}"
        );
        Self {
            name: case,
            shape,
            source,
            target,
            truth: known.then_some(truth),
            same_samples: !matches!(relation, Relation::SameShape | Relation::Other),
            settings,
        }
    }

    /// What is wrong with the answer to it.
    fn mistakes(&self) -> Vec<Mistake> {
        let start = Instant::now();
        let answer = catch_unwind(AssertUnwindSafe(|| register(&self.source, &self.target, &self.settings)));
        let taken = start.elapsed();
        let broken = |what: &str| Mistake::Broken(format!("{}: {what}", self.name));
        let mut wrong = Vec::new();
        match &answer {
            Err(_) => wrong.push(broken("panic")),
            Ok(Err(_)) => {}
            Ok(Ok(found)) => {
                wrong.extend(inconsistencies(found).iter().map(|what| broken(what)));
                if found.probability > SURE && !self.is_right(found) {
                    wrong.push(self.sure(found));
                }
            }
        }
        if taken > LONGEST {
            wrong.push(broken(&format!("took {taken:?}")));
        }
        wrong
    }

    fn sure(&self, found: &Registration) -> Mistake {
        let Settings { voxel_size, locks, init, .. } = &self.settings;
        let what = format!(
            "{}: sure of a wrong pose, p = {:.3}; voxel size {:.1e}, chosen {}, first guess {}, locks {}, found by {:?}",
            self.name,
            found.probability,
            found.voxel_size,
            voxel_size.is_some(),
            init.is_some(),
            locks.any(),
            found.method
        );
        if self.shape.is_told_apart() { Mistake::Broken(what) } else { Mistake::Sure(what) }
    }

    /// Whether every source point comes to lie near where the truth has it, or, of the same samples, near some target point.
    fn is_right(&self, found: &Registration) -> bool {
        let T = &found.T_target_source;
        let middle = common::centroid(&self.source);
        let size = self.source.points.iter().map(|&p| (Vector3::from(p) - middle).norm()).fold(0.0, f64::max);
        let near = |a: [f64; 3], b: [f64; 3]| (Vector3::from(a) - Vector3::from(b)).norm() <= 0.1 * size;
        let mut points = self.source.points.iter().map(|&p| (p, T.apply(p)));
        self.truth.is_some_and(|truth| points.clone().all(|(p, moved)| near(moved, truth.apply(p))))
            || (self.same_samples
                && points.all(|(_, moved)| self.target.points.iter().any(|&q| near(moved, q))))
    }
}

fn settings(scale: f64, truth: &Rigid, rng: &mut ChaCha8Rng) -> Settings {
    let voxel_size = rng.random_bool(0.4).then(|| scale * 10f64.powf(rng.random_range(-4.0..1.5)));
    let init = match rng.random_range(0..4) {
        0 => Some(*truth),
        1 => {
            let mut far = rotation(rng);
            far.translation = Vector3::from_fn(|_, _| 3.0 * scale * normal(rng));
            Some(far)
        }
        _ => None,
    };
    let lock = {
        let any = rng.random_bool(0.4);
        move |rng: &mut ChaCha8Rng| any && rng.random_bool(0.4)
    };
    let locks =
        Locks { roll: lock(rng), pitch: lock(rng), yaw: lock(rng), x: lock(rng), y: lock(rng), z: lock(rng) };
    Settings {
        kernel: KERNELS[rng.random_range(0..KERNELS.len())],
        feature: FEATURES[rng.random_range(0..FEATURES.len())],
        overlap: rng.random_bool(0.3).then(|| rng.random_range(0.01..=1.0)),
        seed: rng.random(),
        voxel_size,
        init,
        locks,
        ..Settings::default()
    }
}

/// The seeds that `UPCR_DEGENERATE` tells.
fn wanted() -> Range<u64> {
    let Ok(told) = std::env::var("UPCR_DEGENERATE") else { return 0..FEW };
    match told.split_once("..") {
        Some((from, to)) => from.parse().unwrap()..to.parse().unwrap(),
        None => 0..told.parse().unwrap(),
    }
}

#[test]
fn answers_are_errors_or_honest() {
    let seeds = wanted();
    let pairs = seeds.end - seeds.start;
    let mistakes: Vec<Mistake> = seeds
        .into_par_iter()
        .flat_map_iter(|seed| METHODS.into_iter().flat_map(move |method| Case::new(seed, method).mistakes()))
        .collect();
    let (mut broken, mut sure) = (Vec::new(), Vec::new());
    for mistake in mistakes {
        match mistake {
            Mistake::Broken(what) => broken.push(what),
            Mistake::Sure(what) => sure.push(what),
        }
    }
    println!(
        "sure and wrong: {} of {pairs} pairs through {} methods\n{}",
        sure.len(),
        METHODS.len(),
        sure.join("\n")
    );
    assert!(broken.is_empty(), "{} mistakes\n{}", broken.len(), broken.join("\n"));
    assert!(sure.is_empty(), "{} sure and wrong\n{}", sure.len(), sure.join("\n"));
}
