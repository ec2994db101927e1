//! `upcr import`: the published networks' weights, as this program keeps them.

use std::path::PathBuf;

use anyhow::Result;
use upcr_lab::Device;
use upcr_lab::files::write_atomically;
use upcr_lab::models::{Learned, pytorch};

use crate::Status;
use crate::output;

/// Convert weights of PointNetLK, DCP or PRNet that their authors published
#[derive(clap::Args)]
pub struct Args {
    /// A file that PyTorch wrote (.t7, .pt, .pth)
    weights: PathBuf,
    /// The same as safetensors; `upcr eval --methods NAME=FILE` runs it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<Status> {
    output::check_folder(&args.out)?;
    let network = Learned::published(&pytorch::read(&args.weights)?, &args.weights, &Device::flex())?;
    write_atomically(&args.out, &network.store().to_bytes()?)?;
    output::answer(&format!("{}\n", serde_json::to_string(&network.config())?))?;
    Ok(Status::Done)
}
