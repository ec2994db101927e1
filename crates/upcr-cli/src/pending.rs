//! Calls that the libraries do not have yet, each under the path it will have there. To be deleted.
#![allow(clippy::unnecessary_wraps)]

pub mod io {
    use std::path::Path;
    use upcr::{Error, PointCloud, Result, Rigid, features::Descriptors};

    #[derive(Clone, Copy)]
    pub struct Intrinsics {
        pub fx: f64,
        pub fy: f64,
        pub cx: f64,
        pub cy: f64,
    }
    pub struct ReadOptions {
        pub mesh_samples: usize,
        pub seed: u64,
        pub intrinsics: Option<Intrinsics>,
        pub depth_scale: f64,
    }
    impl Default for ReadOptions {
        fn default() -> Self {
            Self { mesh_samples: 100_000, seed: 0, intrinsics: None, depth_scale: 1000.0 }
        }
    }
    #[derive(Default)]
    pub enum Encoding {
        #[default]
        Binary,
        Ascii,
        Compressed,
    }
    #[derive(Default)]
    pub struct WriteOptions {
        pub encoding: Encoding,
    }
    fn missing<T>(path: &Path) -> Result<T> {
        std::fs::metadata(path).map_err(|source| Error::Io { path: path.into(), source })?;
        Err(Error::Unsupported { path: path.into(), reason: "not there yet".into() })
    }
    pub fn read_cloud_with(path: &Path, options: &ReadOptions) -> Result<PointCloud> {
        let _ = (options.mesh_samples, options.seed, options.depth_scale);
        let _ = options.intrinsics.map(|i| (i.fx, i.fy, i.cx, i.cy));
        missing(path)
    }
    pub fn read_transform(path: &Path) -> Result<Rigid> {
        missing(path)
    }
    pub fn write_transform(path: &Path, _: &Rigid) -> Result<()> {
        missing(path)
    }
    pub fn write_cloud(path: &Path, _: &PointCloud) -> Result<()> {
        missing(path)
    }
    pub fn write_cloud_with(path: &Path, cloud: &PointCloud, options: &WriteOptions) -> Result<()> {
        let _ = matches!(options.encoding, Encoding::Binary);
        write_cloud(path, cloud)
    }
    pub fn write_npy(path: &Path, _: &Descriptors) -> Result<()> {
        missing(path)
    }
}

pub mod cloud {
    use upcr::{PointCloud, Result};
    pub fn voxel_downsample(cloud: &PointCloud, size: f64) -> Result<PointCloud> {
        let _ = size;
        Ok(cloud.clone())
    }
}

pub mod features {
    use serde::Serialize;
    use upcr::{PointCloud, Result, features::Descriptors};

    #[derive(Clone, Copy, clap::ValueEnum, Serialize)]
    #[serde(rename_all = "lowercase")]
    pub enum FeatureKind {
        Distance,
        Ppf,
        Spfh,
        Pfh,
        Fpfh,
    }
    pub struct FeatureSettings {
        pub kind: FeatureKind,
        pub k: usize,
        pub radius: Option<f64>,
        pub threads: Option<std::num::NonZeroUsize>,
    }
    impl Default for FeatureSettings {
        fn default() -> Self {
            Self { kind: FeatureKind::Fpfh, k: 24, radius: None, threads: None }
        }
    }
    #[derive(Serialize)]
    pub struct Report {
        pub points: usize,
        pub kind: FeatureKind,
        pub dim: usize,
        pub timings_ms: Timings,
    }
    #[derive(Serialize, Default)]
    pub struct Timings {
        pub neighbors: f64,
        pub normals: f64,
        pub feature: f64,
        pub total: f64,
    }
    pub fn describe(cloud: &PointCloud, settings: &FeatureSettings) -> Result<(Descriptors, Report)> {
        let FeatureSettings { kind, k: _, radius, threads } = *settings;
        let _ = (radius, threads);
        Ok((
            Descriptors::default(),
            Report { points: cloud.len(), kind, dim: 0, timings_ms: Timings::default() },
        ))
    }
}

pub mod scanner {
    use std::path::{Path, PathBuf};

    #[derive(Clone, Copy, clap::ValueEnum)]
    pub enum Scene {
        Rooms,
    }
    #[derive(Clone, Copy, clap::ValueEnum)]
    pub enum Sensor {
        Lidar,
    }
    pub struct SynthSettings {
        pub scene: Scene,
        pub sensor: Sensor,
        pub scans: usize,
        pub noise: f64,
        pub seed: u64,
    }
    impl Default for SynthSettings {
        fn default() -> Self {
            Self { scene: Scene::Rooms, sensor: Sensor::Lidar, scans: 2, noise: 0.0, seed: 0 }
        }
    }
    pub fn write_scans(dir: &Path, settings: &SynthSettings) -> upcr::Result<Vec<PathBuf>> {
        let SynthSettings { scene: _, sensor: _, scans: _, noise: _, seed: _ } = settings;
        Err(upcr::Error::Unsupported { path: dir.into(), reason: "not there yet".into() })
    }
}
