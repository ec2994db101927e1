//! The paper's experiments: what each is, what it takes, and what came of it.

mod budget;
mod description;
mod plan;
mod plot;
mod report;
mod reproduce;
mod timing;

pub use budget::{Budget, Learning};
pub use description::{Experiment, Values};
pub use plot::picture;
pub use report::{csv, markdown};
pub use reproduce::{Outcome, Progress, Reproduction, Results, Spectator};

use upcr::{Error, Result};

/// Names and files of the experiments that come with the program. A new one is a file and a line here.
static EXPERIMENTS: [(&str, &str); 7] = [
    ("consistent", include_str!("../../../../experiments/consistent.toml")),
    ("partial", include_str!("../../../../experiments/partial.toml")),
    ("seven_scenes", include_str!("../../../../experiments/seven_scenes.toml")),
    ("rotation", include_str!("../../../../experiments/rotation.toml")),
    ("outliers", include_str!("../../../../experiments/outliers.toml")),
    ("invariants", include_str!("../../../../experiments/invariants.toml")),
    ("time", include_str!("../../../../experiments/time.toml")),
];

/// Names of the experiments.
pub fn names() -> impl Iterator<Item = &'static str> {
    EXPERIMENTS.iter().map(|(name, _)| *name)
}

/// The experiment of that name.
///
/// # Errors
/// Where there is none.
pub fn by_name(name: &str) -> Result<Experiment> {
    let found = EXPERIMENTS.iter().find(|(known, _)| *known == name);
    let (_, text) = found.ok_or_else(|| {
        let known = names().collect::<Vec<_>>().join(", ");
        let reason = format!("there is no {name}; there are {known}");
        Error::InvalidSetting { name: "experiment", reason }
    })?;
    Experiment::from_toml(text)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::reproduce::Measured;
    use super::*;
    use crate::data::pairs::Coverage;
    use crate::drawing;

    /// A data folder with empty data sets of these names.
    fn root(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        folder
    }

    #[test]
    fn every_experiment_can_be_planned_in_every_budget() {
        let root = root(&["shapes69", "redkitchen"]);
        for budget in ["quick", "full"] {
            let budget = Budget::by_name(budget).unwrap();
            for name in names() {
                let experiment = by_name(name).unwrap();
                let cells = experiment.plan(&budget, root.path()).unwrap().unwrap();
                // Every method in each of its settings, and what the paper says of it is in one of these.
                for method in &experiment.methods {
                    let tested: Vec<&str> = (cells.iter())
                        .filter(|cell| cell.method == method.name)
                        .map(|cell| cell.setting.as_str())
                        .collect();
                    assert!(!tested.is_empty(), "{name}: {}", method.name);
                    assert!(method.paper.keys().all(|setting| tested.contains(&setting.as_str())), "{name}");
                }
            }
        }
        assert!(by_name("everything").is_err());
    }

    #[test]
    fn what_is_the_same_is_done_once() {
        let root = root(&["shapes69", "redkitchen"]);
        let budget = Budget::by_name("quick").unwrap();
        let mut weights = BTreeMap::new();
        for name in ["consistent", "rotation", "invariants", "outliers", "seven_scenes"] {
            for cell in by_name(name).unwrap().plan(&budget, root.path()).unwrap().unwrap() {
                if let Some(found) = cell.test.weights {
                    let users: &mut Vec<&str> = weights.entry(found.unadapted().id()).or_default();
                    users.push(name);
                }
            }
        }
        // The network with distances and Euler angles of the first seed stands in all of them.
        weights.values_mut().for_each(Vec::dedup);
        assert_eq!(weights.values().filter(|users| users.len() == 5).count(), 1, "{weights:?}");
    }

    #[test]
    fn data_are_the_first_that_are_there_and_without_them_nothing_is_planned() {
        let budget = Budget::by_name("quick").unwrap();
        let experiment = by_name("consistent").unwrap();
        assert_eq!(experiment.plan(&budget, root(&["redkitchen"]).path()).unwrap(), None);
        for (there, taken) in [
            (vec!["shapes69"], "shapes69"),
            (vec!["shapes69", "modelnet40_ply_hdf5_2048"], "modelnet40_ply_hdf5_2048"),
        ] {
            let cells = experiment.plan(&budget, root(&there).path()).unwrap().unwrap();
            assert!(cells.iter().all(|cell| cell.test.data == taken));
        }
    }

    #[test]
    fn partial_clouds_are_learned_from_in_the_size_they_are_tested_in() {
        let root = root(&["shapes69"]);
        let budget = Budget::by_name("full").unwrap();
        let cells = by_name("partial").unwrap().plan(&budget, root.path()).unwrap().unwrap();
        for weights in cells.iter().filter_map(|cell| cell.test.weights.as_ref()) {
            assert_eq!(weights.training.stages[0].points, 768);
            assert_eq!(weights.last().stages[0].points, 768);
            assert_eq!(weights.overlaps, [Coverage::PartialShared, Coverage::PartialIndependent]);
        }
        // Where a setting says so, nothing learns on.
        let adapts = |setting: &str| {
            let mut of_setting = cells.iter().filter(|cell| cell.setting == setting);
            of_setting.any(|cell| cell.test.weights.as_ref().is_some_and(|w| w.adaptation.is_some()))
        };
        assert!(adapts("UPC, shared") && !adapts("UPC, own"));
    }

    /// Results of two methods, one of which has a value of two seeds and one nothing.
    fn outcome(plot: &str, value: f64) -> Outcome {
        let text = format!(
            "title = \"a\"\npaper = \"b\"\ncolumns = [\"recall\", \"found\"]\nplot = {{ kind = \"{plot}\", measure = \
             \"recall\" }}\n[[setting]]\nname = \"c, d\"\n[[method]]\nname = \"e|f\"\nrun = \"icp\"\n[[method]]\nname = \
             \"g\"\nrun = \"fgr\"\npaper.\"c, d\" = {{ recall = 0.25 }}\n"
        );
        let cell = |seed: u64, value: f64| Measured {
            setting: "c, d".into(),
            method: "e|f".into(),
            seed,
            weights: None,
            values: [("recall".to_owned(), value), ("found".to_owned(), 3.0), ("pairs".to_owned(), 4.0)]
                .into(),
        };
        Outcome {
            name: "x".into(),
            experiment: Experiment::from_toml(&text).unwrap(),
            data: Some("y".into()),
            learned_from: None,
            cells: vec![cell(0, value), cell(1, 3.0 * value)],
        }
    }

    #[test]
    fn reports_hold_what_was_measured_and_what_the_paper_says() {
        let results = Results {
            version: "1".into(),
            budget_name: "quick".into(),
            budget: Budget::by_name("quick").unwrap(),
            threads: 2,
            finished: true,
            experiments: vec![outcome("dots", 0.5)],
            learned: Vec::new(),
        };
        let text = markdown(&results, "upcr reproduce x");
        let row = "| e\\|f | 1.000 ± 0.707 | 3 of 4 |  |";
        assert!(text.contains(row) && text.contains("| g |  |  | 0.250 |"), "{text}");
        assert!(text.contains("(x.svg)") && text.contains("points = 256"), "{text}");
        let table = csv(&results.experiments[0]);
        assert_eq!(table.lines().nth(1), Some("x,y,\"c, d\",e|f,0,0.5,3,,"), "{table}");
        assert_eq!(table.lines().count(), 3);
    }

    #[test]
    fn pictures_are_drawn_of_any_values_but_none() {
        for plot in ["dots", "lines"] {
            for value in [1e-9, 0.5, 1e9] {
                let outcome = outcome(plot, value);
                let picture = picture(&outcome).unwrap();
                assert!(drawing::svg(&picture).contains("e|f"));
                assert!(drawing::png(&picture).unwrap().len() > 1000);
            }
            let mut nothing = outcome(plot, 0.0);
            nothing.experiment.methods.truncate(1);
            assert!(picture(&nothing).is_none());
        }
    }

    #[test]
    fn what_is_no_experiment_is_refused() {
        let start = "title = \"a\"\npaper = \"b\"\ndata = [\"c\"]\ncolumns = [\"recall\"]\n";
        let setting = "[[setting]]\nname = \"d\"\n";
        let method = "[[method]]\nname = \"e\"\nrun = \"icp\"\n";
        let whole = format!("{start}{setting}{method}");
        assert!(Experiment::from_toml(&whole).is_ok());
        for text in [
            format!("{start}{setting}"),
            format!("{start}{method}"),
            format!("{whole}settings = [\"f\"]\n"),
            format!("{whole}paper.f = {{ recall = 1.0 }}\n"),
            format!("{start}{setting}[[method]]\nname = \"e\"\n"),
            format!("colour = 3\n{whole}"),
            format!("{whole}adapt = \"tested\"\n"),
            format!("{whole}network = \"prnet\"\n"),
            format!("{whole}network = \"upcr\"\n"),
            format!("{}network = \"prnet\"\n", whole.replace("icp", "upcr")),
            format!("{whole}{method}"),
            format!("{start}{setting}{setting}{method}"),
            format!("{start}{setting}outliers = 1.5\n{method}"),
            whole.replace("recall", "beauty"),
            whole.replace("icp", "magic"),
        ] {
            assert!(Experiment::from_toml(&text).is_err(), "{text}");
        }
    }
}
