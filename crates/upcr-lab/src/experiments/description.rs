//! What an experiment is: data, pairs, methods and the paper's figures, as a TOML file has them.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use super::report::measures;
use crate::data::pairs::{Coverage, MotionLaw, Protocol};
use crate::eval::methods::EvaluatedMethod;
use crate::models::LearnedConfig;

/// Measured values by the names of their measures.
pub type Values = BTreeMap<String, f64>;

/// A table of the paper, or one of its figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// What it shows.
    pub title: String,
    /// Where the paper has it; nowhere where nothing is told.
    #[serde(default)]
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

    /// Refuses what would fail, or mislead, hours later.
    fn check(&self) -> Result<()> {
        let Self { settings, methods, columns, learn_overlaps, .. } = self;
        if settings.is_empty() || methods.is_empty() || columns.is_empty() || learn_overlaps.is_empty() {
            return Err(refused("an experiment needs a setting, a method, a column and an overlap".into()));
        }
        if self.seeds == 0 || (self.seeds > 1 && self.measure == Measure::Time) {
            return Err(refused("an experiment needs a seed, and of times no more than one".into()));
        }
        let names: Vec<&str> = settings.iter().map(|setting| setting.name.as_str()).collect();
        distinct("setting", names.iter().copied())?;
        distinct("method", methods.iter().map(|method| method.name.as_str()))?;
        let plotted = self.plot.iter().map(|plot| &plot.measure);
        let known: Vec<&str> = measures(self.measure).collect();
        if let Some(unknown) = columns.iter().chain(plotted).find(|name| !known.contains(&name.as_str())) {
            return Err(refused(format!("{unknown} is not measured; these are: {}", known.join(", "))));
        }
        if self.plot.as_ref().is_some_and(|plot| plot.kind == PlotKind::Lines)
            && !settings.windows(2).all(|pair| pair[0].outliers < pair[1].outliers)
        {
            return Err(refused("lines are drawn over settings with more and more outliers".into()));
        }
        if let Some(setting) = settings.iter().find(|setting| !(0.0..=1.0).contains(&setting.outliers)) {
            return Err(refused(format!("{}: outliers must be a share, 0 to 1", setting.name)));
        }
        let known = |name: &String| {
            if names.contains(&name.as_str()) {
                return Ok(());
            }
            Err(refused(format!("there is no setting {name}")))
        };
        for method in methods {
            method.check()?;
            method.settings.iter().chain(method.paper.keys()).try_for_each(known)?;
        }
        self.plot.iter().flat_map(|plot| &plot.settings).try_for_each(known)
    }

    /// Points of the clouds that are learned from, made of so many.
    pub fn learned_points(&self, points: usize) -> usize {
        let kept = |&coverage: &Coverage| Protocol { points, coverage, ..Protocol::CONSISTENT }.kept();
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
    fn check(&self) -> Result<()> {
        let refused = |reason: &str| Err(refused(format!("{}: {reason}", self.name)));
        if let Some(run) = &self.run {
            EvaluatedMethod::by_name(run)?;
        }
        if let Some(network) = &self.network {
            LearnedConfig::by_name(network)?;
        }
        let learns_alone = self.network.as_deref().is_some_and(|network| network == "upcr");
        match (&self.run, &self.network) {
            (None, None) => return refused("has neither a network nor what to run"),
            (Some(run), Some(_)) if run != "default" && !run.starts_with("upcr") => {
                return refused("what it runs looks at no network");
            }
            (Some(_), Some(_)) if !learns_alone => {
                return refused("only UPCR's network is run by other methods");
            }
            _ => {}
        }
        if self.adapt != Adapt::Not && !learns_alone {
            return refused("only UPCR's network learns without labels");
        }
        if self.paper.values().flat_map(Values::values).any(|value| !value.is_finite()) {
            return refused("the paper's figures must be finite");
        }
        Ok(())
    }

    /// Whether it is tested in that setting.
    pub fn is_tested_in(&self, setting: &Setting) -> bool {
        self.settings.is_empty() || self.settings.contains(&setting.name)
    }
}

fn distinct<'a>(what: &str, names: impl Iterator<Item = &'a str>) -> Result<()> {
    let mut seen = BTreeSet::new();
    for name in names {
        if !seen.insert(name) {
            return Err(refused(format!("there are two of the {what} {name}")));
        }
    }
    Ok(())
}

pub(super) fn refused(reason: String) -> Error {
    Error::InvalidSetting { name: "experiment", reason }
}
