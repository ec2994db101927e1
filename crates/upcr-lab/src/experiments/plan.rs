//! What an experiment takes: the networks that must have learned, and the tests. Whatever is the same has the same name,
//! in whichever experiment it stands, and is done once.

use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use super::budget::Budget;
use super::description::{Adapt, Experiment, Measure, Method, Part, Setting, refused};
use crate::data::pairs::Coverage;
use crate::models::LearnedConfig;
use crate::random;
use crate::train::TrainingConfig;

/// A network and all that it learns from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Weights {
    /// The network's name.
    pub network: String,
    /// The data set, by its name in the data folder.
    pub data: String,
    /// Shapes that it does not see.
    pub part: Part,
    /// What the pairs keep of their points.
    pub overlaps: Vec<Coverage>,
    /// How it learns.
    pub training: TrainingConfig,
    /// How it learns on.
    pub adaptation: Option<Adaptation>,
}

/// How a network learns on, without labels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Adaptation {
    /// The data set, by its name in the data folder.
    pub data: String,
    /// Which clouds of it.
    pub adapt: Adapt,
    /// The pairs it is tested on.
    pub setting: Setting,
    /// How many of them at most.
    pub pairs: Option<usize>,
    /// How it learns.
    pub training: TrainingConfig,
}

/// A method on the pairs of a setting.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Test {
    /// What is measured.
    pub measure: Measure,
    /// What is run, of `upcr eval`; a network alone where nothing is told.
    pub run: Option<String>,
    /// The network.
    pub weights: Option<Weights>,
    /// The data set, by its name in the data folder.
    pub data: String,
    /// The pairs; their names are not part of what they are.
    pub setting: Setting,
    /// Points of a whole cloud.
    pub points: usize,
    /// Pairs at most.
    pub pairs: Option<usize>,
}

/// A test and its place in a table.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// Name of the setting.
    pub setting: String,
    /// Name of the method.
    pub method: String,
    /// Seed of its network.
    pub seed: u64,
    /// What is done.
    pub test: Test,
}

impl fmt::Display for Weights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.training.network {
            LearnedConfig::Upcr(config) => write!(f, "upcr ({:?}, {:?})", config.invariant, config.rotation)?,
            _ => f.write_str(&self.network)?,
        }
        write!(f, ", seed {}", self.training.seed)
    }
}

impl Weights {
    /// A name of its own: the network's, and a number that tells everything else.
    pub fn id(&self) -> String {
        id(&self.network.replace('*', "-all"), self)
    }

    /// The same before it learned on.
    #[must_use]
    pub fn unadapted(&self) -> Self {
        Self { adaptation: None, ..self.clone() }
    }

    /// What is learned last.
    pub fn last(&self) -> &TrainingConfig {
        self.adaptation.as_ref().map_or(&self.training, |adaptation| &adaptation.training)
    }
}

impl Test {
    /// A name of its own.
    pub fn id(&self) -> String {
        id(self.run.as_deref().unwrap_or("network"), self)
    }
}

fn id(name: &str, what: &impl Serialize) -> String {
    // Numbers, names and tables of them all have a JSON form.
    let text = serde_json::to_string(what).unwrap_or_default();
    format!("{name}-{:016x}", random::fnv1a(&text))
}

impl Experiment {
    /// The experiment's tests on what is in the data folder; none where its data are not there.
    ///
    /// # Errors
    /// Where the budget has no training of a network, or a method none of its settings.
    pub fn plan(&self, budget: &Budget, root: &Path) -> Result<Option<Vec<Cell>>> {
        let there = |names: &[String]| names.iter().find(|name| root.join(name).exists()).cloned();
        let Some(data) = there(&self.data).or((self.measure == Measure::Time).then(String::new)) else {
            return Ok(None);
        };
        let learn_from =
            if self.learn_from.is_empty() { Some(data.clone()) } else { there(&self.learn_from) };
        let mut cells = Vec::new();
        for method in &self.methods {
            for setting in self.settings.iter().filter(|setting| method.is_tested_in(setting)) {
                let seeds = if method.network.is_some() { self.seeds } else { 1 };
                for seed in 0..seeds {
                    let weights = match (&method.network, &learn_from) {
                        (Some(network), Some(learn_from)) => {
                            let weights =
                                self.weights(method, network, setting, budget, [&data, learn_from], seed);
                            Some(weights.map_err(|e| refused(format!("{}: {e}", method.name)))?)
                        }
                        (Some(_), None) => continue,
                        (None, _) => None,
                    };
                    let test = Test {
                        measure: self.measure,
                        run: method.run.clone(),
                        weights,
                        data: data.clone(),
                        setting: setting.unnamed(),
                        points: if self.measure == Measure::Time {
                            crate::data::pairs::POINTS
                        } else {
                            budget.points
                        },
                        pairs: budget.pairs,
                    };
                    let (setting, method) = (setting.name.clone(), method.name.clone());
                    cells.push(Cell { setting, method, seed, test });
                }
            }
        }
        Ok(Some(cells))
    }

    fn weights(
        &self,
        method: &Method,
        network: &str,
        setting: &Setting,
        budget: &Budget,
        [data, learn_from]: [&String; 2],
        seed: u64,
    ) -> Result<Weights> {
        let training = match self.measure {
            Measure::Errors => {
                let points = self.learned_points(budget.points);
                budget.training(network, points, &method.changes, seed)?
            }
            // Times are those of the paper's networks, which need not have learned anything.
            Measure::Time => {
                let network = LearnedConfig::by_name(network)?;
                let paper = TrainingConfig { network, ..TrainingConfig::default() };
                method.changes.iter().try_fold(paper, |training, change| training.with(change))?
            }
        };
        // What is seen of frames is learned as from shapes.
        let tested = match setting.frames_apart {
            Some(_) => self.settings.iter().find(|setting| setting.frames_apart.is_none()),
            None => Some(setting),
        };
        let adaptation = match (method.adapt, tested) {
            (Adapt::Not, _) => None,
            (_, Some(tested)) if !tested.adapts => None,
            (adapt, Some(tested)) => Some(Adaptation {
                data: data.clone(),
                adapt,
                setting: tested.unnamed(),
                pairs: budget.pairs,
                training: budget.adaptation(
                    training.network.clone(),
                    tested.protocol(budget.points).kept(),
                    seed,
                ),
            }),
            (_, None) => {
                let reason = format!("{}: no setting has shapes to learn on from", method.name);
                return Err(Error::InvalidSetting { name: "experiment", reason });
            }
        };
        Ok(Weights {
            network: network.into(),
            data: learn_from.clone(),
            part: setting.shapes,
            overlaps: self.learn_overlaps.clone(),
            training,
            adaptation,
        })
    }
}

impl Setting {
    fn unnamed(&self) -> Self {
        Self { name: String::new(), adapts: true, ..self.clone() }
    }
}
