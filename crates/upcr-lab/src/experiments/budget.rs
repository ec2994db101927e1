//! How much an experiment may cost: sizes of clouds and networks, and how long these learn.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use upcr::Result;

use super::description::refused;
use crate::models::LearnedConfig;
use crate::train::{Decay, Length, Stage, TrainingConfig};

/// The budgets by their names, as `experiments/budgets.toml` has them.
const BUDGETS: &str = include_str!("../../../../experiments/budgets.toml");

/// What every experiment is given.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Budget {
    /// Points of a whole cloud, in learning and in tests; partial ones keep three quarters of them.
    pub points: usize,
    /// Neighbours of a point; each network's own number where none is told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub neighbors: Option<usize>,
    /// Whether networks have a quarter of their width.
    pub narrow: bool,
    /// Pairs of a batch.
    pub batch: usize,
    /// Pairs that a setting is tested on at most; all where none are told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pairs: Option<usize>,
    /// How the step size changes over a run.
    pub decay: Decay,
    /// Steps over which it grows at first.
    #[serde(default)]
    pub warmup_steps: u64,
    /// How networks learn, by name.
    pub training: BTreeMap<String, Learning>,
    /// How networks learn on without labels.
    pub adaptation: Learning,
}

/// A network's own share of a budget.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Learning {
    /// How long.
    pub length: Length,
    /// Adam's step size at its largest.
    pub learning_rate: f64,
    /// Pairs of a batch, in place of the budget's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub batch: Option<usize>,
}

impl Budget {
    /// The budget of that name.
    ///
    /// # Errors
    /// Where there is none.
    pub fn by_name(name: &str) -> Result<Self> {
        let mut budgets: BTreeMap<String, Self> =
            toml::from_str(BUDGETS).map_err(|e| refused(e.to_string()))?;
        budgets.remove(name).ok_or_else(|| {
            let known = budgets.keys().cloned().collect::<Vec<_>>().join(", ");
            refused(format!("there is no budget {name}; there are {known}"))
        })
    }

    /// Reads the file form of one budget.
    ///
    /// # Errors
    /// Where the text is none, or one that nothing can be done with.
    pub fn from_toml(text: &str) -> Result<Self> {
        let budget: Self = toml::from_str(text).map_err(|e| refused(e.to_string()))?;
        budget.check()?;
        Ok(budget)
    }

    /// Refuses what nothing can be done with.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        // So that three quarters of the points are a whole number of them, in learning as in tests.
        if self.points == 0 || !self.points.is_multiple_of(4) {
            return Err(refused("a budget's points must be 4 or a multiple of it".into()));
        }
        if self.pairs == Some(0) {
            return Err(refused("a budget must have a pair to test on at least".into()));
        }
        let learning = self.training.values().chain([&self.adaptation]);
        for Learning { length, learning_rate, batch } in learning {
            let positive = *learning_rate > 0.0 && learning_rate.is_finite();
            let nothing = matches!(length, Length::Steps(0) | Length::Epochs(0));
            if batch.unwrap_or(self.batch) == 0 || !positive || nothing {
                return Err(refused("lengths, batches and step sizes must be positive".into()));
            }
        }
        Ok(())
    }

    /// How the network of that name is trained on clouds of so many points, with changes as in `upcr train --set`.
    ///
    /// # Errors
    /// Where the budget has no such network, or a change cannot be made.
    pub fn training(
        &self,
        network: &str,
        points: usize,
        changes: &[String],
        seed: u64,
    ) -> Result<TrainingConfig> {
        let learning = self
            .training
            .get(network)
            .ok_or_else(|| refused(format!("the budget has no training of {network}")))?;
        let mut config = LearnedConfig::by_name(network)?;
        if self.narrow {
            config = config.narrow();
        }
        let mut training = self.learning(learning, config.with_neighbors(self.neighbors), points, seed);
        for change in changes {
            training = training.with(change)?;
        }
        Ok(training)
    }

    /// How a trained network learns on.
    pub fn adaptation(&self, network: LearnedConfig, points: usize, seed: u64) -> TrainingConfig {
        self.learning(&self.adaptation, network, points, seed)
    }

    fn learning(
        &self,
        learning: &Learning,
        network: LearnedConfig,
        points: usize,
        seed: u64,
    ) -> TrainingConfig {
        let batch = learning.batch.unwrap_or(self.batch);
        let stage = Stage { points, k: None, batch, length: learning.length };
        TrainingConfig {
            seed,
            stages: vec![stage],
            learning_rate: learning.learning_rate,
            decay: self.decay,
            warmup_steps: self.warmup_steps,
            network,
            ..TrainingConfig::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models::LearnedConfig;

    #[test]
    fn the_full_budget_is_the_papers() {
        let full = Budget::by_name("full").unwrap();
        let training = full.training("upcr", full.points, &[], 0).unwrap();
        assert_eq!(training, TrainingConfig::default());
        let adaptation = full.adaptation(LearnedConfig::default(), full.points, 0);
        assert_eq!((adaptation.learning_rate, adaptation.stages[0].length), (1e-4, Length::Epochs(200)));
    }

    #[test]
    fn unknown_names_are_refused() {
        assert!(Budget::by_name("endless").unwrap_err().to_string().contains("full, quick"));
        let quick = Budget::by_name("quick").unwrap();
        assert!(quick.training("icp", 64, &[], 0).is_err());
        assert!(quick.training("upcr", 64, &["network.k=none".into()], 0).is_err());
        for wrong in [
            Budget { points: 1025, ..quick.clone() },
            Budget { pairs: Some(0), ..quick.clone() },
            Budget { batch: 0, ..quick.clone() },
        ] {
            assert!(wrong.check().is_err());
        }
    }
}
