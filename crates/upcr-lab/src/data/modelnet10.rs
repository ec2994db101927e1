//! ModelNet10 as an NPZ file of occupancy grids: `X_train`, `y_train`, `X_test`, `y_test`. Empty grids are left out.

use std::path::Path;

use rand::Rng;
use upcr::{Error, PointCloud, Result};

use super::normalize::{SHAPE_POINTS, unit_sphere};
use super::npz::{Array, Npz};
use super::{DataSet, Shapes, Split};
use crate::random;

pub(super) const DATA_SET: DataSet = DataSet {
    what: "an .npz file of voxel grids (X_train, y_train, X_test, y_test)",
    recognise: |path| path.is_file() && path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz")),
    read,
};

/// ModelNet10's categories, in the order of their labels.
const NAMES: [&str; 10] =
    ["bathtub", "bed", "chair", "desk", "dresser", "monitor", "night_stand", "sofa", "table", "toilet"];

fn read(path: &Path, split: Split) -> Result<Shapes> {
    let archive = Npz::open(path)?;
    let mut shapes = Shapes { names: NAMES.map(str::to_owned).to_vec(), ..Shapes::default() };
    for part in split.of(["train", "test"]) {
        let malformed = |reason| Err(Error::Malformed { path: path.to_owned(), format: "NPZ", reason });
        let (mut grids, mut labels) =
            (archive.array(&format!("X_{part}"))?, archive.array(&format!("y_{part}"))?);
        let &[count, depth, height, width] = &grids.shape[..] else {
            return malformed(format!("`X_{part}` has shape {:?}, not that of grids", grids.shape));
        };
        if labels.shape != [count] {
            return malformed(format!("`y_{part}` has shape {:?}, for {count} grids", labels.shape));
        }
        for index in 0..count {
            let voxels = surface(&mut grids, [depth, height, width])?;
            let mut row = Vec::new();
            labels.next_row(&mut row)?;
            let label = labels.number.decode(&row);
            if !(0.0..NAMES.len() as f32).contains(&label) {
                return malformed(format!(
                    "label {label} in `y_{part}`; there are {} categories",
                    NAMES.len()
                ));
            }
            if voxels.is_empty() {
                continue;
            }
            let rng = &mut random::stream(random::fnv1a(part), index as u64);
            shapes.clouds.push(unit_sphere(&sampled(&voxels, rng))?);
            shapes.labels.push(label as u8);
        }
    }
    Ok(shapes)
}

/// Indices of the occupied voxels that have an empty neighbour, or none, on one of their six sides.
fn surface(grids: &mut Array, dims: [usize; 3]) -> Result<Vec<[usize; 3]>> {
    let mut bytes = Vec::new();
    grids.next_row(&mut bytes)?;
    let occupied: Vec<bool> =
        bytes.chunks_exact(grids.number.size).map(|value| value.iter().any(|&b| b != 0)).collect();
    Ok(surface_of(&occupied, dims))
}

fn surface_of(occupied: &[bool], dims: [usize; 3]) -> Vec<[usize; 3]> {
    let strides = [dims[1] * dims[2], dims[2], 1];
    let is_surface = |&(i, voxel): &(usize, [usize; 3])| {
        let bare = |axis: usize| {
            let (at, stride) = (voxel[axis], strides[axis]);
            at == 0 || at + 1 == dims[axis] || !occupied[i - stride] || !occupied[i + stride]
        };
        occupied[i] && (0..3).any(bare)
    };
    let voxel = |i: usize| [i / strides[0], i / strides[1] % dims[1], i % dims[2]];
    (0..occupied.len()).map(|i| (i, voxel(i))).filter(is_surface).map(|(_, voxel)| voxel).collect()
}

/// [`SHAPE_POINTS`] points, each uniform in one of the voxels at random; the edge of a voxel is 1.
fn sampled(voxels: &[[usize; 3]], rng: &mut impl Rng) -> PointCloud {
    let mut point = || {
        let voxel = voxels[rng.random_range(0..voxels.len() as u64) as usize];
        voxel.map(|v| v as f64 + rng.random::<f64>())
    };
    PointCloud::from_points((0..SHAPE_POINTS).map(|_| point()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::{self, tests::published};

    /// Written by NumPy; see tests/npz/make.py: two cubes to train with and one for the test, in grids of 6 × 7 × 8.
    const CUBES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/npz/cubes.npz");

    #[test]
    fn surfaces_have_an_empty_side() {
        // A block of 3 × 3 × 3 in the corner of a larger grid: all but its centre.
        let dims = [5, 4, 6];
        let inside = |i: usize| i / 24 < 3 && i / 6 % 4 < 3 && i % 6 < 3;
        let occupied: Vec<bool> = (0..120).map(inside).collect();
        let voxels = surface_of(&occupied, dims);
        assert_eq!(voxels.len(), 26);
        assert!(!voxels.contains(&[1, 1, 1]));
        assert!(voxels.iter().flatten().all(|&v| v < 3));
    }

    #[test]
    fn points_lie_in_the_surface_voxels() {
        for (split, labels) in [(Split::Train, &[3, 9][..]), (Split::Test, &[0]), (Split::All, &[3, 9, 0])] {
            let shapes = data::open(CUBES, split).unwrap();
            assert_eq!(shapes.labels, labels);
            assert_eq!(shapes, data::open(CUBES, split).unwrap());
        }
        let shapes = data::open(CUBES, Split::Train).unwrap();
        assert_ne!(shapes.clouds[0], shapes.clouds[1]);
        for cloud in &shapes.clouds {
            assert_eq!(cloud.len(), SHAPE_POINTS);
            // The cube has an edge of four voxels. Its half-diagonal, in voxels, is nearly the radius that became 1.
            let radius = 2.0 * 3.0_f32.sqrt();
            let scale = radius
                / cloud.iter().map(|p| p.iter().map(|v| v * v).sum::<f32>().sqrt()).fold(0.0, f32::max);
            let depth = |p: &[f32; 3]| p.iter().map(|v| v.abs() * scale).fold(0.0, f32::max);
            // All within the outer layer, up to the mean's and the radius' chance.
            assert!(cloud.iter().map(depth).all(|d| (0.8..2.3).contains(&d)));
        }
    }

    #[test]
    fn other_archives_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("broken.npz");
        let whole = std::fs::read(CUBES).unwrap();
        // Cut, and with a bit turned in each byte: no panic, and never more than the labels or points change.
        for length in (0..whole.len()).step_by(7) {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert!(data::open(&path, Split::All).is_err());
        }
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 1 << (at % 8);
            std::fs::write(&path, &bytes).unwrap();
            if let Ok(shapes) = data::open(&path, Split::All) {
                assert_eq!(shapes.clouds.len(), shapes.labels.len());
            }
        }
    }

    #[test]
    fn published_voxels() {
        let Some(path) = published("modelnet10_voxel32.npz") else { return };
        // As many as ModelNet10 has of each category, less the 27 and 7 grids that are empty.
        let train = [94, 514, 889, 200, 200, 465, 200, 680, 379, 343];
        let test = [50, 100, 100, 85, 86, 100, 86, 100, 94, 100];
        for (split, counts) in [(Split::Train, train), (Split::Test, test)] {
            let shapes = data::open(&path, split).unwrap();
            let mut found = [0; 10];
            for label in shapes.labels {
                found[usize::from(label)] += 1;
            }
            assert_eq!(found, counts);
            assert!(shapes.clouds.iter().all(|cloud| cloud.len() == SHAPE_POINTS));
        }
    }
}
