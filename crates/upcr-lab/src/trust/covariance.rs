//! Whether the true pose lies where the covariance says: coverage of its 95 % ellipsoid over noisy pairs.

use nalgebra::{Matrix6, Vector6};
use rand::Rng;
use rayon::prelude::*;
use serde::Serialize;
use upcr::{CloudRole, Error, PointCloud, Registration, Result, Rigid, Settings, register};

use crate::data::Shapes;
use crate::data::pairs::{ClippedNoise, POINTS, Pair, Protocol};
use crate::data::scanner::{Optics, Scene, Sensor, SynthSettings, synth};
use crate::eval::metrics::Tolerance;
use crate::random;

/// 95 % of χ² of six degrees of freedom.
const CHI_SQUARE_95: f64 = 12.592;

/// Kinds of noisy pairs, by how they come about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NoisyPair {
    /// Both clouds are the same samples of a shape, with noise of their own (σ 0.01 of the radius).
    SameSamples,
    /// Each cloud has its own samples, and noise of σ 0.005 to 0.02.
    OtherSamples,
    /// As above, and of each cloud only three quarters are kept, seen from a direction of its own.
    Partial,
    /// Virtual scans of an object, sharing 50 to 90 %.
    Object,
    /// Of a room.
    Room,
    /// Of a street.
    Street,
}

/// Kinds in the order in which pairs take turns.
const TURNS: [NoisyPair; 10] = [
    NoisyPair::SameSamples,
    NoisyPair::OtherSamples,
    NoisyPair::Partial,
    NoisyPair::Object,
    NoisyPair::Room,
    NoisyPair::SameSamples,
    NoisyPair::OtherSamples,
    NoisyPair::Partial,
    NoisyPair::Object,
    NoisyPair::Street,
];

/// Coverage over the noisy pairs of one kind, or over all.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Coverage {
    /// The kind; none for all.
    pub kind: Option<NoisyPair>,
    /// Pairs made.
    pub pairs: usize,
    /// Of these, the ones with a pose within 5° and a tenth of the source's extent: the others are wrong, not uncertain.
    pub right: usize,
    /// Of these, the ones with the true pose in the 95 % ellipsoid.
    pub covered: usize,
    /// `covered / right`; none where no pose is right.
    pub share: Option<f64>,
    /// Mean over the right ones of ξᵀ C⁻¹ ξ (normalised estimation error squared); 6 where C is true.
    pub mean_nees: Option<f64>,
}

/// Registers `pairs` pairs of all kinds in fixed proportions; the first entry is over all of them.
///
/// # Errors
/// Where shapes have too few points, or as [`register`] says.
pub fn measure(shapes: &Shapes, pairs: usize, seed: u64, settings: &Settings) -> Result<Vec<Coverage>> {
    let outcome = |index: usize| -> Result<(NoisyPair, Option<f64>)> {
        let kind = TURNS[index % TURNS.len()];
        let pair = pair(kind, shapes, &mut random::stream(seed, index as u64))?;
        let found = register(&pair.source, &pair.target, settings)?;
        Ok((kind, nees_where_right(&pair, &found)?))
    };
    let outcomes = (0..pairs).into_par_iter().map(outcome).collect::<Result<Vec<_>>>()?;
    let kinds = [
        NoisyPair::SameSamples,
        NoisyPair::OtherSamples,
        NoisyPair::Partial,
        NoisyPair::Object,
        NoisyPair::Room,
        NoisyPair::Street,
    ];
    let of = |kind: Option<NoisyPair>| {
        let chosen = outcomes.iter().filter(|(k, _)| kind.is_none_or(|kind| kind == *k));
        Coverage::of(kind, &chosen.map(|(_, nees)| *nees).collect::<Vec<_>>())
    };
    Ok(std::iter::once(None).chain(kinds.map(Some)).map(of).collect())
}

impl Coverage {
    fn of(kind: Option<NoisyPair>, outcomes: &[Option<f64>]) -> Self {
        let right: Vec<f64> = outcomes.iter().copied().flatten().collect();
        let covered = right.iter().filter(|nees| **nees <= CHI_SQUARE_95).count();
        let share = |of: f64| (!right.is_empty()).then(|| of / right.len() as f64);
        Self {
            kind,
            pairs: outcomes.len(),
            right: right.len(),
            covered,
            share: share(covered as f64),
            mean_nees: share(right.iter().sum::<f64>()),
        }
    }
}

/// The error of the pose in terms of its covariance, ξᵀ C⁻¹ ξ; infinite where C has no inverse.
///
/// # Errors
/// Where the target has no extent.
pub fn nees(target: &PointCloud, truth: &Rigid, found: &Registration) -> Result<f64> {
    let no_extent = Error::TooFewPoints { role: CloudRole::Target, found: 0, needed: 1 };
    let center =
        Rigid::from_translation(target.checked_bounds(CloudRole::Target)?.ok_or(no_extent)?.center());
    let error: Vector6<f64> = (center.inverse() * *truth * found.T_target_source.inverse() * center).log();
    let covariance = Matrix6::from_fn(|r, c| found.covariance[r][c]);
    Ok(covariance.cholesky().map_or(f64::INFINITY, |c| error.dot(&c.solve(&error))))
}

fn nees_where_right(pair: &Pair, found: &Registration) -> Result<Option<f64>> {
    let Some(bounds) = pair.source.checked_bounds(CloudRole::Source)? else { return Ok(None) };
    // At the middle of the source, where its translation means something.
    let middle = Rigid::from_translation(bounds.center());
    let right = Tolerance::object(bounds.diagonal())
        .holds(&(found.T_target_source * middle), &(pair.T_target_source * middle));
    right.then(|| nees(&pair.target, &pair.T_target_source, found)).transpose()
}

/// A pair of some kind.
fn pair(kind: NoisyPair, shapes: &Shapes, rng: &mut impl Rng) -> Result<Pair> {
    let scene = match kind {
        NoisyPair::Object => Scene::Object,
        NoisyPair::Room => Scene::Room,
        NoisyPair::Street => Scene::Street,
        NoisyPair::SameSamples | NoisyPair::OtherSamples | NoisyPair::Partial => {
            let shape = shapes.points(rng.random_range(0..shapes.len()));
            return pair_of_shape(kind, &shape, rng);
        }
    };
    let mut settings = SynthSettings::new(scene);
    settings.sensor = coarser(settings.sensor);
    settings.overlap = rng.random_range(0.5..0.9);
    settings.turned = true;
    settings.seed = rng.random();
    let scans = synth(&settings)?;
    let [source, target] = [&scans[0], &scans[1]];
    Ok(Pair {
        T_target_source: target.T_world_sensor.inverse() * source.T_world_sensor,
        source: source.cloud.clone(),
        target: target.cloud.clone(),
    })
}

fn pair_of_shape(kind: NoisyPair, shape: &[[f64; 3]], rng: &mut impl Rng) -> Result<Pair> {
    // A half has to suffice for a cloud.
    let points = POINTS.min(shape.len() / 2);
    if kind == NoisyPair::SameSamples {
        return Protocol { points, ..Protocol::CONSISTENT.noisy() }.random_pair(shape, rng);
    }
    let noise = Some(ClippedNoise { sigma: rng.random_range(0.005..0.02), ..ClippedNoise::STANDARD });
    let whole_or_part =
        if kind == NoisyPair::Partial { Protocol::PARTIAL_INDEPENDENT } else { Protocol::CONSISTENT };
    let protocol = Protocol { points, noise, ..whole_or_part };
    // Two pairs of one motion, of either half of the samples: of the one the source is taken, of the other the target.
    let seed = rng.random();
    let of = |half: &[[f64; 3]]| protocol.random_pair(half, &mut random::stream(seed, 0));
    let (one, other) = shape.split_at(shape.len() / 2);
    Ok(Pair { source: of(one)?.source, ..of(other)? })
}

/// The same sensor with fewer rays.
fn coarser(sensor: Sensor) -> Sensor {
    let optics = match sensor.optics {
        Optics::DepthCamera(camera) => {
            Optics::DepthCamera(camera.resized(camera.width / 2, camera.height / 2))
        }
        lidar @ Optics::Lidar(_) => lidar,
    };
    Sensor { optics, ..sensor }
}
