//! `upcr convert`: from one format to another, thinned or moved on the way.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use upcr::io::{self, Encoding};

use crate::Status;
use crate::input;
use crate::output::{Progress, note};

/// Convert a cloud to another format, told by the file's extension
#[derive(clap::Args)]
pub struct Args {
    /// The cloud, mesh or depth image to read
    input: PathBuf,
    /// The cloud to write
    output: PathBuf,
    /// Leave out points with NaN or infinite coordinates
    #[arg(long)]
    remove_invalid: bool,
    /// Leave out statistical outliers: points whose mean distance to their K nearest is more than RATIO standard
    /// deviations above the average
    #[arg(long, value_name = "K,RATIO", value_parser = outliers)]
    remove_outliers: Option<(usize, f64)>,
    /// Keep one point, the mean, of every cube of this edge, in the cloud's unit
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    voxel_size: Option<f64>,
    /// Keep so many points, each the farthest from those kept before
    #[arg(long, value_name = "N", conflicts_with = "random")]
    farthest: Option<usize>,
    /// Keep so many points, drawn at random
    #[arg(long, value_name = "N")]
    random: Option<usize>,
    /// Seed of that drawing
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Multiply all lengths by this, e.g. 0.001 to make metres of millimetres; before `--transform`
    #[arg(long, value_name = "FACTOR", value_parser = factor, allow_negative_numbers = true)]
    scale: Option<f64>,
    /// Move the cloud by the pose in this text file (a 4x4 row-major matrix)
    #[arg(long, value_name = "FILE")]
    transform: Option<PathBuf>,
    /// Write text instead of binary (PLY, PCD)
    #[arg(long, conflicts_with = "compressed")]
    ascii: bool,
    /// Write compressed binary (PCD)
    #[arg(long)]
    compressed: bool,
    #[command(flatten)]
    reading: input::Reading,
}

impl Args {
    fn encoding(&self) -> Encoding {
        match (self.ascii, self.compressed) {
            (true, _) => Encoding::Ascii,
            (_, true) => Encoding::Compressed,
            _ => Encoding::default(),
        }
    }
}

fn outliers(text: &str) -> Result<(usize, f64)> {
    let (k, ratio) = text.split_once(',').context("two numbers are needed, as in 20,2")?;
    let (k, ratio): (usize, f64) = (k.trim().parse()?, ratio.trim().parse()?);
    ensure!(k > 0 && ratio.is_finite() && ratio >= 0.0, "K must be positive and RATIO not negative");
    Ok((k, ratio))
}

fn factor(text: &str) -> Result<f64> {
    let factor: f64 = text.trim().parse()?;
    ensure!(factor.is_finite() && factor > 0.0, "a positive number is needed");
    Ok(factor)
}

pub fn run(args: &Args) -> Result<Status> {
    let mut progress = Progress::new();
    progress.step("reading");
    let mut points = args.reading.read(&args.input)?;
    let read = points.len();
    if args.remove_invalid {
        points = points.finite();
    }
    let named = |error| input::name_file(error, &args.input, &args.input);
    if let Some((k, ratio)) = args.remove_outliers {
        progress.step("removing outliers");
        points = points.without_outliers(k, ratio).map_err(named)?;
    }
    if let Some(size) = args.voxel_size {
        progress.step("downsampling");
        points = points.voxel_downsample(size).map_err(named)?;
    }
    if let Some(count) = args.farthest {
        progress.step("sampling");
        points = points.farthest_sample(count).map_err(named)?;
    }
    if let Some(count) = args.random {
        points = points.random_sample(count, args.seed);
    }
    if let Some(factor) = args.scale {
        points = points.scaled(factor);
    }
    if let Some(path) = &args.transform {
        points = points.transformed(&io::read_transform(path)?);
    }
    progress.step("writing");
    io::write_cloud_with(&args.output, &points, &io::WriteOptions { encoding: args.encoding() })?;
    drop(progress);
    note(&format!("{}: {} of {read} points", args.output.display(), points.len()));
    Ok(Status::Done)
}
