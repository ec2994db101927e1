//! `upcr reproduce`: the paper's experiments.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use upcr_lab::drawing;
use upcr_lab::experiments::{
    self, Budget, Experiment, Outcome, Progress, Reproduction, Spectator, csv, markdown, picture,
};
use upcr_lab::files::write_atomically;

use crate::Status;
use crate::output;
use crate::train::{Backend, Teller, duration};

const AFTER_HELP: &str = "\
Experiments: consistent, partial, seven_scenes, rotation, outliers, invariants, time; `all` are these. A file of
your own in their form is taken as well.

Files in the output folder:
  report.md                tables and pictures of the experiments named
  results.json             the same with all digits, settings and the paper's figures
  NAME.csv, .svg, .png     an experiment's measurements and its picture
  weights/, tests/         what has learned and what was measured: never done twice, a stopped run goes on from there";

/// Repeat the paper's experiments on your data
#[derive(clap::Args)]
#[command(after_help = AFTER_HELP)]
pub struct Args {
    /// Names of experiments, files in their form, or `all`
    #[arg(value_name = "NAME", required = true)]
    names: Vec<String>,
    /// How much it may cost: `quick`, two hours on two cores, `full`, the paper's own, or a file in their form
    #[arg(long, value_name = "NAME", default_value = "quick")]
    budget: String,
    /// Folder of the data sets: modelnet40_ply_hdf5_2048 or shapes69; 7scenes/redkitchen or redkitchen [default: $UPCR_DATA, else data]
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Threads to use [default: all]; only times depend on it
    #[arg(long, value_name = "N")]
    threads: Option<std::num::NonZeroUsize>,
    /// What computes
    #[arg(long, value_enum, default_value_t = Backend::Cpu)]
    backend: Backend,
    /// Folder for the results; made where missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<Status> {
    output::on_threads(args.threads, || reproduce(args))?
}

fn reproduce(args: &Args) -> Result<Status> {
    let mut chosen = Vec::new();
    for name in &args.names {
        match name.as_str() {
            "all" => {
                for name in experiments::names() {
                    chosen.push((name.to_owned(), experiments::by_name(name)?));
                }
            }
            name => chosen.push(experiment(name)?),
        }
    }
    let mut seen = BTreeSet::new();
    if let Some((name, _)) = chosen.iter().find(|(name, _)| !seen.insert(name)) {
        bail!(
            "{name} is named twice, and its files would take each other's place: rename one, or leave one out"
        );
    }
    let data = args.data.clone().unwrap_or_else(|| {
        std::env::var_os("UPCR_DATA").filter(|v| !v.is_empty()).map_or_else(|| "data".into(), PathBuf::from)
    });
    if !data.is_dir() {
        bail!("{}: there is no such folder; --data tells where the data sets are", data.display());
    }
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    let reproduction = Reproduction {
        data,
        folder: args.out.clone(),
        budget: budget(&args.budget)?,
        budget_name: args.budget.clone(),
        device: args.backend.device(),
    };
    let results = reproduction.run(&chosen, &mut Teller::new(None)?)?;
    let command = format!("upcr reproduce {} --budget {}", args.names.join(" "), args.budget);
    let path = args.out.join("report.md");
    write_atomically(&args.out.join("results.json"), serde_json::to_string_pretty(&results)?.as_bytes())?;
    write_atomically(&path, markdown(&results, &command).as_bytes())?;
    for outcome in &results.experiments {
        if outcome.data.is_none() {
            let names = outcome.experiment.data.join(", ");
            output::note(&format!("skipped {}: none of its data sets is there ({names})", outcome.name));
        }
        write_outcome(&args.out, outcome)?;
    }
    if results.finished && results.experiments.iter().all(|outcome| outcome.data.is_none()) {
        bail!("{}: nothing was done, for want of data", reproduction.data.display());
    }
    if !results.finished {
        output::note("stopped; the same command goes on");
        return Ok(Status::Stopped);
    }
    output::answer(&format!("{}\n", path.display()))?;
    Ok(Status::Done)
}

/// An experiment of the program's, or of a file.
fn experiment(name: &str) -> Result<(String, Experiment)> {
    let Some(text) = file(name)? else { return Ok((name.to_owned(), experiments::by_name(name)?)) };
    let experiment = Experiment::from_toml(&text).with_context(|| name.to_owned())?;
    let stem = Path::new(name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok((stem, experiment))
}

/// A budget of the program's, or of a file.
fn budget(name: &str) -> Result<Budget> {
    match file(name)? {
        Some(text) => Budget::from_toml(&text).with_context(|| name.to_owned()),
        None => Ok(Budget::by_name(name)?),
    }
}

/// The text of a file of settings; `None` where it is no file's name.
fn file(name: &str) -> Result<Option<String>> {
    if Path::new(name).extension().is_none_or(|extension| extension != "toml") {
        return Ok(None);
    }
    std::fs::read_to_string(name).map(Some).with_context(|| name.to_owned())
}

fn write_outcome(folder: &Path, outcome: &Outcome) -> Result<()> {
    let file = |extension: &str| folder.join(format!("{}.{extension}", outcome.name));
    write_atomically(&file("csv"), csv(outcome).as_bytes())?;
    if let Some(picture) = picture(outcome) {
        write_atomically(&file("svg"), drawing::svg(&picture).as_bytes())?;
        write_atomically(&file("png"), &drawing::png(&picture)?)?;
    }
    Ok(())
}

impl Spectator for Teller {
    fn progress(&mut self, progress: &Progress) {
        let left = progress.left.map_or(String::new(), |left| format!(", about {} left", duration(left)));
        output::note(&format!("[{}/{}{left}] {}", progress.task, progress.of, progress.what));
    }
}
