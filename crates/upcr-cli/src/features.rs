//! `upcr features`: one descriptor a point, into a NumPy file.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Result;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde::Serialize;
use upcr::cloud::Support;
use upcr::features::{self, DescribeTimings, Feature};
use upcr::io;

use crate::Status;
use crate::input;
use crate::output::{self, Progress};

/// Compute a pose-invariant descriptor of every point
#[derive(clap::Args)]
pub struct Args {
    /// The cloud to describe; its normals are estimated where it has none
    cloud: PathBuf,
    /// The descriptor
    #[arg(long, value_parser = kinds())]
    kind: &'static dyn Feature,
    /// Neighbours of a point, itself included
    #[arg(short, default_value_t = features::DEFAULT_K)]
    k: usize,
    /// Take the neighbours within this distance, in the cloud's unit, instead of the nearest K
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true, conflicts_with = "k")]
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
    reading: input::Reading,
}

fn kinds() -> impl TypedValueParser<Value = &'static dyn Feature> {
    PossibleValuesParser::new(features::ALL.iter().map(|feature| feature.name()))
        .try_map(|name| features::by_name(&name).ok_or("no such feature"))
}

#[derive(Serialize)]
struct Report {
    points: usize,
    kind: &'static str,
    dim: usize,
    timings_ms: DescribeTimings,
}

pub fn run(args: &Args) -> Result<Status> {
    let mut progress = Progress::new();
    progress.step("reading");
    let cloud = args.reading.read(&args.cloud)?;
    progress.step("computing");
    let support = args.radius.map_or(Support::Nearest(args.k), Support::Radius);
    let (descriptors, timings_ms) = features::describe(&cloud, args.kind, support, args.threads)
        .map_err(|error| input::name_file(error, &args.cloud, &args.cloud))?;
    if let Some(path) = &args.output {
        progress.step("writing");
        io::write_array(path, [descriptors.len(), descriptors.dim], &descriptors.values)?;
    }
    drop(progress);

    let report = Report { points: cloud.len(), kind: args.kind.name(), dim: descriptors.dim, timings_ms };
    if args.json {
        output::answer_json(&report)?;
    } else {
        let ms = &report.timings_ms;
        output::answer(&format!(
            "points  {}\nvalues  {} a point\ntime    {:.1} ms (neighbors {:.1}, normals {:.1}, feature {:.1}), reading not counted\n",
            report.points, report.dim, ms.total, ms.neighbors, ms.normals, ms.feature
        ))?;
    }
    Ok(Status::Done)
}
