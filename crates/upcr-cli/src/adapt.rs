//! `upcr adapt`: learned weights learn on from the clouds at hand, without labels.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use upcr::net::EMBEDDED_WEIGHTS;
use upcr_lab::data::{self, Split, pairs::POINTS};
use upcr_lab::files::write_atomically;
use upcr_lab::models::Learned;
use upcr_lab::models::tensor_file::TensorFile;
use upcr_lab::train::{ADAPTATION_EPOCHS, ADAPTATION_RATE, Alone, Material, Poses, TrainingConfig, adapt};

use crate::Status;
use crate::output;
use crate::pairs::Pairs;
use crate::stream::Streaming;
use crate::train::{Backend, LEARNING, Teller};

const AFTER_HELP: &str = "\
Files in the output folder:
  weights.safetensors      the adapted weights, or the old ones where adapting did not help
  adaptation.json          loss before and after, settings, seed and version
  checkpoint.safetensors   the state of the run, written every minute; the same command goes on from there
  history.csv, history.svg the learning curve";

/// Let learned weights learn on from your own clouds, without labels
#[derive(clap::Args)]
#[command(after_help = AFTER_HELP)]
pub struct Args {
    /// Weights to start from [default: the ones inside the program]
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Folder of clouds, or a data set
    #[arg(long, value_name = "PATH")]
    clouds: PathBuf,
    /// Part of a data set; a folder of clouds is taken whole
    #[arg(long, value_enum, default_value_t = Part::All)]
    split: Part,
    /// Pairs that are made of the clouds
    #[arg(long, value_enum, default_value_t = Pairs::ADAPTATION)]
    protocol: Pairs,
    /// Keep three quarters of each cloud
    #[arg(long)]
    partial: bool,
    /// Learn from the one pair of each cloud that `upcr eval` has, not from new poses in every epoch
    #[arg(long)]
    fixed_pairs: bool,
    /// Passes over the clouds
    #[arg(long, value_name = "N", default_value_t = ADAPTATION_EPOCHS, value_parser = clap::value_parser!(u64).range(1..))]
    epochs: u64,
    /// Points of a cloud
    #[arg(long, value_name = "N", default_value_t = POINTS)]
    points: usize,
    /// Adam's step size at the start
    #[arg(long, value_name = "SIZE", default_value_t = ADAPTATION_RATE)]
    learning_rate: f64,
    /// Seed of the pairs
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Threads to use [default: all]; the result does not depend on it
    #[arg(long, value_name = "N")]
    threads: Option<std::num::NonZeroUsize>,
    /// What computes
    #[arg(long, value_enum, default_value_t = Backend::Cpu)]
    backend: Backend,
    /// Folder for the results; made where missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    stream: Streaming,
}

/// Part of a data set.
#[derive(Clone, Copy, ValueEnum)]
pub enum Part {
    /// What training sees
    Train,
    /// What it does not
    Test,
    /// Both
    All,
}

impl From<Part> for Split {
    fn from(part: Part) -> Self {
        match part {
            Part::Train => Self::Train,
            Part::Test => Self::Test,
            Part::All => Self::All,
        }
    }
}

pub fn run(args: &Args) -> Result<Status> {
    output::on_threads(args.threads, || learn(args))?
}

fn learn(args: &Args) -> Result<Status> {
    let stream = args.stream.open("adapt", &LEARNING)?;
    let (path, bytes) = match &args.weights {
        Some(path) => (path.as_path(), std::fs::read(path).with_context(|| path.display().to_string())?),
        None => (Path::new("the weights inside"), EMBEDDED_WEIGHTS.to_vec()),
    };
    let file = TensorFile::from_bytes(&bytes, path)?;
    let network = Learned::restore(&file, path, &args.backend.device().autodiff())?;
    if !matches!(network, Learned::Upcr(_)) {
        let path = path.display();
        bail!("{path}: only UPCR's weights learn without labels; others are trained by `upcr train`");
    }
    let shapes = Arc::new(data::open(&args.clouds, args.split.into())?);
    output::note(&format!("{} clouds to learn from", shapes.len()));
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    let mut config = TrainingConfig::adaptation(&network, args.points, args.epochs);
    config.learning_rate = args.learning_rate;
    config.seed = args.seed;
    let material = Material {
        parts: vec![shapes],
        mixture: args.protocol.mixture(args.partial),
        poses: if args.fixed_pairs { Poses::Fixed } else { Poses::Fresh },
    };
    let mut teller = Teller::new(stream)?;
    let done = adapt(&network, &material, config.clone(), &args.out, &mut Alone, &mut teller)?;
    let path = args.out.join("weights.safetensors");
    write_atomically(&path, &done.network.store().to_bytes()?)?;
    let [before, after] = done.errors;
    let report = serde_json::json!({
        "before": before,
        "after": after,
        "helped": done.helped,
        "finished": done.finished,
        "clouds": args.clouds,
        "weights": args.weights,
        "version": env!("CARGO_PKG_VERSION"),
        "training": config,
    });
    let report = serde_json::to_string_pretty(&report)?;
    write_atomically(&args.out.join("adaptation.json"), report.as_bytes())?;
    teller.close()?;
    if !done.finished {
        output::note("stopped early; the same command goes on");
    }
    output::note(&format!(
        "loss {:.6} before, {:.6} after: {}",
        before.loss,
        after.loss,
        if done.helped { "the adapted weights are kept" } else { "no better, the old weights are kept" }
    ));
    output::answer(&format!("{}\n", path.display()))?;
    Ok(Status::Done)
}
