//! What was measured, as tables.

use std::fmt::Write;

use serde::Serialize;
use upcr::TRUSTWORTHY;

use super::reliability::{Counts, Reliability, SURE};

/// All that was measured of the verdicts.
#[derive(Debug, Clone, Serialize)]
pub struct Trust {
    /// Over every set of pairs, and over all together.
    pub reliability: Vec<(String, Reliability)>,
    /// Over clouds that have nothing to do with each other, by set.
    pub strangers: Vec<(String, Counts)>,
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
        let (error, area) = (found.expected_calibration_error, found.area_under_roc);
        let _ = writeln!(
            text,
            "| {name} | {pairs} | {right} | {error:.4} | {area:.4} | {right_refused} | {wrong_trusted} | {wrong_sure} |"
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
            let kind = serde_json::to_value(kind).ok();
            let kind = kind.as_ref().and_then(|kind| kind.as_str()).unwrap_or_default().replace('_', " ");
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
    text
}
