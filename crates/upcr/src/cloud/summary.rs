//! What a cloud holds, in a few numbers.

use serde::Serialize;

use super::PointCloud;

/// A cloud's size, place and attributes. Lengths are in the cloud's unit; points that are not finite count
/// in `points` and `non_finite` alone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Number of points.
    pub points: usize,
    /// How many of them have a NaN or infinite coordinate.
    pub non_finite: usize,
    /// Smallest coordinates; `None` where no point is finite, as for the three below.
    pub min: Option<[f64; 3]>,
    /// Largest coordinates.
    pub max: Option<[f64; 3]>,
    /// `max - min`.
    pub extent: Option<[f64; 3]>,
    /// Mean of the points.
    pub centroid: Option<[f64; 3]>,
    /// Whether there are normals.
    pub normals: bool,
    /// Whether there are colours.
    pub colors: bool,
    /// Where the sensor stood, where the file says so.
    pub viewpoint: Option<[f64; 3]>,
}

impl PointCloud {
    /// The cloud in a few numbers.
    pub fn summary(&self) -> Summary {
        let finite = || self.points.iter().filter(|p| p.iter().all(|v| v.is_finite()));
        let count = finite().count();
        let first = finite().next();
        let min = first.map(|&first| finite().fold(first, |a, b| std::array::from_fn(|i| a[i].min(b[i]))));
        let max = first.map(|&first| finite().fold(first, |a, b| std::array::from_fn(|i| a[i].max(b[i]))));
        // About the first point, so that georeferenced coordinates lose no digits in the sum.
        let centroid = first.map(|first| {
            let sum =
                finite().fold([0.0; 3], |a: [f64; 3], b| std::array::from_fn(|i| a[i] + (b[i] - first[i])));
            std::array::from_fn(|i| first[i] + sum[i] / count as f64)
        });
        Summary {
            points: self.len(),
            non_finite: self.len() - count,
            min,
            max,
            extent: min.zip(max).map(|(min, max)| std::array::from_fn(|i| max[i] - min[i])),
            centroid,
            normals: self.normals.is_some(),
            colors: self.colors.is_some(),
            viewpoint: self.viewpoint,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_that_are_not_finite_are_counted_and_left_out() {
        let cloud =
            PointCloud::from_points(vec![[f64::NAN, 9.0, 9.0], [1e6, 2.0, 3.0], [1e6 + 2.0, 0.0, 3.0]]);
        let summary = cloud.summary();
        assert_eq!((summary.points, summary.non_finite), (3, 1));
        assert_eq!(summary.min, Some([1e6, 0.0, 3.0]));
        assert_eq!(summary.extent, Some([2.0, 2.0, 0.0]));
        assert_eq!(summary.centroid, Some([1e6 + 1.0, 1.0, 3.0]));
    }

    #[test]
    fn an_empty_cloud_has_no_place() {
        let summary = PointCloud::default().summary();
        assert_eq!((summary.points, summary.min, summary.centroid), (0, None, None));
    }
}
