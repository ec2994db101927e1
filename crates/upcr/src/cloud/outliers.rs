//! Points that stand apart.

use crate::{CloudRole, PointCloud, Result, neighbors::KdTree};

/// Statistical outlier removal (Rusu et al. 2008): indices of the points whose mean distance to their `k`
/// nearest others is at most `std_ratio` standard deviations above the mean of all points.
pub fn statistical_inliers(points: &[[f32; 3]], k: usize, std_ratio: f64) -> Vec<usize> {
    if points.len() < 2 || k == 0 {
        return (0..points.len()).collect();
    }
    let neighborhoods = KdTree::new(points).knn_graph(k.saturating_add(1));
    let mean_distances: Vec<f64> = (0..points.len())
        .map(|i| {
            // The point itself adds nothing to the sum.
            let row = neighborhoods.row(i);
            row.iter().map(|n| f64::from(n.distance_sq).sqrt()).sum::<f64>() / (row.len() - 1) as f64
        })
        .collect();
    let n = points.len() as f64;
    let mean = mean_distances.iter().sum::<f64>() / n;
    let variance = mean_distances.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let limit = mean + std_ratio * variance.sqrt();
    (0..points.len()).filter(|&i| mean_distances[i] <= limit).collect()
}

impl PointCloud {
    /// The cloud without its statistical outliers ([`statistical_inliers`]).
    ///
    /// # Errors
    /// [`crate::Error::NonFinite`] where a coordinate is not finite.
    pub fn without_outliers(&self, k: usize, std_ratio: f64) -> Result<Self> {
        let Some(bounds) = self.checked_bounds(CloudRole::Cloud)? else { return Ok(self.clone()) };
        Ok(self.select(&statistical_inliers(&self.local_points(bounds.center()), k, std_ratio)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_far_point_is_dropped() {
        let mut points: Vec<_> = (0..100).map(|i| [(i % 10) as f32, (i / 10) as f32, 0.0]).collect();
        points.insert(50, [5.0, 5.0, 8.0]);
        let kept = statistical_inliers(&points, 8, 3.0);
        assert_eq!(kept, (0..101).filter(|&i| i != 50).collect::<Vec<_>>());
        assert_eq!(statistical_inliers(&points, 500, 20.0).len(), 101);
    }

    #[test]
    fn equal_points_are_all_kept() {
        assert_eq!(statistical_inliers(&[[1.0; 3]; 5], 3, 1.0), [0, 1, 2, 3, 4]);
        assert_eq!(statistical_inliers(&[[1.0; 3]], 3, 1.0), [0]);
    }
}
