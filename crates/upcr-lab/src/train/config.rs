//! What a training run is told; its file form is TOML.

use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use crate::models::LearnedConfig;
use crate::random;

/// A training run. The default is the paper's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingConfig {
    /// Seed of the first weights and of all pairs.
    pub seed: u64,
    /// Stages, one after the other: fewer points first make the same network learn many times faster.
    pub stages: Vec<Stage>,
    /// Adam's step size at its largest.
    pub learning_rate: f64,
    /// How the step size changes over the run.
    pub decay: Decay,
    /// Steps at the start over which the step size grows from nothing.
    pub warmup_steps: u64,
    /// Shapes held out for validation: every so-many-th of the training split.
    pub validation_every_nth: usize,
    /// Steps between two validations.
    pub validation_steps: u64,
    /// Parts in which a batch is seen, each normalising itself; several machines can share them out. One is not told: runs
    /// are known by their configurations.
    #[serde(skip_serializing_if = "is_one")]
    pub parts: usize,
    /// Seconds between checkpoints.
    pub checkpoint_seconds: f64,
    /// The network.
    pub network: LearnedConfig,
}

/// A part of a run with clouds of one size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Points of a cloud.
    pub points: usize,
    /// Neighbours of a point; as many as the network's where none are told. With fewer points, fewer neighbours
    /// reach as far.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub k: Option<usize>,
    /// Pairs of a batch.
    pub batch: usize,
    /// How long it is.
    pub length: Length,
}

/// The length of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Length {
    /// Passes over the shapes.
    Epochs(u64),
    /// Steps, however many shapes there are.
    Steps(u64),
}

/// How the step size changes over a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decay {
    /// A tenth of itself after 30, 60 and 80 % of the steps.
    Steps,
    /// Half a cosine wave down to a hundredth.
    Cosine,
    /// None.
    Constant,
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            stages: vec![Stage { points: 1024, k: None, batch: 26, length: Length::Epochs(500) }],
            learning_rate: 1e-3,
            decay: Decay::Steps,
            warmup_steps: 0,
            validation_every_nth: 20,
            validation_steps: 1000,
            parts: 1,
            checkpoint_seconds: 60.0,
            network: LearnedConfig::default(),
        }
    }
}

impl TrainingConfig {
    /// A useful model in minutes of two cores: a quarter of the width, and few points but at the end.
    pub fn quick() -> Self {
        Self {
            stages: vec![
                Stage { points: 256, k: Some(8), batch: 26, length: Length::Steps(6000) },
                Stage { points: 512, k: Some(14), batch: 26, length: Length::Steps(300) },
                Stage { points: 1024, k: None, batch: 26, length: Length::Steps(150) },
            ],
            learning_rate: 2e-3,
            decay: Decay::Cosine,
            warmup_steps: 200,
            validation_steps: 1000,
            network: LearnedConfig::default().narrow(),
            ..Self::default()
        }
    }

    /// Reads the file form.
    ///
    /// # Errors
    /// Where the text is no configuration, or one that cannot be run.
    pub fn from_toml(text: &str) -> Result<Self> {
        let config: Self = toml::from_str(text)
            .map_err(|e| Error::InvalidSetting { name: "config", reason: e.to_string() })?;
        config.check()?;
        Ok(config)
    }

    /// The same with one setting changed: `KEY=VALUE` as in the file form, dots between a table and its keys; a word
    /// needs no quotes.
    ///
    /// # Errors
    /// Where there is no such setting, or the configuration cannot be run.
    pub fn with(&self, change: &str) -> Result<Self> {
        let refused = |reason: String| Error::InvalidSetting { name: "config", reason };
        let (key, value) = change.split_once('=').ok_or_else(|| refused("KEY=VALUE is wanted".into()))?;
        let changed = toml::from_str::<toml::Table>(change)
            .or_else(|_| toml::from_str(&format!("{key} = {:?}", value.trim())))
            .map_err(|e| refused(e.to_string()))?;
        let mut table: toml::Table = toml::from_str(&self.to_toml()).map_err(|e| refused(e.to_string()))?;
        merge(&mut table, changed);
        Self::from_toml(&toml::to_string(&table).unwrap_or_default())
    }

    /// The file form.
    pub fn to_toml(&self) -> String {
        // Numbers, names and tables of them all have a file form.
        toml::to_string_pretty(self).unwrap_or_default()
    }

    /// Refuses what cannot be run.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        let refused = |name, reason: &str| Err(Error::InvalidSetting { name, reason: reason.into() });
        self.network.check()?;
        if self.stages.iter().any(|s| s.points == 0 || s.batch == 0) || self.stages.is_empty() {
            return refused("stages", "there must be one at least, each with points and a batch");
        }
        if self.parts == 0 || self.stages.iter().any(|stage| stage.batch < self.parts) {
            return refused("parts", "there must be one at least, and no more than pairs of a batch");
        }
        if !(self.learning_rate > 0.0 && self.learning_rate.is_finite()) {
            return refused("learning_rate", "must be positive and finite");
        }
        if self.validation_every_nth < 2 {
            return refused(
                "validation_every_nth",
                "must be 2 at least: something must be left to learn from",
            );
        }
        Ok(())
    }

    /// The step size at a step of so many.
    pub fn step_size(&self, step: u64, steps: u64) -> f64 {
        let done = step as f64 / steps.max(1) as f64;
        let decay = match self.decay {
            Decay::Steps => [0.3, 0.6, 0.8].iter().filter(|&&at| done >= at).fold(1.0, |d, _| d * 0.1),
            Decay::Cosine => 0.01 + 0.99 * 0.5 * (1.0 + (std::f64::consts::PI * done).cos()),
            Decay::Constant => 1.0,
        };
        let warm = ((step + 1) as f64 / self.warmup_steps.max(1) as f64).min(1.0);
        self.learning_rate * decay * warm
    }

    /// The seed of what is random in a part of something named so.
    pub(super) fn seed_of(&self, what: &str, part: usize) -> u64 {
        let part = if self.parts == 1 { String::new() } else { format!(" part {part}") };
        random::fnv1a(&format!("{} {what}{part}", self.seed))
    }
}

#[allow(clippy::trivially_copy_pass_by_ref)] // serde hands references
fn is_one(parts: &usize) -> bool {
    *parts == 1
}

/// Puts the values of `changed` in the place of those of `table`, keeping the others.
fn merge(table: &mut toml::Table, changed: toml::Table) {
    for (key, value) in changed {
        match (table.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(changed)) => merge(inner, changed),
            (_, value) => drop(table.insert(key, value)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn upcr(config: &TrainingConfig) -> upcr::net::NetworkConfig {
        match &config.network {
            LearnedConfig::Upcr(network) => network.clone(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn every_network_comes_back_from_its_file_form() {
        for name in crate::models::learned::NETWORKS {
            let network = LearnedConfig::by_name(name).unwrap();
            for network in [network.narrow(), network] {
                let config = TrainingConfig { network, ..TrainingConfig::quick() };
                config.check().unwrap();
                assert_eq!(TrainingConfig::from_toml(&config.to_toml()).unwrap(), config, "{name}");
            }
        }
        assert!(LearnedConfig::by_name("dcp").is_err());
        let unknown = TrainingConfig::from_toml("[network]\nkind = \"pointnet\"").unwrap_err();
        assert!(unknown.to_string().contains("there are upcr, dcp"), "{unknown}");
    }

    #[test]
    fn presets_come_back_from_their_file_form() {
        for config in [TrainingConfig::default(), TrainingConfig::quick()] {
            config.check().unwrap();
            assert_eq!(TrainingConfig::from_toml(&config.to_toml()).unwrap(), config);
        }
    }

    #[test]
    fn what_cannot_be_run_is_refused() {
        for text in [
            "learning_rate = 0.0",
            "learnin_rate = 0.1",
            "stages = []",
            "stages = [{ points = 0, batch = 2, length = { steps = 3 } }]",
            "validation_every_nth = 1",
            "[network]\nwidths = []",
            "[network]\nk = 0",
            "[network]\ninvariant = \"colour\"",
        ] {
            assert!(TrainingConfig::from_toml(text).is_err(), "{text}");
        }
    }

    #[test]
    fn single_settings_change_and_the_others_stay() {
        let quick = TrainingConfig::quick();
        let whole = quick.with("network.invariant=none").unwrap();
        let (quick_network, whole_network) = (upcr(&quick), upcr(&whole));
        assert_eq!(whole_network.invariant, upcr::net::Invariant::None);
        assert_eq!((&whole.stages, &whole_network.widths), (&quick.stages, &quick_network.widths));
        assert_eq!(upcr(&quick.with("network.widths=[4, 8]").unwrap()).widths, [4, 8]);
        assert_eq!(quick.with("learning_rate = 0.5").unwrap().learning_rate, 0.5);
        let parts = quick.with("parts=4").unwrap();
        assert_eq!(TrainingConfig::from_toml(&parts.to_toml()).unwrap().parts, 4);
        for change in ["learning_rate", "learning_rate=fast", "learnin_rate=1.0", "network.k=0"] {
            assert!(quick.with(change).is_err(), "{change}");
        }
    }

    #[test]
    fn step_sizes_follow_their_decay() {
        let config =
            |decay, warmup_steps| TrainingConfig { decay, warmup_steps, ..TrainingConfig::default() };
        let steps = config(Decay::Steps, 0);
        let sizes = [0, 299, 300, 600, 999].map(|step| steps.step_size(step, 1000));
        for (found, expected) in sizes.into_iter().zip([1e-3, 1e-3, 1e-4, 1e-5, 1e-6]) {
            assert!((found / expected - 1.0).abs() < 1e-9, "{sizes:?}");
        }
        let cosine = config(Decay::Cosine, 10);
        assert!((cosine.step_size(0, 1000) - 1e-4).abs() < 1e-9);
        assert!((cosine.step_size(500, 1000) - 0.505e-3).abs() < 1e-9);
        assert!(cosine.step_size(999, 1000) < 1.01e-5);
    }
}
