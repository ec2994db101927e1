//! `upcr eval`: methods side by side on the pairs of a protocol.

use std::path::{Path, PathBuf};
use std::sync::Arc;

#[cfg(feature = "train")]
use anyhow::Context;
use anyhow::{Result, bail};
use clap::ValueEnum;
use upcr::{Settings, net::Network};
use upcr_lab::data::Split;
use upcr_lab::data::pairs::Protocol;
use upcr_lab::eval::methods::EvaluatedMethod;
use upcr_lab::eval::run::{csv, evaluate, markdown};
use upcr_lab::files::write_atomically;
#[cfg(feature = "train")]
use upcr_lab::models::{Learned, tensor_file::TensorFile};

use crate::Status;
use crate::output::{self, Progress};
use crate::pairs::Pairs;

/// Compare methods on a data set's test pairs
#[derive(clap::Args)]
pub struct Args {
    /// Data set; its test split is used
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Which shapes, and whether with noise
    #[arg(long, value_enum, value_delimiter = ',', default_value = "upc")]
    protocol: Vec<Pairs>,
    /// Which part of its points a cloud keeps
    #[arg(long, value_enum, value_delimiter = ',', default_value = "consistent")]
    overlap: Vec<Overlap>,
    /// Methods: upcr (the network alone, once), upcr+refine, upcr+register, icp, gicp, fgr, icp+spfh, icp+pfh, consensus, features, default; and trained
    /// networks as NAME=WEIGHTS (dcp=run/weights.safetensors)
    #[arg(long, value_delimiter = ',', default_value = "upcr,upcr+refine,icp,fgr,default")]
    methods: Vec<String>,
    /// Weights of the network [default: those in the program]
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Share of each cloud's points replaced by outliers
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    outliers: f64,
    /// Pairs at most, the first ones [default: all]
    #[arg(long, value_name = "N")]
    pairs: Option<std::num::NonZeroUsize>,
    /// Threads to use [default: all]; only times depend on it
    #[arg(long, value_name = "N")]
    threads: Option<std::num::NonZeroUsize>,
    /// Results as JSON; a table of comma-separated values comes beside it
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Which part of its points a cloud keeps.
#[derive(Clone, Copy, ValueEnum)]
#[value(rename_all = "snake_case")]
enum Overlap {
    /// All of them
    Consistent,
    /// Three quarters, both clouds seen from one point
    PartialShared,
    /// Three quarters, each seen from a point of its own
    PartialIndependent,
}

impl Overlap {
    fn protocol(self) -> Protocol {
        match self {
            Self::Consistent => Protocol::CONSISTENT,
            Self::PartialShared => Protocol::PARTIAL_SHARED,
            Self::PartialIndependent => Protocol::PARTIAL_INDEPENDENT,
        }
    }
}

pub fn run(args: &Args) -> Result<Status> {
    output::on_threads(args.threads, || compare(args))?
}

/// `NAME`, or `NAME=WEIGHTS`.
fn evaluated(method: &str) -> Result<EvaluatedMethod> {
    let method = method.trim();
    let Some((name, path)) = method.split_once('=') else { return Ok(EvaluatedMethod::by_name(method)?) };
    if name.is_empty() {
        bail!("--methods {method}: a name is wanted before the weights");
    }
    let path = Path::new(path);
    #[cfg(feature = "train")]
    {
        let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
        let file = TensorFile::from_bytes(&bytes, path)?;
        let network = Learned::restore(&file, path, &upcr_lab::Device::flex())?;
        if !matches!(network, Learned::Upcr(_)) {
            return Ok(EvaluatedMethod::learned(name, network));
        }
    }
    Ok(EvaluatedMethod::by_name("upcr")?.with_network(name, Network::load(path)?))
}

fn compare(args: &Args) -> Result<Status> {
    if let Some(path) = &args.out {
        output::check_folder(path)?;
        if path.extension().is_some_and(|extension| extension == "csv") {
            bail!("{}: --out names the JSON file; the CSV file comes beside it", path.display());
        }
    }
    let methods: Vec<EvaluatedMethod> =
        args.methods.iter().map(|method| evaluated(method)).collect::<Result<_>>()?;
    let mut settings = Settings::default();
    if let Some(path) = &args.weights {
        settings.network = Some(Arc::new(Network::load(path)?));
    }
    let mut progress = Progress::new();
    let mut rows = Vec::new();
    for pairs in &args.protocol {
        let name = pairs.to_possible_value().map_or(String::new(), |value| value.get_name().to_owned());
        progress.step("reading");
        let mut shapes = pairs.shapes(&args.data, Split::Test)?;
        shapes.truncate(args.pairs.map_or(usize::MAX, std::num::NonZeroUsize::get));
        for overlap in &args.overlap {
            let mut protocol = overlap.protocol().with_outliers(args.outliers);
            if *pairs == Pairs::Nd {
                protocol = protocol.noisy();
            }
            for method in &methods {
                let all = shapes.len();
                let mut told = |done: usize| {
                    if done.is_multiple_of(16) {
                        progress.step(&format!("{name}, {}: {done} of {all}", method.name));
                    }
                };
                rows.push(evaluate(method, &settings, &shapes, (&name, &protocol), &mut told)?);
            }
        }
    }
    drop(progress);
    if let Some(path) = &args.out {
        let report = serde_json::json!({
            "results": rows,
            "settings": {
                "data": args.data,
                "methods": args.methods,
                "weights": args.weights,
                "outliers": args.outliers,
                "threads": rayon::current_num_threads(),
                "version": env!("CARGO_PKG_VERSION"),
                "command": std::env::args().collect::<Vec<_>>(),
            },
        });
        let text = serde_json::to_string_pretty(&report)?;
        write_atomically(path, text.as_bytes())?;
        write_atomically(&path.with_extension("csv"), csv(&rows).as_bytes())?;
    }
    output::answer(&markdown(&rows))?;
    Ok(Status::Done)
}
