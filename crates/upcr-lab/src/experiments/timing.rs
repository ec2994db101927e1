//! What a pair's time is spent on: features and neighbours, the network, and the way from there to a pose.

use std::hint::black_box;
use std::time::Instant;

use burn::tensor::Device;
use rayon::join;
use upcr::cloud::Support;
use upcr::features::{DEFAULT_K, MatchedFeature, describe};
use upcr::net::Network;
use upcr::{PointCloud, Result, Settings};

use super::description::Values;
use super::plan::Test;
use crate::data::pairs::{Pair, Protocol};
use crate::eval::methods::EvaluatedMethod;
use crate::models::Learned;
use crate::random;

/// Pairs that are timed, after one that is not.
const REPEATS: usize = 15;

/// Medians over pairs of an object's points, in milliseconds. What is not told apart is left out.
pub(super) fn times(test: &Test) -> Result<Values> {
    let pairs = (0..=REPEATS as u64)
        .map(|seed| Protocol::CONSISTENT.keeping(test.points).pair(&object(seed, test.points), seed))
        .collect::<Result<Vec<_>>>()?;
    let settings = Settings::default();
    let mut parts: Vec<(&str, f64)> = Vec::new();
    match &test.weights {
        None => {
            let name = test.run.as_deref().unwrap_or_default();
            let method = EvaluatedMethod::by_name(name)?;
            let total = median(&pairs, |pair| method.estimate(&pair.source, &pair.target, &settings))?;
            let feature = match name {
                "fgr" => Some(MatchedFeature::Fpfh),
                "icp+spfh" => Some(MatchedFeature::Spfh),
                "icp+pfh" => Some(MatchedFeature::Pfh),
                _ => None,
            };
            let mut solve = total;
            if let Some(feature) = feature {
                let features = median(&pairs, |pair| {
                    let described = |cloud: &PointCloud| {
                        describe(cloud, feature.feature(), Support::Nearest(DEFAULT_K), None)
                    };
                    let (a, b) = join(|| described(&pair.source), || described(&pair.target));
                    Ok((a?, b?))
                })?;
                solve -= features;
                parts.push(("features_ms", features));
            }
            parts.extend([("solve_ms", solve), ("total_ms", total)]);
        }
        Some(weights) => {
            let network = weights.training.network.init(0, &Device::flex())?;
            if matches!(network, Learned::Upcr(_)) {
                let network = Network::from_safetensors(&network.store().to_bytes()?)?;
                let total =
                    median(&pairs, |pair| network.predict(&single(&pair.source), &single(&pair.target)))?;
                let features = median(&pairs, |pair| {
                    let [source, target] = [single(&pair.source), single(&pair.target)];
                    let (a, b) = join(|| network.features(&source), || network.features(&target));
                    Ok((a?, b?))
                })?;
                parts.extend([
                    ("features_ms", features),
                    ("network_ms", total - features),
                    ("total_ms", total),
                ]);
            } else {
                let total =
                    median(&pairs, |pair| network.predict(single(&pair.source), single(&pair.target)))?;
                let inside =
                    median(&pairs, |pair| network.embed(single(&pair.source), single(&pair.target)))?;
                parts.extend([("network_ms", inside), ("solve_ms", total - inside), ("total_ms", total)]);
            }
        }
    }
    Ok(parts.into_iter().map(|(name, ms)| (name.to_owned(), ms.max(0.0))).collect())
}

/// The median time of a pair, in milliseconds.
fn median<T>(pairs: &[Pair], work: impl Fn(&Pair) -> Result<T>) -> Result<f64> {
    let mut times_ms = Vec::with_capacity(pairs.len());
    for pair in pairs {
        let start = Instant::now();
        black_box(work(pair)?);
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times_ms.remove(0);
    times_ms.sort_by(f64::total_cmp);
    Ok(times_ms[times_ms.len() / 2])
}

fn single(cloud: &PointCloud) -> Vec<[f32; 3]> {
    cloud.points.iter().map(|p| p.map(|v| v as f32)).collect()
}

/// A bumpy ellipsoid: times depend little on what is seen.
fn object(seed: u64, points: usize) -> Vec<[f64; 3]> {
    let mut rng = random::stream(random::fnv1a("timed object"), seed);
    (0..points)
        .map(|_| {
            let d = random::direction(&mut rng);
            let bump = 1.0 + 0.3 * (5.0 * d.x + 2.0 * d.y).sin() * d.z.max(0.0);
            [d.x * bump, 0.7 * d.y * bump, 0.5 * d.z * bump]
        })
        .collect()
}
