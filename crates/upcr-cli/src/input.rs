//! The options of reading a cloud, shared by the commands.

use std::num::ParseFloatError;
use std::path::Path;

use anyhow::{Context, bail};
use upcr::error::CloudRole;
use upcr::io::{self, Intrinsics, ReadOptions};
use upcr::{Error, PointCloud};

#[derive(clap::Args)]
#[command(next_help_heading = "Reading files")]
pub struct Reading {
    /// Points to sample from a mesh
    #[arg(long, value_name = "N", default_value_t = ReadOptions::default().mesh_samples)]
    mesh_samples: usize,
    /// Seed of that sampling
    #[arg(long, value_name = "N", default_value_t = ReadOptions::default().seed)]
    mesh_seed: u64,
    /// Pinhole intrinsics of a depth image, in pixels [default: a Kinect's, for 640x480 images]
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = intrinsics)]
    intrinsics: Option<Intrinsics>,
    /// Depth image units per metre
    #[arg(long, value_name = "N", default_value_t = ReadOptions::default().depth_scale)]
    depth_scale: f64,
    /// Where the sensor stood, in the frame and unit of the file; one value for all files, each in its own frame. Files that
    /// say it themselves win. 0,0,0 is right for scans as a lidar or a depth camera gives them, not for every scan that
    /// has a frame of its own, and nothing is for clouds merged from several
    #[arg(long, value_name = "X,Y,Z", value_parser = viewpoint, allow_hyphen_values = true)]
    viewpoint: Option<Viewpoint>,
}

/// A place in a cloud's frame.
#[derive(Clone, Copy)]
struct Viewpoint([f64; 3]);

impl Reading {
    /// Reads the cloud at `path`.
    pub fn read(&self, path: &Path) -> Result<PointCloud, Error> {
        let options = ReadOptions {
            mesh_samples: self.mesh_samples,
            seed: self.mesh_seed,
            intrinsics: self.intrinsics,
            depth_scale: self.depth_scale,
            viewpoint: self.viewpoint.map(|Viewpoint(place)| place),
        };
        io::read_cloud_with(path, &options)
    }
}

/// Tells by its file which cloud an error speaks of.
pub fn name_file(error: Error, source: &Path, target: &Path) -> anyhow::Error {
    let path = match &error {
        Error::TooFewPoints { role, .. } | Error::NonFinite { role, .. } | Error::Degenerate { role, .. } => {
            if *role == CloudRole::Target {
                target
            } else {
                source
            }
        }
        _ => return error.into(),
    };
    let path = path.display().to_string();
    anyhow::Error::new(error).context(path)
}

/// What files are called in a page that may be sent to others: without their folders, where that tells them apart.
pub fn short_names(paths: &[&Path]) -> Vec<String> {
    let short: Vec<_> = paths.iter().map(|path| path.file_name().unwrap_or(path.as_os_str())).collect();
    let alike = (1..short.len()).any(|i| short[..i].contains(&short[i]));
    let named = |(path, name): (&&Path, _)| {
        if alike { path.display().to_string() } else { Path::new(name).display().to_string() }
    };
    paths.iter().zip(short).map(named).collect()
}

fn intrinsics(text: &str) -> anyhow::Result<Intrinsics> {
    let [fx, fy, cx, cy] = numbers(text)?[..] else { bail!("four numbers are needed") };
    Ok(Intrinsics { fx, fy, cx, cy })
}

fn viewpoint(text: &str) -> anyhow::Result<Viewpoint> {
    match numbers(text).as_deref() {
        Ok(&[x, y, z]) if [x, y, z].iter().all(|v| v.is_finite()) => Ok(Viewpoint([x, y, z])),
        _ => bail!("three finite numbers are needed, as in 0,0,0"),
    }
}

fn numbers(text: &str) -> Result<Vec<f64>, ParseFloatError> {
    text.split(',').map(|v| v.trim().parse()).collect()
}

/// A number of bytes, such as 2000000, 512M or 2G.
pub fn bytes(text: &str) -> anyhow::Result<u64> {
    const UNITS: [(char, u32); 4] = [('K', 10), ('M', 20), ('G', 30), ('T', 40)];
    let unit = UNITS.iter().find(|(unit, _)| text.ends_with([*unit, unit.to_ascii_lowercase()]));
    let (digits, shift) = unit.map_or((text, 0), |&(_, shift)| (&text[..text.len() - 1], shift));
    let number: u64 = digits.parse().context("a whole number, with K, M, G or T behind it, is needed")?;
    number.checked_mul(1 << shift).context("more than there is")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_short_where_they_differ() {
        let names = |paths: &[&str]| short_names(&paths.iter().map(Path::new).collect::<Vec<_>>());
        assert_eq!(names(&["/data/a.ply", "b/c.ply"]), ["a.ply", "c.ply"]);
        assert_eq!(names(&["x/a.ply", "y/a.ply", "b.ply"]), ["x/a.ply", "y/a.ply", "b.ply"]);
        assert_eq!(names(&[".."]), [".."]);
    }
}
