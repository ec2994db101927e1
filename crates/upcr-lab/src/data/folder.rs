//! A folder of clouds or meshes, in any of the library's formats, as shapes of one category.
//!
//! Files are taken in the order of their names; folders inside are not looked into, and poses (`*.pose.txt`,
//! `T_*.txt`) are left out. Of five shapes the last is for tests.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use upcr::{Error, PointCloud, Result, io};

use super::normalize::{sample, unit_sphere};
use super::{DataSet, Shapes, Split};
use crate::random;

pub(super) const DATA_SET: DataSet = DataSet {
    what: "a folder of clouds or meshes",
    recognise: |path| files(path).is_ok_and(|files| !files.is_empty()),
    read,
};

/// One shape in so many is for tests.
const TEST_SHARE: usize = 5;

fn read(folder: &Path, split: Split) -> Result<Shapes> {
    let for_test = |i: usize| i % TEST_SHARE == TEST_SHARE - 1;
    let files: Vec<(usize, PathBuf)> = files(folder)?
        .into_iter()
        .enumerate()
        .filter(|&(i, _)| split == Split::All || for_test(i) == (split == Split::Test))
        .collect();
    let clouds = files.par_iter().map(|(i, path)| read_shape(path, *i)).collect::<Result<Vec<_>>>()?;
    let name = folder.file_name().unwrap_or(OsStr::new("shapes")).to_string_lossy();
    Ok(Shapes { labels: vec![0; clouds.len()], clouds, names: vec![name.into_owned()] })
}

fn read_shape(path: &Path, index: usize) -> Result<Vec<[f32; 3]>> {
    shape(&io::read_cloud(path)?, index)
        .map_err(|error| Error::Unsupported { path: path.to_owned(), reason: error.to_string() })
}

fn shape(cloud: &PointCloud, index: usize) -> Result<Vec<[f32; 3]>> {
    // Scanners write NaN where they saw nothing.
    unit_sphere(&sample(cloud.finite(), &mut random::stream(random::fnv1a("folder"), index as u64)))
}

impl Shapes {
    /// Clouds in memory as shapes of one category: those that a folder gives that holds them in this order, after `before`
    /// others.
    ///
    /// # Errors
    /// Where a cloud has no two different points that are finite.
    pub fn from_clouds(clouds: &[PointCloud], before: usize) -> Result<Self> {
        let shapes: Vec<_> = clouds
            .par_iter()
            .enumerate()
            .map(|(i, cloud)| shape(cloud, before + i))
            .collect::<Result<_>>()?;
        Ok(Self { labels: vec![0; shapes.len()], clouds: shapes, names: vec!["shapes".into()] })
    }
}

/// The clouds' files, by name.
fn files(folder: &Path) -> Result<Vec<PathBuf>> {
    let list = || -> std::io::Result<Vec<PathBuf>> {
        let paths = folder.read_dir()?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        let is_pose = |path: &Path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.ends_with(".pose.txt") || (name.starts_with("T_") && name.ends_with(".txt"))
        };
        let is_cloud = |path: &PathBuf| path.is_file() && io::format_name(path).is_some() && !is_pose(path);
        let mut files: Vec<PathBuf> = paths.into_iter().filter(is_cloud).collect();
        files.sort();
        Ok(files)
    };
    list().map_err(|source| Error::Io { path: folder.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data;
    use crate::data::tests::published;

    #[test]
    fn clouds_come_by_name_and_every_fifth_is_for_tests() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        // The cloud i has i + 3 points on a line, about a far place.
        for i in 0..6 {
            let points = (0..i + 3).map(|k| [1e5 + f64::from(k), 0.0, 0.0]).collect();
            let name = format!("{i}.{}", ["ply", "xyz", "pcd"][i as usize % 3]);
            io::write_cloud(at(&name), &PointCloud::from_points(points)).unwrap();
        }
        for pose in ["0.pose.txt", "T_0_1.txt"] {
            std::fs::write(at(pose), "no cloud").unwrap();
        }
        std::fs::create_dir(at("7.ply")).unwrap();
        let sizes = |split| -> Vec<usize> {
            data::open(folder.path(), split).unwrap().clouds.iter().map(Vec::len).collect()
        };
        assert_eq!(sizes(Split::Train), [3, 4, 5, 6, 8]);
        assert_eq!(sizes(Split::Test), [7]);
        assert_eq!(sizes(Split::All), [3, 4, 5, 6, 7, 8]);
        let read: Vec<PointCloud> =
            files(folder.path()).unwrap().iter().map(|path| io::read_cloud(path).unwrap()).collect();
        let whole = data::open(folder.path(), Split::All).unwrap();
        assert_eq!(Shapes::from_clouds(&read, 0).unwrap().clouds, whole.clouds);
        assert_eq!(Shapes::from_clouds(&read[2..], 2).unwrap().clouds, whole.clouds[2..]);
        let mut along: Vec<f32> =
            data::open(folder.path(), Split::All).unwrap().clouds[0].iter().map(|p| p[0]).collect();
        along.sort_by(f32::total_cmp);
        assert_eq!(along, [-1.0, 0.0, 1.0]);

        io::write_cloud(at("8.ply"), &PointCloud::from_points(vec![[1.0; 3]; 9])).unwrap();
        let error = data::open(folder.path(), Split::Train).unwrap_err().to_string();
        assert!(error.contains("8.ply") && error.contains("degenerate"), "{error}");
    }

    #[test]
    fn published_scans() {
        let Some(folder) = published("stanford_bunny") else { return };
        let shapes = data::open(folder, Split::All).unwrap();
        assert_eq!(shapes.len(), 10);
        assert!(shapes.clouds.iter().all(|cloud| cloud.len() == 2048));
    }
}
