//! What registration says of pairs whose truth is known.

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rayon::prelude::*;
use serde::Serialize;
use upcr::{Evidence, Method, Reason, Result, Rigid, Settings, register};

use super::cases::{Case, Kind};
use crate::random;

/// A pose that was found, and whether it is right.
#[derive(Debug, Clone, Serialize)]
pub struct Observed {
    /// What the clouds had in common.
    pub kind: Kind,
    /// Whether the pose lies within the pair's tolerance.
    pub right: bool,
    /// What the verdict said.
    pub probability: f64,
    /// What it was made of.
    pub evidence: Evidence,
    /// What it said against the pose.
    pub reasons: Vec<Reason>,
}

/// What most users ask with, and every eighth time each: with features alone, and from a guess near the truth where
/// there is one. The probability is to hold for all of them.
pub fn asked_in_all_ways(index: u64, case: &Case) -> Settings {
    let rng = &mut random::stream(random::fnv1a("asked in all ways"), index);
    match (index % 8, case.T_target_source) {
        (6, _) => Settings { method: Method::Features, ..Settings::default() },
        (7, truth) => {
            let near = Rigid {
                rotation: Rotation3::new(random::direction(rng) * rng.random_range(0.0..NEAR_RAD))
                    .into_inner(),
                translation: Vector3::zeros(),
            };
            let init = Some(truth.unwrap_or_else(Rigid::identity) * near);
            Settings { method: Method::Prior, init, ..Settings::default() }
        }
        _ => Settings::default(),
    }
}

/// Largest angle between a guess and the truth.
const NEAR_RAD: f64 = 0.35;

/// Registers `count` pairs. A pair that is refused counts as a wrong pose of probability 0 without evidence. `told`
/// is called after every pair.
///
/// # Errors
/// Where a pair cannot be had.
pub fn observe(
    count: u64,
    case: impl Fn(u64) -> Result<Case> + Sync,
    settings: impl Fn(u64, &Case) -> Settings + Sync,
    told: &(dyn Fn() + Sync),
) -> Result<Vec<Observed>> {
    let one = |index| {
        let case = case(index)?;
        let observed = match register(&case.source, &case.target, &settings(index, &case)) {
            Ok(found) => Observed {
                kind: case.kind,
                right: case.is_right(&found.T_target_source),
                probability: found.probability,
                evidence: found.evidence,
                reasons: found.reasons,
            },
            Err(_) => Observed {
                kind: case.kind,
                right: false,
                probability: 0.0,
                evidence: Evidence::none(case.source.len().min(case.target.len())),
                reasons: Vec::new(),
            },
        };
        told();
        Ok(observed)
    };
    (0..count).into_par_iter().map(one).collect()
}
