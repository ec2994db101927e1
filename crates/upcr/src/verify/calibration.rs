//! The probability that a pose is right: logistic regressions over the evidence, in a file that can be read.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use serde::{Deserialize, Serialize};

use super::Evidence;
use crate::{Error, Result};

/// The default, fitted on training shapes and virtual scans.
const EMBEDDED: &str = include_str!("calibration.json");

/// What [`Evidence`] becomes before it is weighed, one number each.
pub const FEATURES: [&str; 20] = [
    "smaller_overlap",
    "closeness",
    "ln_residual_ratio",
    "near_misses",
    "facing",
    "ln_facing_ratio",
    "ln_in_free_space",
    "no_viewpoint",
    "margin",
    "glimpsed",
    "rivals",
    "agreement",
    "ln_explained_matches",
    "explained_share",
    "no_matches",
    "ln_inliers",
    "ln_points",
    "ln_conditioning",
    "has_free_direction",
    "not_converged",
];

/// Largest weight, in amount: sums of such stay finite.
const LARGEST: f64 = 1e6;

impl Evidence {
    /// The numbers that [`FEATURES`] names; ratios and counts as logarithms, all within bounds.
    pub fn features(&self) -> [f64; FEATURES.len()] {
        let [source, target] = self.overlap;
        let explained = self.matches.map_or(0.0, |[explained, _]| explained as f64);
        let share = self.matches.map_or(0.0, |[explained, of]| explained as f64 / of.max(1) as f64);
        let [facing, own_facing] = self.facing;
        [
            source.min(target),
            self.closeness,
            self.residual_ratio.max(f64::MIN_POSITIVE).ln().clamp(-3.0, 3.0),
            self.near_misses,
            facing,
            ((facing + 0.01) / (own_facing + 0.01)).ln(),
            (1.0 + self.in_free_space.unwrap_or(0.0) / 0.01).ln(),
            f64::from(self.in_free_space.is_none()),
            (1.0 - self.runner_up).clamp(0.0, 0.6),
            self.glimpsed.min(1.0),
            self.rivals.min(3) as f64,
            self.agreement,
            explained.ln_1p(),
            share,
            f64::from(self.matches.is_none()),
            (self.inliers as f64).ln_1p(),
            (self.points.max(1) as f64).ln(),
            self.conditioning.clamp(1e-5, 5e-3).ln(),
            f64::from(self.free_directions > 0),
            f64::from(!self.converged),
        ]
    }
}

/// What the evidence weighs, where points are samples as they were taken and where they are averages of many: the one
/// keeps clouds of one surface apart by their spacing, the other by noise alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// What counted as right where the weights were fitted, and on how much of what; for readers.
    pub about: String,
    /// Where points are samples.
    pub samples: Weights,
    /// Where they are averages.
    pub averages: Weights,
}

/// A logistic regression: the logit of the probability is the intercept plus the weighted sum of [`FEATURES`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Weights {
    /// The logit where all features are zero.
    pub intercept: f64,
    /// A weight for each of [`FEATURES`], by name.
    pub of: BTreeMap<String, f64>,
}

impl Weights {
    /// From an intercept and weights in the order of [`FEATURES`].
    pub fn new(intercept: f64, of: [f64; FEATURES.len()]) -> Self {
        Self { intercept, of: FEATURES.iter().map(|name| (*name).to_owned()).zip(of).collect() }
    }

    fn probability(&self, features: &[f64; FEATURES.len()]) -> f64 {
        let weight = |name: &str| self.of.get(name).copied().unwrap_or(0.0);
        let weighted: f64 = FEATURES.iter().zip(features).map(|(name, value)| weight(name) * value).sum();
        1.0 / (1.0 + (-self.intercept - weighted).exp())
    }

    fn check(&self) -> std::result::Result<(), String> {
        if self.of.len() != FEATURES.len() || !FEATURES.iter().all(|name| self.of.contains_key(*name)) {
            return Err(format!("its weights are not those of {}", FEATURES.join(", ")));
        }
        if !self.of.values().chain([&self.intercept]).all(|weight| weight.abs() <= LARGEST) {
            return Err(format!("a weight is not within ±{LARGEST}"));
        }
        Ok(())
    }
}

impl Calibration {
    /// The calibration in the library.
    ///
    /// # Errors
    /// Never, unless the library was built from a broken file.
    pub fn embedded() -> Result<Arc<Self>> {
        static PARSED: OnceLock<Option<Arc<Calibration>>> = OnceLock::new();
        let parsed = PARSED.get_or_init(|| Self::parse(EMBEDDED).ok().map(Arc::new));
        parsed.clone().ok_or_else(|| invalid("the one in the library cannot be read".into()))
    }

    /// The calibration in a file that `upcr calibrate` wrote.
    ///
    /// # Errors
    /// Where the file cannot be read or is no calibration.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
        Self::parse(&text).map_err(|reason| Error::Malformed {
            path: path.to_owned(),
            format: "calibration",
            reason,
        })
    }

    /// The probability that a pose is right of which this is known, 0 to 1.
    pub fn probability(&self, evidence: &Evidence) -> f64 {
        let weights = if evidence.samples { &self.samples } else { &self.averages };
        weights.probability(&evidence.features())
    }

    fn parse(text: &str) -> std::result::Result<Self, String> {
        let found: Self = serde_json::from_str(text).map_err(|error| error.to_string())?;
        found.check()?;
        Ok(found)
    }

    /// Refuses what lacks a weight or has none that can be computed with.
    pub(crate) fn check(&self) -> std::result::Result<(), String> {
        self.samples.check()?;
        self.averages.check()
    }
}

fn invalid(reason: String) -> Error {
    Error::InvalidSetting { name: "calibration", reason }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weighing(name: &str, weight: f64) -> Calibration {
        let of = FEATURES.map(|feature| if feature == name { weight } else { 0.0 });
        let weights = Weights::new(0.5, of);
        Calibration { about: "test".into(), averages: Weights::new(-0.5, of), samples: weights }
    }

    #[test]
    fn the_logit_is_the_intercept_and_what_is_weighed() {
        let calibration = weighing("agreement", 2.0);
        let evidence = Evidence { agreement: 0.25, ..Evidence::none(100) };
        let logistic = |logit: f64| 1.0 / (1.0 + (-logit).exp());
        assert_eq!(calibration.probability(&evidence), logistic(1.0));
        assert_eq!(calibration.probability(&Evidence { samples: false, ..evidence }), logistic(0.0));
    }

    #[test]
    fn features_stay_finite_whatever_the_evidence() {
        let wild = Evidence {
            residual_ratio: f64::INFINITY,
            runner_up: f64::INFINITY,
            glimpsed: f64::INFINITY,
            rivals: usize::MAX,
            inliers: usize::MAX,
            points: 0,
            matches: Some([0, 0]),
            ..Evidence::none(0)
        };
        for evidence in [wild, Evidence::none(usize::MAX), Evidence { residual_ratio: 0.0, ..wild }] {
            assert!(evidence.features().iter().all(|v| v.is_finite()), "{:?}", evidence.features());
        }
    }

    #[test]
    fn a_file_has_every_weight_and_no_other() {
        let whole = serde_json::to_string(&weighing("margin", 1.5)).unwrap();
        assert_eq!(Calibration::parse(&whole).unwrap(), weighing("margin", 1.5));
        let broken = [
            whole.replace("\"margin\"", "\"magic\""),
            whole.replace("\"margin\":1.5,", ""),
            whole.replace("1.5", "1e300"),
            whole.replace("\"about\"", "\"abort\""),
            whole[..whole.len() / 2].into(),
        ];
        for text in broken {
            assert!(Calibration::parse(&text).is_err(), "{text}");
        }
        assert!(Calibration::embedded().is_ok());
    }
}
