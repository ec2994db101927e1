//! `upcr train`: a network learned without labels.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use upcr_lab::data::{Shapes, Split};
use upcr_lab::files::write_atomically;
use upcr_lab::models::LearnedConfig;
use upcr_lab::train::{Event, Trainer, TrainingConfig, Watcher, write_history};

use crate::Status;
use crate::output;
use crate::pairs::Pairs;
use crate::stream::{Layout, Stream, Streaming};

const AFTER_HELP: &str = "\
Files in the run's folder:
  run.toml                 data, protocol, settings, seed and version
  checkpoint.safetensors   what --resume needs; written every minute, whole or not at all
  weights.safetensors      the learned weights, at the end
  history.csv              the learning curve
  history.svg              the same as a plot";

/// What a viewer shows of learning, as [`Teller`] streams it.
pub const LEARNING: Layout = Layout {
    clouds: false,
    curves: &["loss", "learning_rate", "rotation", "translation", "recall", "pace"],
    words: false,
};

/// Learn a network from shapes; UPCR without labels
#[derive(clap::Args)]
#[command(after_help = AFTER_HELP)]
pub struct Args {
    /// Data set to learn from (its training split); may be given several times
    #[arg(long, value_name = "PATH", required_unless_present = "resume")]
    data: Vec<PathBuf>,
    /// Pairs that are made of the shapes
    #[arg(long, value_enum, default_value_t = Pairs::Upc)]
    protocol: Pairs,
    /// Keep three quarters of each cloud
    #[arg(long)]
    partial: bool,
    /// Settings to start from
    #[arg(long, value_enum, default_value_t = Preset::Quick)]
    preset: Preset,
    /// Settings as TOML, instead of a preset
    #[arg(long, value_name = "FILE", conflicts_with = "preset")]
    config: Option<PathBuf>,
    /// Network in place of the settings' (narrow in `quick`): upcr; pointnetlk, dcp-v1, dcp-v2, prnet, prnet*, which learn
    /// from true poses
    #[arg(long, value_name = "NAME")]
    network: Option<String>,
    /// A setting to change, as in TOML: `--set network.invariant=none`, `--set 'network.widths=[8, 16, 32]'`; may be given
    /// several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    changes: Vec<String>,
    /// Seed of the first weights and of all pairs [default: the settings']
    #[arg(long)]
    seed: Option<u64>,
    /// Threads to use [default: all]; the result does not depend on it
    #[arg(long, value_name = "N")]
    threads: Option<std::num::NonZeroUsize>,
    /// What computes
    #[arg(long, value_enum, default_value_t = Backend::Cpu)]
    backend: Backend,
    /// Folder for the run; made where missing
    #[arg(long, value_name = "DIR", required_unless_present = "resume")]
    out: Option<PathBuf>,
    /// Go on with the run in this folder, as it was started
    #[arg(long, value_name = "RUN", conflicts_with_all = ["data", "protocol", "partial", "preset", "config", "network", "changes", "seed", "out"])]
    resume: Option<PathBuf>,
    #[command(flatten)]
    stream: Streaming,
}

#[derive(Clone, Copy, ValueEnum)]
enum Preset {
    /// The paper's: 500 epochs of 1,024 points
    Paper,
    /// Narrower and with fewer points at first: minutes on two cores
    Quick,
}

/// What computes.
#[derive(Clone, Copy, ValueEnum)]
pub enum Backend {
    /// The processor
    Cpu,
    /// An NVIDIA GPU
    #[cfg(feature = "cuda")]
    Cuda,
}

impl Backend {
    pub fn device(self) -> upcr_lab::Device {
        match self {
            Self::Cpu => upcr_lab::Device::flex(),
            #[cfg(feature = "cuda")]
            Self::Cuda => upcr_lab::Device::cuda(0),
        }
    }
}

/// What a run was started with: `run.toml`.
#[derive(Serialize, Deserialize)]
struct Run {
    version: String,
    data: Vec<PathBuf>,
    protocol: Pairs,
    partial: bool,
    training: TrainingConfig,
}

pub fn run(args: &Args) -> Result<Status> {
    output::on_threads(args.threads, || train(args))?
}

fn train(args: &Args) -> Result<Status> {
    let stream = args.stream.open("train", &LEARNING)?;
    let device = args.backend.device();
    let (folder, run, mut trainer) = match &args.resume {
        Some(folder) => {
            let path = folder.join("run.toml");
            let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
            let run: Run = toml::from_str(&text).with_context(|| path.display().to_string())?;
            let trainer = if folder.join("checkpoint.safetensors").exists() {
                Trainer::resume(folder, &device)?
            } else {
                Trainer::new(run.training.clone(), folder, &device)?
            };
            (folder.clone(), run, trainer)
        }
        None => start(args, &device)?,
    };
    let mut shapes = Shapes::default();
    for path in &run.data {
        shapes.append(run.protocol.shapes(path, Split::Train)?);
    }
    output::note(&format!("{} shapes to learn from", shapes.len()));
    let mixture = run.protocol.mixture(run.partial);
    let mut teller = Teller::new(stream)?;
    let done = trainer.run(&shapes, &mixture, &mut teller)?;
    write_history(&folder, trainer.history())?;
    teller.close()?;
    if !done {
        output::note(&format!("stopped; go on with: upcr train --resume {}", folder.display()));
        return Ok(Status::Stopped);
    }
    let weights = folder.join("weights.safetensors");
    write_atomically(&weights, &trainer.weights().to_bytes()?)?;
    output::answer(&format!("{}\n", weights.display()))?;
    Ok(Status::Done)
}

fn start(args: &Args, device: &upcr_lab::Device) -> Result<(PathBuf, Run, Trainer)> {
    let folder = args.out.clone().context("--out is missing")?;
    let mut training = match (&args.config, args.preset) {
        (Some(path), _) => {
            let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
            TrainingConfig::from_toml(&text).with_context(|| path.display().to_string())?
        }
        (None, Preset::Paper) => TrainingConfig::default(),
        (None, Preset::Quick) => TrainingConfig::quick(),
    };
    if let Some(name) = &args.network {
        let network = LearnedConfig::by_name(name)?;
        let narrow = args.config.is_none() && matches!(args.preset, Preset::Quick);
        training.network = if narrow { network.narrow() } else { network };
    }
    for change in &args.changes {
        training = training.with(change).with_context(|| format!("--set {change}"))?;
    }
    training.seed = args.seed.unwrap_or(training.seed);
    if folder.join("checkpoint.safetensors").exists() {
        bail!("{0} holds a run already; go on with it by --resume {0}", folder.display());
    }
    if let Some(missing) = args.data.iter().find(|path| !path.exists()) {
        bail!("{}: there is no such file or folder", missing.display());
    }
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let trainer = Trainer::new(training.clone(), &folder, device)?;
    let run = Run {
        version: env!("CARGO_PKG_VERSION").into(),
        data: args.data.clone(),
        protocol: args.protocol,
        partial: args.partial,
        training,
    };
    write_atomically(&folder.join("run.toml"), toml::to_string_pretty(&run)?.as_bytes())?;
    Ok((folder, run, trainer))
}

/// Tells of the run's progress on stderr and as curves over `step`, and of the user's wish to stop.
pub struct Teller {
    stopped: Arc<AtomicBool>,
    stream: Option<Stream>,
}

impl Teller {
    pub fn new(stream: Option<Stream>) -> Result<Self> {
        let stopped = Arc::new(AtomicBool::new(false));
        let flag = stopped.clone();
        // A second interruption ends the process at once.
        ctrlc::set_handler(move || {
            if flag.swap(true, Ordering::SeqCst) {
                std::process::exit(130);
            }
        })?;
        Ok(Self { stopped, stream })
    }

    pub fn close(self) -> Result<()> {
        self.stream.map_or(Ok(()), Stream::close)
    }
}

impl Watcher for Teller {
    fn event(&mut self, e: &Event, clouds_left: u64) {
        let validation = e.validation.map_or(String::new(), |v| {
            format!(
                "  held out: loss {:.5}, MAE(R) {:.2}°, MAE(t) {:.4}, recall {:.1} %",
                v.loss,
                v.mae_r_deg,
                v.mae_t,
                100.0 * v.recall
            )
        });
        output::note(&format!(
            "step {}/{} ({} points)  loss {:.5}  {:.0} clouds/s  {} left{validation}",
            e.step,
            e.steps,
            e.points,
            e.loss,
            e.clouds_per_second,
            duration(e.time_left(clouds_left)),
        ));
        let Some(stream) = &self.stream else { return };
        stream.at("step", e.step);
        stream.number("loss/learned", e.loss);
        stream.number("learning_rate/adam", e.learning_rate);
        stream.number("pace/clouds_per_second", e.clouds_per_second);
        if let Some(v) = e.validation {
            stream.number("loss/held_out", v.loss);
            stream.number("rotation/held_out_mae_deg", v.mae_r_deg);
            stream.number("translation/held_out_mae", v.mae_t);
            stream.number("recall/held_out", v.recall);
        }
    }

    fn stop(&mut self) -> bool {
        self.stopped.load(Ordering::SeqCst)
    }
}

/// Hours and minutes, or minutes and seconds.
pub fn duration(d: Duration) -> String {
    let s = d.as_secs();
    if s >= 3600 { format!("{}h{:02}m", s / 3600, s / 60 % 60) } else { format!("{}m{:02}s", s / 60, s % 60) }
}
