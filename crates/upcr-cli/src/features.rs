//! `upcr features`: one descriptor a point, into a NumPy file.

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;

use crate::output::{self, Progress};
use crate::pending::features::{FeatureKind, FeatureSettings, describe};
use crate::{input, pending::io};

/// Compute a pose-invariant descriptor of every point
#[derive(clap::Args)]
pub struct Args {
    /// The cloud to describe
    cloud: PathBuf,
    /// The descriptor
    #[arg(long, value_enum)]
    kind: FeatureKind,
    /// Neighbours of a point, itself included
    #[arg(short, default_value_t = FeatureSettings::default().k)]
    k: usize,
    /// Take the neighbours within this distance, in the cloud's unit, instead of the nearest K
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    radius: Option<f64>,
    /// Threads to use; the result does not depend on it [default: all]
    #[arg(long)]
    threads: Option<NonZeroUsize>,
    /// Write the descriptors, one row of 32-bit floats a point
    #[arg(short, long, value_name = "NPY")]
    output: Option<PathBuf>,
    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    reading: input::Args,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let mut progress = Progress::new();
    progress.step("reading");
    let cloud = args.reading.read(&args.cloud)?;
    progress.step("computing");
    let settings = FeatureSettings { kind: args.kind, k: args.k, radius: args.radius, threads: args.threads };
    let (descriptors, report) =
        describe(&cloud, &settings).map_err(|error| input::name_file(error, &args.cloud, &args.cloud))?;
    progress.step("writing");
    if let Some(path) = &args.output {
        io::write_npy(path, &descriptors)?;
    }
    drop(progress);

    if args.json {
        output::answer_json(&report)?;
    } else {
        let ms = &report.timings_ms;
        output::answer(&format!(
            "points  {}\nvalues  {} a point\ntime    {:.1} ms (neighbors {:.1}, normals {:.1}, feature {:.1}), reading not counted\n",
            report.points, report.dim, ms.total, ms.neighbors, ms.normals, ms.feature
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}
