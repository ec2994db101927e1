//! `upcr synth`: scans of a made-up scene, with their true poses.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use upcr::io;
use upcr_lab::data::scanner::{Optics, RangeNoise, Scene, Sensor, SynthSettings, synth};

use crate::Status;
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
    /// Image size of a camera in pixels, its field of view staying the same [default: 640x480]
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[usize; 2]>,
    /// Lasers of a lidar [default: 64]
    #[arg(long, value_name = "N")]
    beams: Option<usize>,
    /// Measurements of each laser in a full turn [default: 1024]
    #[arg(long, value_name = "N")]
    azimuth_steps: Option<usize>,
    /// Shortest and longest range that is measured [default: the sensor's]
    #[arg(long, value_name = "MIN,MAX", value_parser = range)]
    range: Option<[f64; 2]>,
    /// Standard deviation of the range noise, alike at all distances; 0 switches all noise off [default: the
    /// sensor's]
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    noise: Option<f64>,
    /// Probability that a ray returns nothing [default: the sensor's]
    #[arg(long, value_name = "SHARE", allow_negative_numbers = true)]
    dropout: Option<f64>,
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
    /// A storey of furnished rooms, carrying a scanner through them; the more scans, the more rooms
    Building,
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
            (None, Place::Building) => Scene::Building,
        };
        let mut settings = SynthSettings::new(scene);
        // Where the scene's own sensor is of the kind asked for, it suits the scene better than any other.
        match (self.sensor, settings.sensor.optics) {
            (Some(Device::Camera), Optics::Lidar(_)) => settings.sensor = Sensor::HAND_HELD,
            (Some(Device::Lidar), Optics::DepthCamera(_)) => settings.sensor = Sensor::ON_VEHICLE,
            _ => {}
        }
        match &mut settings.sensor.optics {
            Optics::DepthCamera(_) if self.beams.or(self.azimuth_steps).is_some() => {
                bail!("--beams and --azimuth-steps are for a lidar, and this sensor is a camera");
            }
            Optics::Lidar(_) if self.size.is_some() => {
                bail!("--size is for a camera, and this sensor is a lidar");
            }
            Optics::DepthCamera(camera) => {
                if let Some([width, height]) = self.size {
                    *camera = camera.resized(width, height);
                }
            }
            Optics::Lidar(lidar) => {
                lidar.beams = self.beams.unwrap_or(lidar.beams);
                lidar.azimuth_steps = self.azimuth_steps.unwrap_or(lidar.azimuth_steps);
            }
        }
        settings.sensor.range_m = self.range.unwrap_or(settings.sensor.range_m);
        match self.noise {
            Some(0.0) => settings.sensor.noise = RangeNoise::NONE,
            Some(constant_m) => {
                let kept = settings.sensor.noise;
                settings.sensor.noise = RangeNoise { constant_m, linear: 0.0, quadratic_per_m: 0.0, ..kept };
            }
            None => {}
        }
        let noise = &mut settings.sensor.noise;
        noise.dropout = self.dropout.unwrap_or(noise.dropout);
        Ok(SynthSettings {
            scans: self.scans,
            overlap: self.overlap,
            turned: self.turned,
            seed: self.seed,
            ..settings
        })
    }
}

fn size(text: &str) -> Result<[usize; 2]> {
    let (width, height) = text.split_once('x').context("two numbers with an x between them are needed")?;
    Ok([width.trim().parse()?, height.trim().parse()?])
}

fn range(text: &str) -> Result<[f64; 2]> {
    let (shortest, longest) =
        text.split_once(',').context("two lengths with a comma between them are needed")?;
    Ok([shortest.trim().parse()?, longest.trim().parse()?])
}

pub fn run(args: &Args) -> Result<Status> {
    let mut progress = Progress::new();
    progress.step("scanning");
    let scans = synth(&args.settings()?)?;
    progress.step("writing");
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    let file = |name: String| Path::join(&args.out, name);
    // So many digits that names are in the order of the scans.
    let digits = scans.len().saturating_sub(1).to_string().len().max(3);
    for (k, scan) in scans.iter().enumerate() {
        io::write_cloud(file(format!("scan_{k:0digits$}.ply")), &scan.cloud)?;
        io::write_transform(file(format!("T_world_{k:0digits$}.txt")), &scan.T_world_sensor)?;
        if let Some(before) = k.checked_sub(1) {
            let T_before_scan = scans[before].T_world_sensor.inverse() * scan.T_world_sensor;
            io::write_transform(file(format!("T_{before:0digits$}_{k:0digits$}.txt")), &T_before_scan)?;
        }
    }
    drop(progress);

    for (k, scan) in scans.iter().enumerate() {
        let path = file(format!("scan_{k:0digits$}.ply"));
        let shared = scan.overlap_after.map(|o| format!(", {:.0} % seen by the next", 100.0 * o));
        let shared = shared.unwrap_or_default();
        output::answer(&format!("{}: {} points{shared}\n", path.display(), scan.cloud.len()))?;
    }
    Ok(Status::Done)
}
