//! `upcr calibrate`: fitting the probability that a pose is right, and measuring what the verdicts are worth.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Context, Result};
use upcr::{Calibration, Settings};
use upcr_lab::data::Split;
use upcr_lab::drawing;
use upcr_lab::files::write_atomically;
use upcr_lab::trust::cases::Material;
use upcr_lab::trust::{
    Observed, Reliability, Trust, asked_in_all_ways, covariance, fit, free_axes, markdown, observe, picture,
};

use crate::Status;
use crate::output::{self, Progress};

/// Fit the probability that a pose is right, and measure what the verdicts are worth
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    task: Task,
}

#[derive(clap::Subcommand)]
enum Task {
    Fit(Fit),
    Test(Test),
}

/// Fit the weights of the evidence on pairs whose true pose is known
///
/// Pairs are made of whole shapes, of scans with known poses, and of scenes of the virtual scanner: right and wrong,
/// noisy, of much overlap and of little, of two things of one kind, and of things that have nothing in common.
#[derive(clap::Args)]
struct Fit {
    /// Data sets: shapes (their training split), a folder of 7-Scenes frames, or scans beside their poses (NAME.ply,
    /// NAME.pose.txt)
    #[arg(long, value_name = "PATH", num_args = 1..)]
    data: Vec<PathBuf>,
    /// Scenes of the virtual scanner; 0: none
    #[arg(long, value_name = "N", default_value_t = 160)]
    scenes: u64,
    /// Pairs made of each data set, and of the virtual scenes
    #[arg(long, value_name = "N", default_value_t = 3000)]
    pairs: u64,
    /// Seed of every random choice
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads to use [default: all]; only the time depends on it
    #[arg(long, value_name = "N")]
    threads: Option<std::num::NonZeroUsize>,
    /// Also write what was seen of every pair, a JSON object a line
    #[arg(long, value_name = "FILE")]
    observed: Option<PathBuf>,
    /// The calibration, for `upcr register --calibration`
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Measure what the verdicts are worth, on data that no fit has seen
#[derive(clap::Args)]
struct Test {
    /// Data sets: shapes (their test split), a folder of 7-Scenes frames, or scans beside their poses (NAME.ply,
    /// NAME.pose.txt)
    #[arg(long, value_name = "PATH", num_args = 1.., required = true)]
    data: Vec<PathBuf>,
    /// Pairs made of each data set
    #[arg(long, value_name = "N", default_value_t = 1000)]
    pairs: u64,
    /// Pairs of clouds that have nothing in common, made of each data set
    #[arg(long, value_name = "N", default_value_t = 1000)]
    strangers: u64,
    /// Noisy pairs over which the covariance is measured; they are made of the first data set of shapes
    #[arg(long, value_name = "N", default_value_t = 1000)]
    covariance: usize,
    /// Scans of a plane, a cylinder, a corridor and a sphere each, whose free directions are to be named
    #[arg(long, value_name = "N", default_value_t = 100)]
    free_axes: usize,
    /// The calibration to be measured [default: the one in the program]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Seed of every random choice
    #[arg(long, default_value_t = 2)]
    seed: u64,
    /// Threads to use [default: all]; only the time depends on it
    #[arg(long, value_name = "N")]
    threads: Option<std::num::NonZeroUsize>,
    /// Folder for report.md, results.json and the reliability plot as SVG and PNG; made where missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<Status> {
    match &args.task {
        Task::Fit(args) => output::on_threads(args.threads, || run_fit(args))?,
        Task::Test(args) => output::on_threads(args.threads, || run_test(args))?,
    }
}

/// Tells how many of `count` pairs are done.
fn teller(what: String, count: u64) -> impl Fn() + Sync {
    const EVERY: u64 = 16;
    let progress = std::sync::Mutex::new(Progress::new());
    let done = AtomicU64::new(0);
    move || {
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        if done.is_multiple_of(EVERY)
            && let Ok(mut progress) = progress.lock()
        {
            progress.step(&format!("{what}: {done} of {count}"));
        }
    }
}

fn name(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    full.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}

fn run_fit(args: &Fit) -> Result<Status> {
    for path in args.observed.iter().chain([&args.out]) {
        output::check_folder(path)?;
    }
    let mut observed = Vec::new();
    let mut sources = Vec::new();
    let mut add = |name: String, material: &Material| -> Result<()> {
        let case = |index| material.case(args.seed, index);
        observed.extend(observe(args.pairs, case, asked_in_all_ways, &teller(name.clone(), args.pairs))?);
        sources.push(name);
        Ok(())
    };
    for path in &args.data {
        add(name(path), &Material::open(path, Split::Train)?)?;
    }
    if args.scenes > 0 {
        let mut progress = Progress::new();
        progress.step("scanning virtual scenes");
        let scenes = Material::virtual_scenes(args.seed, args.scenes)?;
        drop(progress);
        add(format!("{} virtual scenes", args.scenes), &scenes)?;
    }
    if let Some(path) = &args.observed {
        let lines: Vec<String> = observed.iter().map(serde_json::to_string).collect::<Result<_, _>>()?;
        write_atomically(path, (lines.join("\n") + "\n").as_bytes())?;
    }
    anyhow::ensure!(!observed.is_empty(), "no pairs to fit to: name data sets, or take virtual scenes");
    let about = format!(
        "right: within 5 degrees and a tenth of the diameter, in rooms 0.3 m, for lidars on cars 2 degrees and 0.6 m; fitted on {} pairs of {}, seed {}",
        observed.len(),
        sources.join(", "),
        args.seed
    );
    let calibration = fit(&observed, Calibration::embedded()?.as_ref(), about)?;
    let mut text = serde_json::to_string_pretty(&calibration)?;
    text.push('\n');
    write_atomically(&args.out, text.as_bytes())?;
    let again = |o: &Observed| Observed { probability: calibration.probability(&o.evidence), ..o.clone() };
    let found = Reliability::of(&observed.iter().map(again).collect::<Vec<_>>());
    let area = found.area_under_roc.map_or_else(|| "–".into(), |area| format!("{area:.4}"));
    output::answer(&format!(
        "{} pairs, {} right; on these, before reasons against a pose cap it: calibration error {:.4}, area under ROC {area}\n{text}",
        found.counts.pairs, found.counts.right, found.expected_calibration_error
    ))?;
    Ok(Status::Done)
}

fn run_test(args: &Test) -> Result<Status> {
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    let calibration = args.calibration.as_deref().map(Calibration::load).transpose()?.map(Arc::new);
    let settings = Settings { calibration, ..Settings::default() };
    let as_told = |_, _: &_| settings.clone();
    let (mut reliability, mut strangers, mut all) = (Vec::new(), Vec::new(), Vec::new());
    let mut covered = Vec::new();
    for path in &args.data {
        let (name, material) = (name(path), Material::open(path, Split::Test)?);
        let case = |index| material.case(args.seed, index);
        let observed = observe(args.pairs, case, as_told, &teller(name.clone(), args.pairs))?;
        reliability.push((name.clone(), Reliability::of(&observed)));
        all.extend(observed);
        if args.strangers > 0 {
            let case = |index| material.strangers(args.seed, index);
            let told = teller(format!("{name}, nothing in common"), args.strangers);
            strangers.push((
                name.clone(),
                Reliability::of(&observe(args.strangers, case, as_told, &told)?).counts,
            ));
        }
        if let Material::Shapes(shapes) = &material
            && covered.is_empty()
            && args.covariance > 0
        {
            let mut progress = Progress::new();
            progress.step(&format!("{name}, covariance"));
            covered = covariance::measure(shapes, args.covariance, args.seed, &settings)?;
        }
    }
    let mut free = Vec::new();
    if args.free_axes > 0 {
        let mut progress = Progress::new();
        progress.step("free directions");
        free = free_axes::measure(args.free_axes, args.seed, &settings)?;
    }
    if reliability.len() > 1 {
        reliability.push(("all".into(), Reliability::of(&all)));
    }
    let trust = Trust { reliability, strangers, covariance: covered, free_axes: free };
    let text = markdown(&trust);
    let panels: Vec<_> = trust.reliability.iter().map(|(name, found)| (name.as_str(), found)).collect();
    let picture = picture(&panels);
    let results = serde_json::json!({
        "trust": trust,
        "pairs": args.pairs,
        "strangers": args.strangers,
        "covariance": args.covariance,
        "free_axes": args.free_axes,
        "seed": args.seed,
        "version": env!("CARGO_PKG_VERSION"),
    });
    let file = |name: &str| args.out.join(name);
    write_atomically(&file("reliability.svg"), drawing::svg(&picture).as_bytes())?;
    write_atomically(&file("reliability.png"), &drawing::png(&picture)?)?;
    write_atomically(&file("results.json"), serde_json::to_string_pretty(&results)?.as_bytes())?;
    write_atomically(&file("report.md"), text.as_bytes())?;
    output::answer(&text)?;
    Ok(Status::Done)
}
