//! What was measured, as tables.

use std::fmt::Write;

use serde::Serialize;
use upcr::TRUSTWORTHY;

use super::covariance::Coverage;
use super::free_axes::Named;
use super::reliability::{Counts, Reliability, SURE};

/// All that was measured of the verdicts.
#[derive(Debug, Clone, Serialize)]
pub struct Trust {
    /// Over every set of pairs, and over all together.
    pub reliability: Vec<(String, Reliability)>,
    /// Over clouds that have nothing to do with each other, by set.
    pub strangers: Vec<(String, Counts)>,
    /// Of the covariance, over all noisy pairs and by kind; empty where it was not measured.
    pub covariance: Vec<Coverage>,
    /// Of the free directions, by shape; empty where it was not measured.
    pub free_axes: Vec<Named>,
}

/// A choice as it is written in a table.
fn word(choice: &impl Serialize) -> String {
    let value = serde_json::to_value(choice).ok();
    value.as_ref().and_then(|value| value.as_str()).unwrap_or("all").replace('_', " ")
}

/// A number where there is one.
fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".into(), |v| format!("{v:.digits$}"))
}

/// The tables, in Markdown.
pub fn markdown(trust: &Trust) -> String {
    let mut text = String::from("## Probability\n\n");
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "| pairs of | pairs | right | calibration error | area under ROC | right, p < {TRUSTWORTHY} | wrong, p ≥ {TRUSTWORTHY} | wrong, p ≥ {SURE} |\n\
         |---|---:|---:|---:|---:|---:|---:|---:|"
    );
    for (name, found) in &trust.reliability {
        let Counts { pairs, right, right_refused, wrong_trusted, wrong_sure } = found.counts;
        let (error, area) = (found.expected_calibration_error, number(found.area_under_roc, 4));
        let _ = writeln!(
            text,
            "| {name} | {pairs} | {right} | {error:.4} | {area} | {right_refused} | {wrong_trusted} | {wrong_sure} |"
        );
    }
    text.push_str("\n## By kind of pair\n\n");
    let _ = writeln!(
        text,
        "| pairs of | kind | pairs | right | right, p < {TRUSTWORTHY} | wrong, p ≥ {TRUSTWORTHY} | wrong, p ≥ {SURE} |\n\
         |---|---|---:|---:|---:|---:|---:|"
    );
    for (name, found) in &trust.reliability {
        for (kind, counts) in &found.by_kind {
            let kind = word(kind);
            let Counts { pairs, right, right_refused, wrong_trusted, wrong_sure } = counts;
            let _ = writeln!(
                text,
                "| {name} | {kind} | {pairs} | {right} | {right_refused} | {wrong_trusted} | {wrong_sure} |"
            );
        }
    }
    if !trust.strangers.is_empty() {
        text.push_str("\n## Clouds that have nothing in common\n\n");
        let _ = writeln!(
            text,
            "| pairs of | pairs | called registered (p ≥ {TRUSTWORTHY}) | p ≥ {SURE} |\n|---|---:|---:|---:|"
        );
        for (name, counts) in &trust.strangers {
            let _ = writeln!(
                text,
                "| {name} | {} | {} | {} |",
                counts.pairs, counts.wrong_trusted, counts.wrong_sure
            );
        }
    }
    if !trust.covariance.is_empty() {
        text.push_str(
            "\n## Covariance\n\n| pairs | number | right | true pose in the 95 % ellipsoid | share | mean NEES (6 is ideal) |\n\
             |---|---:|---:|---:|---:|---:|\n",
        );
        for Coverage { kind, pairs, right, covered, share, mean_nees } in &trust.covariance {
            let (share, nees) = (number(share.map(|s| 100.0 * s), 1), number(*mean_nees, 2));
            let _ = writeln!(text, "| {} | {pairs} | {right} | {covered} | {share} % | {nees} |", word(kind));
        }
    }
    if !trust.free_axes.is_empty() {
        text.push_str(
            "\n## Free directions\n\n| shape | pairs | named, and nothing else |\n|---|---:|---:|\n",
        );
        for Named { shape, pairs, named } in &trust.free_axes {
            let _ = writeln!(text, "| {} | {pairs} | {named} |", word(shape));
        }
    }
    text
}
