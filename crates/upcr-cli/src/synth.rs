//! `upcr synth`: scans of a made-up scene, with their true poses.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::ValueEnum;
use upcr::io;
use upcr_lab::data::scanner::{RangeNoise, Scene, Sensor, SynthSettings, synth};

use crate::output::{self, Progress};

const AFTER_HELP: &str = "\
Files written:
  scan_000.ply, scan_001.ply, ...   the scans, each in its sensor's frame
  T_world_000.txt, ...              pose of each scan in the world
  T_000_001.txt, ...                pose of each scan in the frame of the one before it: what
                                    `upcr register scan_001.ply scan_000.ply` should find";

/// Make scans of a synthetic scene, with their true poses
#[derive(clap::Args)]
#[command(after_help = AFTER_HELP)]
pub struct Args {
    /// What is scanned
    #[arg(long, value_enum, default_value_t = Place::Room)]
    scene: Place,
    /// Scan this mesh from all around, instead of a scene
    #[arg(long, value_name = "FILE", conflicts_with = "scene")]
    mesh: Option<PathBuf>,
    /// What scans [default: what suits the scene]
    #[arg(long, value_enum)]
    sensor: Option<Device>,
    /// Number of scans
    #[arg(long, value_name = "N", default_value_t = SynthSettings::new(Scene::Room).scans)]
    scans: usize,
    /// Share of a scan that the next one is to see too, between 0 and 1
    #[arg(long, value_name = "SHARE", default_value_t = SynthSettings::new(Scene::Room).overlap)]
    overlap: f64,
    /// Turn every scan about its sensor by a random rotation
    #[arg(long)]
    turned: bool,
    /// Standard deviation of the range noise, alike at all distances; 0 switches all noise off [default: the
    /// sensor's]
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    noise: Option<f64>,
    /// Seed of every random choice
    #[arg(long, default_value_t = SynthSettings::new(Scene::Room).seed)]
    seed: u64,
    /// Folder for the scans and their poses; made where missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Clone, Copy, ValueEnum)]
enum Place {
    /// A statue, from all around
    Object,
    /// A furnished room, from inside
    Room,
    /// A street, driving along it
    Street,
    /// Rocky ground, driving over it
    Terrain,
}

#[derive(Clone, Copy, ValueEnum)]
enum Device {
    /// A hand-held depth camera
    Camera,
    /// A vehicle's lidar
    Lidar,
}

impl Args {
    fn settings(&self) -> Result<SynthSettings> {
        let scene = match (&self.mesh, self.scene) {
            (Some(path), _) => Scene::Mesh(io::read_mesh(path)?),
            (None, Place::Object) => Scene::Object,
            (None, Place::Room) => Scene::Room,
            (None, Place::Street) => Scene::Street,
            (None, Place::Terrain) => Scene::Terrain,
        };
        let mut settings = SynthSettings::new(scene);
        match self.sensor {
            Some(Device::Camera) => settings.sensor = Sensor::HAND_HELD,
            Some(Device::Lidar) => settings.sensor = Sensor::ON_VEHICLE,
            None => {}
        }
        match self.noise {
            Some(0.0) => settings.sensor.noise = RangeNoise::NONE,
            Some(constant_m) => {
                let kept = settings.sensor.noise;
                settings.sensor.noise = RangeNoise { constant_m, linear: 0.0, quadratic_per_m: 0.0, ..kept };
            }
            None => {}
        }
        Ok(SynthSettings {
            scans: self.scans,
            overlap: self.overlap,
            turned: self.turned,
            seed: self.seed,
            ..settings
        })
    }
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let mut progress = Progress::new();
    progress.step("scanning");
    let scans = synth(&args.settings()?)?;
    progress.step("writing");
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    let file = |name: String| Path::join(&args.out, name);
    for (k, scan) in scans.iter().enumerate() {
        io::write_cloud(file(format!("scan_{k:03}.ply")), &scan.cloud)?;
        io::write_transform(file(format!("T_world_{k:03}.txt")), &scan.T_world_sensor)?;
        if let Some(before) = k.checked_sub(1) {
            let T_before_scan = scans[before].T_world_sensor.inverse() * scan.T_world_sensor;
            io::write_transform(file(format!("T_{before:03}_{k:03}.txt")), &T_before_scan)?;
        }
    }
    drop(progress);

    for (k, scan) in scans.iter().enumerate() {
        let path = file(format!("scan_{k:03}.ply"));
        let shared = scan.overlaps.get(k + 1).map(|o| format!(", {:.0} % seen by the next", 100.0 * o));
        let shared = shared.unwrap_or_default();
        output::answer(&format!("{}: {} points{shared}\n", path.display(), scan.cloud.len()))?;
    }
    Ok(ExitCode::SUCCESS)
}
