//! Pairs of every kind that a verdict has to tell apart: of one thing and of two, of much overlap and of none.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use rand::Rng;
use rand::seq::{IndexedRandom, SliceRandom};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use upcr::neighbors::KdTree;
use upcr::{Error, PointCloud, Result, Rigid, io};

use crate::data::scanner::{Optics, Scan, Scene, SynthSettings, synth};
use crate::data::seven_scenes::Frame;
use crate::data::{self, Shapes, Split, seven_scenes};
use crate::eval::metrics::{Tolerance, diameter};
use crate::random;

/// What two clouds have in common.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// The same points of one thing, moved.
    SameSamples,
    /// The same points, each cloud with noise of its own.
    Noisy,
    /// Other points of one thing, with noise.
    Resampled,
    /// Parts of one thing that share at least 30 % of the smaller one.
    Partial,
    /// Parts that share 5 to 30 %.
    LowOverlap,
    /// Parts of one thing or place that share less than 5 %.
    Disjoint,
    /// Two things of one category.
    SameCategory,
    /// Two things, or two places.
    Different,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::SameSamples,
        Self::Noisy,
        Self::Resampled,
        Self::Partial,
        Self::LowOverlap,
        Self::Disjoint,
        Self::SameCategory,
        Self::Different,
    ];

    /// What the pair of parts is called that share so much.
    fn of_overlap(overlap: f64) -> Self {
        match overlap {
            o if o >= 0.3 => Self::Partial,
            o if o >= 0.05 => Self::LowOverlap,
            _ => Self::Disjoint,
        }
    }
}

/// A pair of clouds, and how it is to be judged.
#[derive(Debug, Clone)]
pub struct Case {
    /// What they have in common.
    pub kind: Kind,
    /// The cloud that is moved.
    pub source: PointCloud,
    /// The cloud that stays.
    pub target: PointCloud,
    /// The true motion; `None` where there is none.
    pub T_target_source: Option<Rigid>,
    /// How far off a pose may be that counts as right; the translation is that of the source's centroid.
    pub tolerance: Tolerance,
}

impl Case {
    /// Whether `estimate` is right.
    pub fn is_right(&self, estimate: &Rigid) -> bool {
        let Some(truth) = &self.T_target_source else { return false };
        let weight = 1.0 / self.source.len().max(1) as f64;
        let centroid: Vector3<f64> = self.source.points.iter().map(|&p| Vector3::from(p) * weight).sum();
        let off =
            Vector3::from(estimate.apply(centroid.into())) - Vector3::from(truth.apply(centroid.into()));
        crate::eval::metrics::rotation_error_deg(estimate, truth) <= self.tolerance.rotation_deg
            && off.norm() <= self.tolerance.translation
    }
}

/// What pairs are made of.
pub enum Material {
    /// Samples of whole things, in the unit sphere.
    Shapes(Shapes),
    /// Depth images of a room.
    Frames(Vec<Frame>),
    /// Scans of things or places.
    Scenes(Vec<Place>),
}

/// Several scans of one thing or place.
#[derive(Debug, Clone)]
pub struct Place {
    /// Each with the pose of its frame in the world.
    pub scans: Vec<(PointCloud, Rigid)>,
    /// How far off a pose may be; `None`: as for objects.
    pub tolerance: Option<Tolerance>,
    /// Largest error of a range, as a share of it, that is alike in neighbouring directions: real sensors have it.
    pub warp: f64,
}

/// What a folder may hold that pairs can be made of, for messages.
const KNOWN: &str =
    "a data set of shapes, 7-Scenes frames, or scans beside their poses (NAME.ply, NAME.pose.txt)";

impl Material {
    /// What is at `path`: 7-Scenes frames, scans beside their poses, or a data set of shapes, of which `split` is taken.
    ///
    /// # Errors
    /// Where it is none of these, or cannot be read.
    pub fn open(path: &Path, split: Split) -> Result<Self> {
        if let Ok((frames, _)) = seven_scenes::frames(path, Split::All)
            && !frames.is_empty()
        {
            return Ok(Self::Frames(frames));
        }
        let posed = posed_files(path).unwrap_or_default();
        if !posed.is_empty() {
            let read = |(cloud, pose): &(_, _)| Ok((io::read_cloud(cloud)?, io::read_transform(pose)?));
            let scans = posed.iter().map(read).collect::<Result<_>>()?;
            return Ok(Self::Scenes(vec![Place { scans, tolerance: None, warp: 0.0 }]));
        }
        data::open(path, split).map(Self::Shapes).map_err(|error| match error {
            Error::Unsupported { path, .. } => {
                Error::Unsupported { path, reason: format!("this is not {KNOWN}") }
            }
            error => error,
        })
    }

    /// The pair `index` of the run `seed`: the same for the same arguments.
    ///
    /// # Errors
    /// Where a scan cannot be read.
    pub fn case(&self, seed: u64, index: u64) -> Result<Case> {
        let rng = &mut random::stream(seed, index);
        match self {
            Self::Shapes(shapes) => shape_case(shapes, kind_of_shapes(rng), rng),
            Self::Frames(frames) => frame_case(frames, rng),
            Self::Scenes(places) => place_case(places, rng),
        }
    }

    /// Scans of `count` made-up things and places.
    ///
    /// # Errors
    /// Where a scene cannot be scanned.
    pub fn virtual_scenes(seed: u64, count: u64) -> Result<Self> {
        let place = |index| virtual_place(&mut random::stream(seed, index));
        Ok(Self::Scenes((0..count).into_par_iter().map(place).collect::<Result<_>>()?))
    }

    /// The pair `index` of those that have nothing in common: two things of a data set of shapes, two parts of one
    /// place that share less than 5 %.
    ///
    /// # Errors
    /// As [`Self::case`], and where all that was drawn shares something.
    pub fn strangers(&self, seed: u64, index: u64) -> Result<Case> {
        const DRAWS: usize = 100;
        let rng = &mut random::stream(seed, index);
        for _ in 0..DRAWS {
            let case = match self {
                Self::Shapes(shapes) => shape_case(shapes, Kind::Different, rng)?,
                Self::Frames(frames) => {
                    let pair = two(frames, rng)?;
                    frame_pair(pair, rng)?
                }
                Self::Scenes(places) => place_case(places, rng)?,
            };
            if matches!(case.kind, Kind::Different | Kind::Disjoint) {
                return Ok(case);
            }
        }
        Err(invalid("all of it shares something"))
    }
}

/// Clouds, each with the file of its pose, by name.
fn posed_files(folder: &Path) -> std::io::Result<Vec<(PathBuf, PathBuf)>> {
    let mut found = Vec::new();
    for entry in folder.read_dir()? {
        let path = entry?.path();
        let pose = path.with_extension("pose.txt");
        if pose.is_file() && path != pose {
            found.push((path, pose));
        }
    }
    found.sort();
    Ok(found)
}

fn invalid(reason: &str) -> Error {
    Error::InvalidSetting { name: "data", reason: reason.into() }
}

fn two<'a, T>(of: &'a [T], rng: &mut impl Rng) -> Result<[&'a T; 2]> {
    if of.len() < 2 {
        return Err(invalid("two clouds are needed at least"));
    }
    let first = rng.random_range(0..of.len());
    let second = (first + rng.random_range(1..of.len())) % of.len();
    Ok([&of[first], &of[second]])
}

fn motion(rng: &mut impl Rng, reach: f64) -> Rigid {
    let translation = Vector3::from_fn(|_, _| rng.random_range(-0.5..0.5) * reach);
    Rigid { rotation: random::rotation(rng), translation }
}

fn moved(points: &[[f64; 3]], by: &Rigid) -> PointCloud {
    PointCloud::from_points(points.iter().map(|&p| by.apply(p)).collect())
}

/// At most `count` of the points, evenly spread.
fn thinned<T: Copy>(points: &[T], count: usize) -> Vec<T> {
    points.iter().step_by(points.len().div_ceil(count).max(1)).copied().collect()
}

/// How often which kind of pair is made of shapes, in hundredths. Parts that share nothing are rare: opposite parts of
/// a symmetric shape lie on each other as if they were one.
const SHARES: [(Kind, u32); 8] = [
    (Kind::SameSamples, 10),
    (Kind::Noisy, 15),
    (Kind::Resampled, 15),
    (Kind::Partial, 20),
    (Kind::LowOverlap, 5),
    (Kind::Disjoint, 5),
    (Kind::SameCategory, 15),
    (Kind::Different, 15),
];

fn kind_of_shapes(rng: &mut impl Rng) -> Kind {
    let mut drawn = rng.random_range(0..SHARES.iter().map(|(_, share)| share).sum());
    let taken = |(_, share): &&(Kind, u32)| {
        let taken = drawn < *share;
        drawn = drawn.wrapping_sub(*share);
        taken
    };
    SHARES.iter().find(taken).map_or(Kind::Noisy, |(kind, _)| *kind)
}

fn shape_case(shapes: &Shapes, kind: Kind, rng: &mut impl Rng) -> Result<Case> {
    let first = rng.random_range(0..shapes.len());
    let mut another = |of_its_category: bool| {
        let fits = |&i: &usize| i != first && (shapes.labels[i] == shapes.labels[first]) == of_its_category;
        let fitting: Vec<usize> = (0..shapes.len()).filter(fits).collect();
        fitting.choose(rng).copied()
    };
    let (second, kind) = match kind {
        Kind::SameCategory | Kind::Different => {
            // Where there is but one category, two of it are the most different things there are.
            let second = another(kind == Kind::SameCategory).map(|i| (i, kind));
            let second = second.or_else(|| another(kind == Kind::Different).map(|i| (i, Kind::Different)));
            second.ok_or_else(|| invalid("two shapes are needed at least"))?
        }
        _ => (first, kind),
    };
    let count = shapes.clouds[first].len().min(shapes.clouds[second].len()) / 2;
    let mut halves = |index: usize| {
        let mut points = shapes.points(index);
        points.shuffle(rng);
        let rest = points.split_off(count);
        (points, rest[..count].to_vec())
    };
    let (source, resampled) = halves(first);
    let target = match kind {
        Kind::SameSamples | Kind::Noisy => source.clone(),
        Kind::SameCategory | Kind::Different => halves(second).0,
        // The literature crops one and the same sample.
        Kind::Partial if rng.random_bool(0.5) => source.clone(),
        _ => resampled,
    };
    let (mut source, mut target) = (source, target);
    let parts = match kind {
        Kind::Partial => Some(rng.random_range(0.55..0.85)),
        Kind::LowOverlap => Some(rng.random_range(0.35..0.6)),
        Kind::Disjoint => Some(rng.random_range(0.3..0.5)),
        // Different things are seen in part as often as the same are.
        Kind::SameCategory | Kind::Different if rng.random_bool(0.3) => Some(rng.random_range(0.4..0.8)),
        _ => None,
    };
    if let Some(share) = parts {
        let direction = random::direction(rng);
        let mut second = random::direction(rng);
        if kind == Kind::Disjoint {
            second = -direction;
        } else if kind == Kind::LowOverlap {
            second = (second - direction).normalize();
        }
        crop(&mut source, &direction, share);
        crop(&mut target, &second, share);
    }
    let kind = match kind {
        Kind::Partial | Kind::LowOverlap | Kind::Disjoint => {
            Kind::of_overlap(overlap(&source, &target, 1.0 / (count as f64).sqrt() * 2.0))
        }
        kind => kind,
    };
    let sigma = match kind {
        Kind::SameSamples => 0.0,
        Kind::Noisy => rng.random_range(0.002..0.02),
        _ if rng.random_bool(0.5) => 0.0,
        _ => rng.random_range(0.0..0.02),
    };
    for coordinate in source.iter_mut().chain(&mut target).flatten() {
        *coordinate += sigma * random::normal(rng);
    }
    let tolerance = Tolerance::object(diameter(&source));
    let T_target_source = motion(rng, 1.0);
    target.shuffle(rng);
    Ok(Case {
        kind,
        source: PointCloud::from_points(source),
        target: moved(&target, &T_target_source),
        T_target_source: (!matches!(kind, Kind::SameCategory | Kind::Different)).then_some(T_target_source),
        tolerance,
    })
}

/// Keeps a share of the points, those farthest along `direction`.
fn crop(points: &mut Vec<[f64; 3]>, direction: &Vector3<f64>, share: f64) {
    let along = |p: &[f64; 3]| Vector3::from(*p).dot(direction);
    let kept = (share * points.len() as f64).round() as usize;
    points.sort_by(|a, b| along(b).total_cmp(&along(a)));
    points.truncate(kept);
}

/// Share of the smaller cloud's points that lie within `limit` of the other.
fn overlap(a: &[[f64; 3]], b: &[[f64; 3]], limit: f64) -> f64 {
    let single = |points: &[[f64; 3]]| points.iter().map(|p| p.map(|v| v as f32)).collect::<Vec<_>>();
    let (a, b) = (single(&thinned(a, 3000)), single(&thinned(b, 30_000)));
    let (tree_a, tree_b) = (KdTree::new(&a), KdTree::new(&b));
    let limit_sq = (limit * limit) as f32;
    let share = |points: &[[f32; 3]], tree: &KdTree| {
        points.iter().filter(|&&p| tree.nearest(p, limit_sq).is_some()).count() as f64
            / points.len().max(1) as f64
    };
    share(&a, &tree_b).max(share(&thinned(&b, 3000), &tree_a))
}

/// Two scans of one place, the source turned.
fn scan_case([source, target]: [PointCloud; 2], T: Rigid, tolerance: Tolerance, rng: &mut impl Rng) -> Case {
    let placed: Vec<_> = source.points.iter().map(|&p| T.apply(p)).collect();
    // Points of a scan are as far apart as their number on its surface makes them; three times that is near.
    let span = Vector3::from(sides(&target.points)).norm();
    let limit = 3.0 * span / (target.len() as f64).sqrt();
    let kind = Kind::of_overlap(overlap(&placed, &target.points, limit.max(0.01 * span)));
    let turn = Rigid { rotation: random::rotation(rng), translation: Vector3::zeros() };
    Case {
        kind,
        source: bare(source).transformed(&turn),
        target: bare(target),
        T_target_source: Some(T * turn.inverse()),
        tolerance,
    }
}

/// Points, and from where they were seen.
fn bare(cloud: PointCloud) -> PointCloud {
    PointCloud { viewpoint: cloud.viewpoint, ..PointCloud::from_points(cloud.points) }
}

/// Standard deviations along the axes, times the square root of twelve: the sides of a box so spread.
fn sides(points: &[[f64; 3]]) -> [f64; 3] {
    let n = points.len().max(1) as f64;
    std::array::from_fn(|k| {
        let mean = points.iter().map(|p| p[k]).sum::<f64>() / n;
        let variance = points.iter().map(|p| (p[k] - mean).powi(2)).sum::<f64>() / n;
        (12.0 * variance).sqrt()
    })
}

/// Frames that mostly see the same are fewer frames apart than this.
const NEAR_FRAMES: usize = 40;

/// Frames of one sequence, mostly near each other in time.
fn frame_case(frames: &[Frame], rng: &mut impl Rng) -> Result<Case> {
    let [a, b] = if frames.len() > 1 && rng.random_bool(0.7) {
        let gap = rng.random_range(1..NEAR_FRAMES.min(frames.len()));
        let first = rng.random_range(0..frames.len() - gap);
        [&frames[first], &frames[first + gap]]
    } else {
        two(frames, rng)?
    };
    let pair = if rng.random_bool(0.5) { [a, b] } else { [b, a] };
    frame_pair(pair, rng)
}

fn frame_pair([a, b]: [&Frame; 2], rng: &mut impl Rng) -> Result<Case> {
    let T = b.T_world_camera.inverse() * a.T_world_camera;
    let case = scan_case([a.cloud()?, b.cloud()?], T, Tolerance::INDOOR, rng);
    Ok(if a.scene == b.scene { case } else { Case { kind: Kind::Different, T_target_source: None, ..case } })
}

/// Two scans of one place; of several, every third pair shows two of them.
fn place_case(places: &[Place], rng: &mut impl Rng) -> Result<Case> {
    let place = &places[rng.random_range(0..places.len())];
    let [a, b] = two(&place.scans, rng)?;
    let tolerance =
        place.tolerance.unwrap_or_else(|| Tolerance::object(diameter(&thinned(&a.0.points, 1000))));
    let alike = |other: &&Place| other.tolerance == place.tolerance && !std::ptr::eq(*other, place);
    let others: Vec<&Place> = places.iter().filter(alike).collect();
    if !others.is_empty() && rng.random_bool(0.33) {
        let other = others[rng.random_range(0..others.len())];
        let second = &other.scans[rng.random_range(0..other.scans.len())];
        let clouds = worn(place, [&a.0, &second.0], rng);
        let case = scan_case(clouds, Rigid::identity(), tolerance, rng);
        return Ok(Case { kind: Kind::Different, T_target_source: None, ..case });
    }
    let T = b.1.inverse() * a.1;
    Ok(scan_case(worn(place, [&a.0, &b.0], rng), T, tolerance, rng))
}

/// The scans as a worn-out sensor gives them, and as programs pass them on: of some it is not said from where they were
/// seen, and of half the others not exactly.
fn worn(place: &Place, scans: [&PointCloud; 2], rng: &mut impl Rng) -> [PointCloud; 2] {
    const SAID: f64 = 0.6;
    const SAID_OF_ONE: f64 = 0.8;
    const OFF: f64 = 0.05;
    if place.warp == 0.0 {
        return scans.map(Clone::clone);
    }
    let said = rng.random_bool(SAID);
    let off = if rng.random_bool(0.5) { OFF } else { 0.0 };
    scans.map(|scan| {
        let cloud = warped(scan, place.warp, rng);
        let off = rng.random_range(0.0..=off) * diameter(&thinned(&scan.points, 1000));
        let off = random::direction(rng) * off;
        let viewpoint = cloud.viewpoint.filter(|_| said && rng.random_bool(SAID_OF_ONE));
        PointCloud { viewpoint: viewpoint.map(|v| (Vector3::from(v) + off).into()), ..cloud }
    })
}

/// The scan, about its sensor, with errors of its ranges that are alike in neighbouring directions.
fn warped(scan: &PointCloud, warp: f64, rng: &mut impl Rng) -> PointCloud {
    const WAVES: usize = 12;
    if warp == 0.0 {
        return scan.clone();
    }
    let amplitude = warp * rng.random_range(0.0..1.0) / (WAVES as f64).sqrt();
    // Wavelengths from a radian down to a fiftieth.
    let waves: Vec<(Vector3<f64>, f64)> = (0..WAVES)
        .map(|k| {
            let frequency = std::f64::consts::TAU * 50_f64.powf(k as f64 / (WAVES - 1) as f64);
            (random::direction(rng) * frequency, rng.random_range(0.0..std::f64::consts::TAU))
        })
        .collect();
    let point = |p: &[f64; 3]| {
        let p = Vector3::from(*p);
        let direction = p.normalize();
        let error: f64 = waves.iter().map(|(wave, phase)| (wave.dot(&direction) + phase).sin()).sum();
        (p * (1.0 + amplitude * error)).into()
    };
    PointCloud { points: scan.points.iter().map(point).collect(), ..scan.clone() }
}

/// A made-up scene, scanned from places that see more or less of the same.
fn virtual_place(rng: &mut impl Rng) -> Result<Place> {
    let scene = match rng.random_range(0..10) {
        0..2 => Scene::Object,
        2..6 => Scene::Room,
        6 => Scene::Street,
        7 => Scene::Terrain,
        _ => Scene::Building,
    };
    let (tolerance, warp) = match scene {
        Scene::Object | Scene::Mesh(_) => (None, 0.004),
        Scene::Room => (Some(Tolerance::INDOOR), 0.03),
        Scene::Building => (Some(Tolerance::INDOOR), 0.002),
        Scene::Street | Scene::Terrain => (Some(Tolerance::DRIVING), 0.002),
    };
    let mut settings = SynthSettings::new(scene);
    settings.seed = rng.random();
    // Of a building some rooms, of which most share nothing but the size of things.
    settings.scans = if settings.scene == Scene::Building { 16 } else { 6 };
    settings.overlap = rng.random_range(0.3..0.9);
    if let Optics::DepthCamera(camera) = &mut settings.sensor.optics {
        *camera = camera.resized(320, 240);
    }
    if let Scene::Room = settings.scene {
        // From a good sensor to a worn-out one of the first generation.
        settings.sensor.noise.quadratic_per_m = rng.random_range(0.0005..0.005);
        settings.sensor.range_m[1] = rng.random_range(3.5..8.0);
    }
    // Built-in scenes are of one size each; things in the world are not.
    let size: f64 = rng.random_range(0.7..1.4);
    let resized = |scan: Scan| {
        let pose = Rigid { translation: scan.T_world_sensor.translation * size, ..scan.T_world_sensor };
        (scan.cloud.scaled(size), pose)
    };
    let scans = synth(&settings)?.into_iter().map(resized).collect();
    Ok(Place { scans, tolerance, warp })
}
