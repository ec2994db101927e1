//! The options of reading a cloud, shared by the commands.

use std::path::Path;

use anyhow::anyhow;
use upcr::error::CloudRole;

use upcr::{Error, PointCloud};

use crate::pending::io::{self, ReadOptions};

#[derive(clap::Args)]
#[command(next_help_heading = "Reading meshes and depth images")]
pub struct Args {
    /// Points to sample from a mesh
    #[arg(long, value_name = "N", default_value_t = ReadOptions::default().mesh_samples)]
    mesh_samples: usize,
    /// Pinhole intrinsics of a depth image, in pixels
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = intrinsics)]
    intrinsics: Option<[f64; 4]>,
    /// Depth image values to one unit of length
    #[arg(long, value_name = "N", default_value_t = ReadOptions::default().depth_scale)]
    depth_scale: f64,
}

impl Args {
    /// Reads the cloud at `path`.
    pub fn read(&self, path: &Path) -> Result<PointCloud, Error> {
        let mut options = ReadOptions {
            mesh_samples: self.mesh_samples,
            depth_scale: self.depth_scale,
            ..ReadOptions::default()
        };
        if self.intrinsics.is_some() {
            options.intrinsics = self.intrinsics;
        }
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

fn intrinsics(text: &str) -> anyhow::Result<[f64; 4]> {
    let values = text.split(',').map(|v| v.trim().parse()).collect::<Result<Vec<f64>, _>>()?;
    values.try_into().map_err(|_| anyhow!("four numbers are needed"))
}
