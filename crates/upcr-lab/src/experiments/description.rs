//! What an experiment is: data, pairs, methods and the paper's figures, as a TOML file has them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use crate::data::pairs::{Coverage, MotionLaw, Protocol};

/// Measured values by the names of their measures.
pub type Values = BTreeMap<String, f64>;

/// A table of the paper, or one of its figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// What it shows.
    pub title: String,
    /// Where the paper has it.
    pub paper: String,
    /// What a reader should know of it.
    #[serde(default)]
    pub note: String,
    /// Data sets to test on, by their names in the data folder; the first that is there is taken.
    #[serde(default)]
    pub data: Vec<String>,
    /// Data sets to learn from, where these are others.
    #[serde(default)]
    pub learn_from: Vec<String>,
    /// What pairs to learn from keep of their points.
    #[serde(default = "whole")]
    pub learn_overlaps: Vec<Coverage>,
    /// Runs from different seeds; tables have their mean and standard deviation.
    #[serde(default = "one")]
    pub seeds: u64,
    /// What is measured.
    #[serde(default)]
    pub measure: Measure,
    /// Columns of the table.
    pub columns: Vec<String>,
    /// The picture.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plot: Option<Plot>,
    /// On which pairs.
    #[serde(rename = "setting")]
    pub settings: Vec<Setting>,
    /// What is compared.
    #[serde(rename = "method")]
    pub methods: Vec<Method>,
}

/// What an experiment measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// How far poses are from the true ones.
    #[default]
    Errors,
    /// How long a pair takes and with what; networks have their papers' widths, whatever the budget.
    Time,
}

/// Pairs to test on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setting {
    /// As tables name it.
    pub name: String,
    /// Which shapes, and so which ones networks learn from.
    #[serde(default)]
    pub shapes: Part,
    /// What clouds keep of their points.
    #[serde(default)]
    pub overlap: Coverage,
    /// Whether there is noise on every point.
    #[serde(default)]
    pub noise: bool,
    /// Share of each cloud's points that are replaced by outliers.
    #[serde(default)]
    pub outliers: f64,
    /// How targets are moved.
    #[serde(default)]
    pub motion: MotionLaw,
    /// In place of shapes, pairs of a scene's frames so far apart, in metres and with their true motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames_apart: Option<u64>,
    /// Whether networks that adapt do so to these pairs.
    #[serde(default = "yes")]
    pub adapts: bool,
}

/// Which shapes are tested on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// The test split: networks learn from the training split.
    #[default]
    UnseenClouds,
    /// The second half of the categories: networks learn from the first.
    UnseenCategories,
}

/// What is compared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Method {
    /// As tables name it.
    pub name: String,
    /// One of `upcr eval`; a network alone where none is told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<String>,
    /// The network that is trained for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<String>,
    /// Settings of its training that are changed, as in `upcr train --set`.
    #[serde(default)]
    pub changes: Vec<String>,
    /// Whether the network learns on, without labels, before it is tested.
    #[serde(default)]
    pub adapt: Adapt,
    /// Settings that it is tested in; all where none are told.
    #[serde(default)]
    pub settings: Vec<String>,
    /// The paper's figures by setting.
    #[serde(default)]
    pub paper: BTreeMap<String, Values>,
}

/// What a learned network learns on from, without labels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Adapt {
    /// Nothing.
    #[default]
    Not,
    /// The very pairs that are tested on, whose poses it is not told.
    Tested,
    /// The training split of the data that is tested on, in new pairs all the time.
    Others,
}

/// A picture of an experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plot {
    /// Its form.
    pub kind: PlotKind,
    /// What it shows.
    pub measure: String,
    /// Settings to show; all where none are told.
    #[serde(default)]
    pub settings: Vec<String>,
}

/// The form of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlotKind {
    /// A row for each method, a mark for each setting.
    Dots,
    /// A line for each method over the settings' shares of outliers.
    Lines,
}

fn whole() -> Vec<Coverage> {
    vec![Coverage::Full]
}

fn one() -> u64 {
    1
}

fn yes() -> bool {
    true
}

impl Experiment {
    /// Reads the file form.
    ///
    /// # Errors
    /// Where the text is no experiment, or one that cannot be run.
    pub fn from_toml(text: &str) -> Result<Self> {
        let experiment: Self = toml::from_str(text).map_err(|e| refused(e.to_string()))?;
        experiment.check()?;
        Ok(experiment)
    }

    fn check(&self) -> Result<()> {
        let names: Vec<&str> = self.settings.iter().map(|setting| setting.name.as_str()).collect();
        if names.is_empty() || self.methods.is_empty() || self.seeds == 0 {
            return Err(refused("an experiment needs a setting, a method and a seed at least".into()));
        }
        let known = |name: &String| match names.contains(&name.as_str()) {
            true => Ok(()),
            false => Err(refused(format!("there is no setting {name}"))),
        };
        for method in &self.methods {
            method.settings.iter().chain(method.paper.keys()).try_for_each(known)?;
            if method.run.is_none() && method.network.is_none() {
                return Err(refused(format!("{} has neither a network nor what to run", method.name)));
            }
        }
        self.plot.iter().flat_map(|plot| &plot.settings).try_for_each(known)
    }

    /// Points of the clouds that are learned from, made of so many.
    pub fn learned_points(&self, points: usize) -> usize {
        let kept = |&coverage: &Coverage| Protocol { coverage, points, ..Protocol::CONSISTENT }.kept();
        self.learn_overlaps.iter().map(kept).min().unwrap_or(points)
    }
}

impl Setting {
    /// The pairs of shapes, made of so many points: as many as a whole cloud has.
    pub fn protocol(&self, points: usize) -> Protocol {
        let protocol = Protocol {
            points,
            motion: self.motion,
            coverage: self.overlap,
            outlier_ratio: self.outliers,
            noise: None,
        };
        if self.noise { protocol.noisy() } else { protocol }
    }
}

impl Method {
    /// Whether it is tested in that setting.
    pub fn is_tested_in(&self, setting: &Setting) -> bool {
        self.settings.is_empty() || self.settings.contains(&setting.name)
    }
}

pub(super) fn refused(reason: String) -> Error {
    Error::InvalidSetting { name: "experiment", reason }
}
