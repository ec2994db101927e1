//! Point clouds, meshes and what is done to them before anything else: sampling, normals, cleaning.

mod bounds;
mod mesh;
mod normals;
mod outliers;
mod sample;
mod spread;
mod summary;
pub(crate) mod voxel;

pub use bounds::Bounds;
pub use normals::{LocalPlane, Support, local_planes, orient_by_curvature, orient_to_viewpoint};
pub(crate) use normals::{fit_plane, nearest_planes, plane_normal};
pub use outliers::statistical_inliers;
pub use sample::{farthest_points, random_indices};
pub(crate) use spread::{deviations, mean, principal_axes};
pub use summary::Summary;

use crate::transform::Rigid;

/// A point cloud in its file's own frame and unit.
///
/// Coordinates are `f64` so that georeferenced scans (offsets of 1e6 m and more) lose nothing.
/// `normals` and `colors`, where present, have one entry a point.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions.
    pub points: Vec<[f64; 3]>,
    /// Unit normals.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Red, green, blue, 0 to 255.
    pub colors: Option<Vec<[u8; 3]>>,
    /// Where the sensor stood, in the cloud's frame, where the file says so.
    pub viewpoint: Option<[f64; 3]>,
}

/// A triangle mesh, read from OFF, OBJ, STL or a PLY with faces, to be sampled into a cloud.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriangleMesh {
    /// Positions.
    pub vertices: Vec<[f64; 3]>,
    /// Indices into `vertices`, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// A point less `origin`.
pub(crate) fn local(p: [f64; 3], origin: [f64; 3]) -> [f32; 3] {
    std::array::from_fn(|k| (p[k] - origin[k]) as f32)
}

impl PointCloud {
    /// A cloud of bare points.
    pub fn from_points(points: Vec<[f64; 3]>) -> Self {
        Self { points, ..Self::default() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points less `origin`: small numbers, which single precision holds well.
    pub(crate) fn local_points(&self, origin: [f64; 3]) -> Vec<[f32; 3]> {
        self.points.iter().map(|&p| local(p, origin)).collect()
    }

    /// The cloud of the points at `indices`, in that order, with their normals and colours.
    ///
    /// # Panics
    /// Where an index is not below `self.len()`.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Self {
        Self {
            points: indices.iter().map(|&i| self.points[i]).collect(),
            normals: self.normals.as_ref().map(|n| indices.iter().map(|&i| n[i]).collect()),
            colors: self.colors.as_ref().map(|c| indices.iter().map(|&i| c[i]).collect()),
            viewpoint: self.viewpoint,
        }
    }

    /// The cloud with all lengths times `factor`, which is positive; normals stay as they are.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        let scaled = |p: &[f64; 3]| p.map(|v| v * factor);
        Self {
            points: self.points.iter().map(scaled).collect(),
            normals: self.normals.clone(),
            colors: self.colors.clone(),
            viewpoint: self.viewpoint.as_ref().map(scaled),
        }
    }

    /// The cloud moved by `pose`: positions and viewpoint as points, normals as directions.
    #[must_use]
    pub fn transformed(&self, pose: &Rigid) -> Self {
        let rotation = pose.rotation.cast::<f32>();
        let turn = |&n: &[f32; 3]| (rotation * nalgebra::Vector3::from(n)).into();
        Self {
            points: self.points.iter().map(|&p| pose.apply(p)).collect(),
            normals: self.normals.as_ref().map(|n| n.iter().map(turn).collect()),
            colors: self.colors.clone(),
            viewpoint: self.viewpoint.map(|v| pose.apply(v)),
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;

    #[test]
    fn a_moved_cloud_keeps_its_normals_on_its_surface() {
        let cloud = PointCloud {
            points: vec![[1.0, 0.0, 0.0]],
            normals: Some(vec![[1.0, 0.0, 0.0]]),
            colors: Some(vec![[1, 2, 3]]),
            viewpoint: Some([2.0, 0.0, 0.0]),
        };
        let quarter = Rigid::exp(&Vector6::new(0.0, 0.0, std::f64::consts::FRAC_PI_2, 0.0, 0.0, 0.0));
        let moved = cloud.transformed(&(Rigid::from_translation([0.0, 0.0, 5.0]) * quarter));
        let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(moved.points[0], [0.0, 1.0, 5.0]));
        assert!(near(moved.viewpoint.unwrap(), [0.0, 2.0, 5.0]));
        assert!(near(moved.normals.unwrap()[0].map(f64::from), [0.0, 1.0, 0.0]));
        assert_eq!(moved.colors, cloud.colors);
    }
}
