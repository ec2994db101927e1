//! `upcr synth`: scans of a made-up scene, with their true poses.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;

use crate::output::{self, Progress};
use crate::pending::scanner::{Scene, Sensor, SynthSettings, write_scans};

/// Make scans of a synthetic scene, with their true poses
#[derive(clap::Args)]
pub struct Args {
    /// What is scanned
    #[arg(long, value_enum, default_value_t = SynthSettings::default().scene)]
    scene: Scene,
    /// What scans
    #[arg(long, value_enum, default_value_t = SynthSettings::default().sensor)]
    sensor: Sensor,
    /// Number of scans
    #[arg(long, value_name = "N", default_value_t = SynthSettings::default().scans)]
    scans: usize,
    /// Standard deviation of the range noise
    #[arg(long, value_name = "LENGTH", default_value_t = SynthSettings::default().noise, allow_negative_numbers = true)]
    noise: f64,
    /// Seed of every random choice
    #[arg(long, default_value_t = SynthSettings::default().seed)]
    seed: u64,
    /// Folder for the scans and their poses; made where missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let settings = SynthSettings {
        scene: args.scene,
        sensor: args.sensor,
        scans: args.scans,
        noise: args.noise,
        seed: args.seed,
    };
    let mut progress = Progress::new();
    progress.step("scanning");
    let files = write_scans(&args.out, &settings)?;
    drop(progress);
    for file in files {
        output::answer(&format!("{}\n", file.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}
