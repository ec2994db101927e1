//! One cloud of many scans: a point a cell.

use std::collections::HashMap;

use super::Scans;
use crate::{Error, PointCloud, Result, transform::Rigid};

/// What the points of a cell sum up to.
#[derive(Default)]
struct Cell {
    count: u32,
    /// About the cell's corner.
    sum: [f64; 3],
    colored: u32,
    color: [u32; 3],
}

/// Puts scans into one cloud, each moved by its pose, and thins it to the mean of the points in each cell of `voxel_size`. One
/// scan is held at a time. `progress` hears how many are done.
///
/// # Errors
/// Where a scan cannot be read, or the voxel size is no length.
pub fn fuse(
    scans: &(impl Scans + ?Sized),
    poses: &[(usize, Rigid)],
    voxel_size: f64,
    progress: &dyn Fn(usize),
) -> Result<PointCloud> {
    if !(voxel_size.is_finite() && voxel_size > 0.0) {
        let reason = format!("must be a positive length, not {voxel_size}");
        return Err(Error::InvalidSetting { name: "voxel_size", reason });
    }
    let mut cells: HashMap<[i64; 3], Cell> = HashMap::new();
    for (done, (scan, T_model_scan)) in poses.iter().enumerate() {
        progress(done);
        let cloud = scans.read(*scan)?;
        for (i, &p) in cloud.points.iter().enumerate() {
            let q = T_model_scan.apply(p).map(|v| v / voxel_size);
            if !q.iter().all(|v| v.is_finite()) {
                continue;
            }
            let key = q.map(|v| v.floor() as i64);
            let cell = cells.entry(key).or_default();
            cell.count += 1;
            for k in 0..3 {
                cell.sum[k] += q[k] - key[k] as f64;
            }
            if let Some(colors) = &cloud.colors {
                cell.colored += 1;
                for k in 0..3 {
                    cell.color[k] += u32::from(colors[i][k]);
                }
            }
        }
    }
    let mut cells: Vec<([i64; 3], Cell)> = cells.into_iter().collect();
    cells.sort_unstable_by_key(|(key, _)| *key);
    let points = cells
        .iter()
        .map(|(key, cell)| {
            std::array::from_fn(|k| (key[k] as f64 + cell.sum[k] / f64::from(cell.count)) * voxel_size)
        })
        .collect();
    let colors = cells
        .iter()
        .any(|(_, cell)| cell.colored > 0)
        .then(|| cells.iter().map(|(_, cell)| cell.color.map(|v| (v / cell.colored.max(1)) as u8)).collect());
    Ok(PointCloud { colors, ..PointCloud::from_points(points) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_hold_the_mean_of_all_scans() {
        let cloud = |points: &[[f64; 3]], color: Option<[u8; 3]>| PointCloud {
            colors: color.map(|c| vec![c; points.len()]),
            ..PointCloud::from_points(points.to_vec())
        };
        let scans = [
            cloud(&[[0.1, 0.1, 0.1], [5.5, 0.0, 0.0], [f64::NAN, 0.0, 0.0]], Some([10, 20, 30])),
            cloud(&[[-0.7, 0.1, 0.1]], None),
        ];
        let poses = [(0, Rigid::identity()), (1, Rigid::from_translation([1.0, 0.0, 0.0]))];
        let fused = fuse(&scans[..], &poses, 1.0, &|_| ()).unwrap();
        assert_eq!(fused.len(), 2);
        assert!((0..3).all(|k| (fused.points[0][k] - [0.2, 0.1, 0.1][k]).abs() < 1e-12));
        assert_eq!(fused.colors, Some(vec![[10, 20, 30]; 2]));
        assert!(fuse(&scans[..], &poses, 0.0, &|_| ()).is_err());
    }
}
