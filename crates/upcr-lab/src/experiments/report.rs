//! Results as tables, Markdown for people and comma-separated values for programs.

use std::fmt::Write;

use super::description::{Adapt, Experiment, Measure, Part, PlotKind, Values};
use super::plan::{Adaptation, Weights};
use super::plot::picture;
use super::reproduce::{Lesson, Measured, Outcome, Results};
use crate::eval::run::overlap_name;
use crate::train::ValidationErrors;

/// A measure: its name, how tables head it, and digits after the point.
struct Column {
    name: &'static str,
    heading: &'static str,
    digits: usize,
}

/// Every measure that tables and pictures know.
static COLUMNS: [Column; 14] = [
    Column { name: "rmse_r_deg", heading: "RMSE(R) °", digits: 3 },
    Column { name: "mae_r_deg", heading: "MAE(R) °", digits: 3 },
    Column { name: "rmse_t", heading: "RMSE(t)", digits: 5 },
    Column { name: "mae_t", heading: "MAE(t)", digits: 5 },
    Column { name: "rre_mean_deg", heading: "RRE °", digits: 3 },
    Column { name: "rte_mean", heading: "RTE", digits: 5 },
    Column { name: "me_bregier", heading: "ME(T)", digits: 4 },
    Column { name: "recall", heading: "recall", digits: 3 },
    Column { name: "found", heading: "found", digits: 0 },
    Column { name: "ms_median", heading: "median, ms", digits: 2 },
    Column { name: "features_ms", heading: "features, ms", digits: 2 },
    Column { name: "network_ms", heading: "network, ms", digits: 2 },
    Column { name: "solve_ms", heading: "solve, ms", digits: 2 },
    Column { name: "total_ms", heading: "all, ms", digits: 2 },
];

/// How a measure is called.
pub(super) fn heading(measure: &str) -> &str {
    COLUMNS.iter().find(|column| column.name == measure).map_or(measure, |column| column.heading)
}

/// The measures that an experiment may ask for.
pub(super) fn measures(of: Measure) -> impl Iterator<Item = &'static str> {
    let names = COLUMNS.iter().map(|column| column.name);
    names.filter(move |name| name.ends_with("_ms") == (of == Measure::Time))
}

fn digits(measure: &str) -> usize {
    COLUMNS.iter().find(|column| column.name == measure).map_or(3, |column| column.digits)
}

/// Mean and standard deviation over seeds; no deviation of a single one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Spread {
    pub mean: f64,
    pub deviation: Option<f64>,
}

impl Outcome {
    /// A measure of a method in a setting, over its seeds; `None` where it was not taken.
    pub(super) fn spread(&self, setting: &str, method: &str, measure: &str) -> Option<Spread> {
        let values: Vec<f64> =
            self.of(setting, method).filter_map(|cell| cell.values.get(measure).copied()).collect();
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (count - 1.0);
        let deviation = (values.len() > 1).then(|| variance.sqrt());
        (!values.is_empty()).then_some(Spread { mean, deviation })
    }

    fn of<'a>(&'a self, setting: &'a str, method: &'a str) -> impl Iterator<Item = &'a Measured> {
        self.cells.iter().filter(move |cell| cell.setting == setting && cell.method == method)
    }
}

/// Everything as one Markdown text. `command` is what gave it.
pub fn markdown(results: &Results, command: &str) -> String {
    let mut text = String::new();
    let budget = toml::to_string(&results.budget).unwrap_or_default();
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "`{command}`, upcr {}, {} threads. Budget `{}`:\n\n```toml\n{}```\n",
        results.version, results.threads, results.budget_name, budget
    );
    if !results.finished {
        text.push_str("**Not finished**: what is missing below has not been measured yet.\n\n");
    }
    for outcome in &results.experiments {
        text.push_str(&section(outcome));
    }
    text.push_str(&lessons(&results.learned, results.budget.points));
    text
}

/// An experiment's heading, picture and tables.
fn section(outcome: &Outcome) -> String {
    let Experiment { title, paper, note, .. } = &outcome.experiment;
    let paper = if paper.is_empty() { String::new() } else { format!("The paper's {paper}; ") };
    let mut text = format!("## {title}\n\n{paper}`upcr reproduce {}`.", outcome.name);
    let Some(data) = &outcome.data else {
        let names = outcome.experiment.data.join(", ");
        let _ = writeln!(text, " Not done: none of the data sets is there ({names}).\n");
        return text;
    };
    if outcome.experiment.measure == Measure::Errors {
        let _ = write!(text, " Data: `{data}`");
        if let Some(other) = outcome.learned_from.as_ref().filter(|other| *other != data) {
            let _ = write!(text, ", learned from `{other}`");
        }
        text.push('.');
    }
    let _ = writeln!(text, " {note}\n");
    let missing: Vec<&str> = (outcome.experiment.methods.iter())
        .filter(|method| outcome.cells.iter().all(|cell| cell.method != method.name))
        .map(|method| method.name.as_str())
        .collect();
    if !missing.is_empty() {
        let names = outcome.experiment.learn_from.join(", ");
        let _ =
            writeln!(text, "Not done, for want of data to learn from ({names}): {}.\n", missing.join(", "));
    }
    if picture(outcome).is_some() {
        let _ = writeln!(text, "![{title}]({}.svg)\n", outcome.name);
    }
    let lines = outcome.experiment.plot.as_ref().is_some_and(|plot| plot.kind == PlotKind::Lines);
    for (index, table) in tables(outcome, lines).into_iter().enumerate() {
        if index > 0 {
            text.push('\n');
        }
        text.push_str(&table);
    }
    text.push('\n');
    text
}

/// A row of a table: its name, and its cells.
type Line = (String, Vec<String>);

/// A table for each setting; where settings are steps of one thing, a table for each measure.
fn tables(outcome: &Outcome, steps: bool) -> Vec<String> {
    let Experiment { settings, methods, columns, .. } = &outcome.experiment;
    if steps {
        let heads: Vec<String> = settings.iter().map(|setting| setting.name.clone()).collect();
        let table = |measure: &String| {
            let cells = |method: &str| -> Vec<String> {
                settings.iter().map(|setting| cell(outcome, &setting.name, method, measure)).collect()
            };
            let rows: Vec<Line> =
                methods.iter().map(|method| (method.name.clone(), cells(&method.name))).collect();
            grid(heading(measure), &heads, &rows)
        };
        return columns.iter().map(table).collect();
    }
    let mut tables = Vec::new();
    for setting in settings {
        let in_paper = |measure: &&String| {
            methods.iter().any(|m| m.paper.get(&setting.name).is_some_and(|v| v.contains_key(*measure)))
        };
        let papers: Vec<&String> = columns.iter().filter(in_paper).collect();
        let heads = columns.iter().map(|measure| heading(measure).to_owned());
        let heads: Vec<String> =
            heads.chain(papers.iter().map(|measure| format!("paper: {}", heading(measure)))).collect();
        let rows: Vec<Line> = methods
            .iter()
            .filter(|method| method.is_tested_in(setting))
            .map(|method| {
                let ours = columns.iter().map(|measure| cell(outcome, &setting.name, &method.name, measure));
                let theirs = papers.iter().map(|measure| {
                    let value = method.paper.get(&setting.name).and_then(|values| values.get(*measure));
                    value.map_or(String::new(), |value| format!("{value:.*}", digits(measure)))
                });
                (method.name.clone(), ours.chain(theirs).collect())
            })
            .collect();
        tables.push(grid(&setting.name, &heads, &rows));
    }
    tables
}

fn cell(outcome: &Outcome, setting: &str, method: &str, measure: &str) -> String {
    let digits = digits(measure);
    let pairs = outcome.spread(setting, method, "pairs");
    match (outcome.spread(setting, method, measure), pairs) {
        (None, _) => String::new(),
        (Some(Spread { mean, .. }), Some(pairs)) if measure == "found" => {
            format!("{mean:.0} of {:.0}", pairs.mean)
        }
        (Some(Spread { mean, deviation: None }), _) => format!("{mean:.digits$}"),
        (Some(Spread { mean, deviation: Some(deviation) }), _) => {
            format!("{mean:.digits$} ± {deviation:.digits$}")
        }
    }
}

fn grid(corner: &str, heads: &[String], rows: &[Line]) -> String {
    let line = |first: &str, cells: &[String]| {
        let cells = cells.iter().map(|cell| cell.replace('|', "\\|"));
        format!("| {} | {} |\n", first.replace('|', "\\|"), cells.collect::<Vec<_>>().join(" | "))
    };
    let mut text = line(corner, heads);
    let _ = writeln!(text, "| --- |{}", " ---: |".repeat(heads.len()));
    for (name, cells) in rows {
        text.push_str(&line(name, cells));
    }
    text
}

/// What has learned, and how.
fn lessons(learned: &[Lesson], points: usize) -> String {
    if learned.is_empty() {
        return String::new();
    }
    let heads = ["network", "learned from", "clouds", "steps", "s", "MAE(R) °", "recall"].map(str::to_owned);
    let rows: Vec<Line> =
        learned.iter().map(|lesson| (format!("`{}`", lesson.weights), row_of(lesson, points))).collect();
    format!(
        "## What has learned\n\nTimes are those of steps, validation excluded; errors those on held-out clouds or, where \
         a network learned on, on its own.\n\n{}",
        grid("weights", &heads, &rows)
    )
}

fn row_of(lesson: &Lesson, points: usize) -> Vec<String> {
    let Weights { data, part, overlaps, adaptation, .. } = &lesson.of;
    let learned_from = if let Some(Adaptation { data, adapt, setting, .. }) = adaptation {
        let clouds = if *adapt == Adapt::Tested { "tested pairs" } else { "training split" };
        format!("{data}, {clouds}, {}, going on", setting.protocol(points))
    } else {
        let clouds = match part {
            Part::UnseenClouds => "training split",
            Part::UnseenCategories => "first half of the categories",
        };
        let overlaps: Vec<&str> = overlaps.iter().map(|&overlap| overlap_name(overlap)).collect();
        format!("{data}, {clouds}, {}", overlaps.join(" and "))
    };
    let found = |value: fn(&ValidationErrors) -> f64| {
        lesson.held_out.as_ref().map_or(String::new(), |errors| format!("{:.3}", value(errors)))
    };
    let steps = match &lesson.failed {
        None => lesson.steps.to_string(),
        Some(reason) => format!("{}: {reason}", lesson.steps),
    };
    vec![
        lesson.of.to_string(),
        learned_from,
        lesson.shapes.to_string(),
        steps,
        format!("{:.0}", lesson.seconds),
        found(|errors| errors.mae_r_deg),
        found(|errors| errors.recall),
    ]
}

/// An experiment's measurements, one a line: every setting, method and seed, with the paper's figures where it has any.
pub fn csv(outcome: &Outcome) -> String {
    let columns = &outcome.experiment.columns;
    let mut text = format!(
        "experiment,data,setting,method,seed,{},{}\n",
        columns.join(","),
        columns.iter().map(|name| format!("paper_{name}")).collect::<Vec<_>>().join(",")
    );
    for cell in &outcome.cells {
        let method = outcome.experiment.methods.iter().find(|method| method.name == cell.method);
        let paper = method.and_then(|method| method.paper.get(&cell.setting));
        let value = |values: Option<&Values>, name: &String| {
            values.and_then(|values| values.get(name)).map_or(String::new(), f64::to_string)
        };
        let ours = columns.iter().map(|name| value(Some(&cell.values), name));
        let theirs = columns.iter().map(|name| value(paper, name));
        let _ = writeln!(
            text,
            "{},{},{},{},{},{}",
            quoted(&outcome.name),
            quoted(outcome.data.as_deref().unwrap_or_default()),
            quoted(&cell.setting),
            quoted(&cell.method),
            cell.seed,
            ours.chain(theirs).collect::<Vec<_>>().join(",")
        );
    }
    text
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}
