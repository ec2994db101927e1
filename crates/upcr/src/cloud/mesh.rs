//! Points sampled on a mesh.

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{PointCloud, TriangleMesh};

impl TriangleMesh {
    /// `n` points spread evenly over the surface (uniform by area), with the normals of their faces.
    ///
    /// Equal meshes, counts and seeds give equal clouds. A mesh without area gives an empty cloud.
    ///
    /// # Panics
    /// Where a triangle names a vertex that is not there.
    #[must_use]
    pub fn sample(&self, n: usize, seed: u64) -> PointCloud {
        let corner = |v: u32| Vector3::from(self.vertices[v as usize]);
        let mut area = 0.0;
        // Twice the area up to and including each triangle; one that is not finite counts nothing.
        let cumulative: Vec<f64> = (self.triangles.iter())
            .map(|&[a, b, c]| {
                let twice = (corner(b) - corner(a)).cross(&(corner(c) - corner(a))).norm();
                area += if twice.is_finite() { twice } else { 0.0 };
                area
            })
            .collect();
        if area <= 0.0 {
            return PointCloud::default();
        }
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (points, normals) = (0..n)
            .map(|_| {
                let target = rng.random::<f64>() * area;
                let face = cumulative.partition_point(|&c| c <= target).min(cumulative.len() - 1);
                let [a, b, c] = self.triangles[face].map(corner);
                let (edge_b, edge_c) = (b - a, c - a);
                // Of the parallelogram, the half beyond the diagonal is folded back.
                let (mut u, mut v) = (rng.random::<f64>(), rng.random::<f64>());
                if u + v > 1.0 {
                    (u, v) = (1.0 - u, 1.0 - v);
                }
                let point: [f64; 3] = (a + edge_b * u + edge_c * v).into();
                let normal: [f32; 3] = edge_b.cross(&edge_c).normalize().cast::<f32>().into();
                (point, normal)
            })
            .unzip();
        PointCloud { points, normals: Some(normals), ..PointCloud::default() }
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp)]
mod tests {
    use super::*;

    fn two_squares() -> TriangleMesh {
        // A unit square at z = 0 facing up, and one four times as large at z = 1 facing down.
        TriangleMesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0],
                [1.0, 1.0, 0.0],
                [0.0, 1.0, 0.0],
                [0.0, 0.0, 1.0],
                [2.0, 0.0, 1.0],
                [2.0, 2.0, 1.0],
                [0.0, 2.0, 1.0],
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]],
        }
    }

    #[test]
    fn samples_lie_on_faces_in_proportion_to_area() {
        let cloud = two_squares().sample(10_000, 1);
        let low = cloud.points.iter().filter(|p| p[2] == 0.0).count();
        assert!((1800..2200).contains(&low), "{low} of 10000 on a fifth of the area");
        assert!(cloud.points.iter().all(|p| p[0] <= 2.0 && p[1] <= 2.0 && (p[2] == 0.0 || p[2] == 1.0)));
        let normals = cloud.normals.unwrap();
        for (p, n) in cloud.points.iter().zip(normals) {
            assert_eq!(n, if p[2] == 0.0 { [0.0, 0.0, 1.0] } else { [0.0, 0.0, -1.0] });
        }
    }

    #[test]
    fn sampling_is_determined_by_its_seed() {
        let mesh = two_squares();
        assert_eq!(mesh.sample(100, 3), mesh.sample(100, 3));
        assert_ne!(mesh.sample(100, 3), mesh.sample(100, 4));
    }

    #[test]
    fn a_mesh_without_area_gives_no_points() {
        let flat = TriangleMesh { vertices: vec![[1.0; 3]; 3], triangles: vec![[0, 1, 2]] };
        assert!(flat.sample(10, 0).is_empty());
    }
}
