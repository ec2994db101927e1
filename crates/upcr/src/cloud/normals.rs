//! Surface normals from neighbourhoods, and the ways to choose their sign.

use multiversion::multiversion;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use super::PointCloud;
use crate::error::{CloudRole, Error, Result};
use crate::neighbors::{KdTree, Neighbor, Neighborhoods};

/// Points a parallel task takes.
const CHUNK: usize = 128;
/// Neighbours, at most, that a radius search for normals takes.
const MAX_RADIUS_NEIGHBORS: usize = 64;
/// Neighbours that span a surface.
const MIN_NEIGHBORS: usize = 3;

/// How far the neighbourhood reaches that a normal is fitted to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Support {
    /// The given number of nearest points, the point itself included.
    Nearest(usize),
    /// The points within the given distance, in the cloud's unit.
    Radius(f64),
}

/// The plane fitted to a neighbourhood by principal component analysis (Hoppe et al. 1992).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalPlane {
    /// Unit normal, sign arbitrary; zero where there are fewer than three neighbours.
    pub normal: [f32; 3],
    /// Eigenvalues of the neighbourhood's covariance, ascending, in squared units.
    pub eigenvalues: [f32; 3],
}

impl LocalPlane {
    /// Surface variation (Pauly et al. 2002): the normal's share of the variance, 0 (flat) to 1/3 (isotropic).
    pub fn surface_variation(&self) -> f32 {
        let total: f32 = self.eigenvalues.iter().sum();
        if total > 0.0 { self.eigenvalues[0] / total } else { 0.0 }
    }
}

impl PointCloud {
    /// Fills `normals` from each point's neighbourhood.
    ///
    /// Normals point towards `viewpoint`, or the cloud's own, or, where there is neither, to the convex side of
    /// the surface ([`orient_by_curvature`]).
    pub fn estimate_normals(&mut self, support: Support, viewpoint: Option<[f64; 3]>) -> Result<()> {
        if self.len() < MIN_NEIGHBORS {
            let role = CloudRole::Cloud;
            return Err(Error::TooFewPoints { role, found: self.len(), needed: MIN_NEIGHBORS });
        }
        self.checked_bounds(CloudRole::Cloud)?;
        let origin = self.points[0];
        let points = self.local_points(origin);
        let tree = KdTree::new(&points);
        let neighborhoods = match support {
            Support::Nearest(k) => tree.knn_graph(k),
            Support::Radius(radius) => tree.radius_graph(radius as f32, MAX_RADIUS_NEIGHBORS),
        };
        let mut normals: Vec<_> =
            local_planes(&points, &neighborhoods).iter().map(|plane| plane.normal).collect();
        match viewpoint.or(self.viewpoint) {
            Some(viewpoint) => {
                let local = std::array::from_fn(|a| (viewpoint[a] - origin[a]) as f32);
                orient_to_viewpoint(&points, &mut normals, local);
            }
            None => orient_by_curvature(&points, &mut normals, &neighborhoods),
        }
        self.normals = Some(normals);
        Ok(())
    }
}

/// Fits a plane to every point's neighbourhood, in parallel.
pub fn local_planes(points: &[[f32; 3]], neighborhoods: &Neighborhoods) -> Vec<LocalPlane> {
    nearest_planes(points, neighborhoods, usize::MAX)
}

/// As [`local_planes`], from the `k` nearest neighbours of each point alone.
pub(crate) fn nearest_planes(
    points: &[[f32; 3]],
    neighborhoods: &Neighborhoods,
    k: usize,
) -> Vec<LocalPlane> {
    let mut planes =
        vec![LocalPlane { normal: [0.0; 3], eigenvalues: [0.0; 3] }; points.len().min(neighborhoods.len())];
    planes.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, planes)| {
        for (plane, i) in planes.iter_mut().zip(chunk * CHUNK..) {
            let row = neighborhoods.row(i);
            *plane = fit_plane(points, points[i], &row[..row.len().min(k)]);
        }
    });
    planes
}

/// Turns every normal to the side `viewpoint` is on.
pub fn orient_to_viewpoint(points: &[[f32; 3]], normals: &mut [[f32; 3]], viewpoint: [f32; 3]) {
    for (normal, point) in normals.iter_mut().zip(points) {
        let to_viewpoint = [0, 1, 2].map(|a| viewpoint[a] - point[a]);
        if dot(*normal, to_viewpoint) < 0.0 {
            *normal = normal.map(|v| -v);
        }
    }
}

/// Turns every normal away from the centroid of the point's neighbourhood, to the convex side of the surface.
///
/// The rule is local and knows no frame, so it gives two scans of one surface the same normals whatever their
/// poses; where the surface is flat the sign is left to noise.
pub fn orient_by_curvature(points: &[[f32; 3]], normals: &mut [[f32; 3]], neighborhoods: &Neighborhoods) {
    normals.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, normals)| {
        for (normal, i) in normals.iter_mut().zip(chunk * CHUNK..) {
            // The sum of offsets has the direction of the mean.
            let mut to_centroid = [0.0; 3];
            for neighbor in neighborhoods.row(i) {
                let p = points[neighbor.index as usize];
                for a in 0..3 {
                    to_centroid[a] += p[a] - points[i][a];
                }
            }
            if dot(*normal, to_centroid) > 0.0 {
                *normal = normal.map(|v| -v);
            }
        }
    });
}

/// The plane fitted to points about `center`.
#[multiversion(targets("x86_64+avx2"))]
pub(crate) fn fit_plane(points: &[[f32; 3]], center: [f32; 3], neighbors: &[Neighbor]) -> LocalPlane {
    if neighbors.len() < MIN_NEIGHBORS {
        return LocalPlane { normal: [0.0; 3], eigenvalues: [0.0; 3] };
    }
    // Moments about the point itself: small numbers, in double precision, lose nothing to cancellation.
    let mut sum = [0.0_f64; 3];
    let mut squares = [0.0_f64; 6];
    for neighbor in neighbors {
        let p = points[neighbor.index as usize];
        let [x, y, z] = [0, 1, 2].map(|a| f64::from(p[a] - center[a]));
        for (s, v) in sum.iter_mut().zip([x, y, z]) {
            *s += v;
        }
        for (s, v) in squares.iter_mut().zip([x * x, x * y, x * z, y * y, y * z, z * z]) {
            *s += v;
        }
    }
    let scale = 1.0 / neighbors.len() as f64;
    let mean = Vector3::from(sum) * scale;
    let [xx, xy, xz, yy, yz, zz] = squares.map(|s| s * scale);
    let covariance = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) - mean * mean.transpose();
    let (eigenvalues, eigenvector) = smallest_eigenpair(&covariance);
    LocalPlane {
        normal: eigenvector.map(|v| v as f32).into(),
        // Rounding may leave a zero slightly below.
        eigenvalues: eigenvalues.map(|v| v.max(0.0) as f32),
    }
}

/// Normal of the plane through points of this covariance: xx, xy, xz, yy, yz, zz.
pub(crate) fn plane_normal(c: &[f64; 6]) -> [f32; 3] {
    let (_, normal) = smallest_eigenpair(&Matrix3::new(c[0], c[1], c[2], c[1], c[3], c[4], c[2], c[4], c[5]));
    normal.map(|v| v as f32).into()
}

/// Eigenvalues, ascending, of a symmetric matrix, and the unit eigenvector of the least, in closed form.
///
/// After Eberly (A Robust Eigensolver for 3×3 Symmetric Matrices, 2014): first the eigenvector of the most
/// isolated eigenvalue, which the trigonometric formula has to full accuracy; the other two are then the
/// eigenvalues of a 2×2 matrix, accurate however near to each other.
pub(crate) fn smallest_eigenpair(m: &Matrix3<f64>) -> ([f64; 3], Vector3<f64>) {
    let scale = m.amax();
    if scale == 0.0 {
        return ([0.0; 3], Vector3::z());
    }
    let a = m / scale;
    let mean = a.trace() / 3.0;
    let deviator = a - Matrix3::from_diagonal_element(mean);
    let spread = (deviator.norm_squared() / 6.0).sqrt();
    if spread < f64::EPSILON {
        return ([mean * scale; 3], Vector3::z());
    }
    // Eigenvalues of the deviator are 2·spread·cos(angle + 2πk/3).
    let half_det = (deviator.determinant() / (2.0 * spread.powi(3))).clamp(-1.0, 1.0);
    let angle = half_det.acos() / 3.0;
    let largest_is_isolated = half_det >= 0.0;
    let third = if largest_is_isolated { 0.0 } else { 2.0 * std::f64::consts::FRAC_PI_3 };
    let isolated = mean + 2.0 * spread * (angle + third).cos();

    // Rows of A - λI are normal to the eigenvector: of their cross products the longest is it.
    let shifted = a - Matrix3::from_diagonal_element(isolated);
    let (r0, r1, r2) = (shifted.column(0), shifted.column(1), shifted.column(2));
    let axis = [r0.cross(&r1), r1.cross(&r2), r2.cross(&r0)]
        .into_iter()
        .reduce(|a, b| if b.norm_squared() > a.norm_squared() { b } else { a })
        .map_or_else(Vector3::z, |axis| axis.normalize());

    // The matrix on the plane across `axis`, in the orthonormal basis u, v.
    let u = axis.cross(&Vector3::ith(axis.iamin(), 1.0)).normalize();
    let v = axis.cross(&u);
    let (uu, uv, vv) = (u.dot(&(a * u)), u.dot(&(a * v)), v.dot(&(a * v)));
    let half_gap = ((uu - vv) / 2.0).hypot(uv);
    let middle = f64::midpoint(uu, vv);
    let (low, high) = (middle - half_gap, middle + half_gap);
    let isolated = axis.dot(&(a * axis));

    if largest_is_isolated {
        // Half the angle of the 2×2 matrix' larger eigenvector, turned by a right angle.
        let (sin, cos) = (0.5 * (2.0 * uv).atan2(uu - vv)).sin_cos();
        ([low, high, isolated].map(|e| e * scale), v * cos - u * sin)
    } else {
        ([isolated, low, high].map(|e| e * scale), axis)
    }
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn eigenpair_agrees_with_the_iterative_solver(
            axes in prop::array::uniform3(-3.0_f64..3.0),
            exponents in prop::array::uniform3(-14_i32..3),
            rotation in prop::array::uniform3(-3.0_f64..3.0),
        ) {
            // Eigenvalues of widely different size, near-degenerate pairs among them.
            let values = Vector3::from_fn(|i, _| axes[i].exp() * 10_f64.powi(exponents[i]));
            let r = nalgebra::Rotation3::new(Vector3::from(rotation)).into_inner();
            let m = r * Matrix3::from_diagonal(&values) * r.transpose();
            let m = (m + m.transpose()) / 2.0;
            let (found, vector) = smallest_eigenpair(&m);
            let mut expected = values;
            expected.as_mut_slice().sort_by(f64::total_cmp);
            for i in 0..3 {
                prop_assert!((found[i] - expected[i]).abs() < 1e-14 * expected[2]);
            }
            prop_assert!((vector.norm() - 1.0).abs() < 1e-12);
            prop_assert!((m * vector - vector * found[0]).norm() < 1e-14 * expected[2]);
        }
    }

    #[test]
    fn equal_eigenvalues_are_no_trouble() {
        for m in [Matrix3::zeros(), Matrix3::identity(), Matrix3::from_diagonal(&Vector3::new(0.0, 2.0, 2.0))]
        {
            let (values, vector) = smallest_eigenpair(&m);
            assert!((m * vector - vector * values[0]).norm() < 1e-15);
        }
    }

    #[test]
    fn a_sphere_has_radial_normals_outwards() {
        let golden = 2.399_963_2_f64;
        let points = (0..2000).map(|i| {
            let z = 1.0 - (2 * i + 1) as f64 / 2000.0;
            let (sin, cos) = (golden * i as f64).sin_cos();
            let r = (1.0 - z * z).sqrt();
            [4e6 + r * cos, r * sin, z]
        });
        let mut cloud = PointCloud::from_points(points.collect());
        let radial = |p: [f64; 3]| [p[0] - 4e6, p[1], p[2]].map(|v| v as f32);
        for support in [Support::Nearest(20), Support::Radius(0.2)] {
            cloud.estimate_normals(support, None).unwrap();
            let normals = cloud.normals.as_ref().unwrap();
            assert!(cloud.points.iter().zip(normals).all(|(&p, &n)| dot(radial(p), n) > 0.99));
        }
        cloud.estimate_normals(Support::Nearest(20), Some([4e6, 0.0, 0.0])).unwrap();
        let normals = cloud.normals.as_ref().unwrap();
        assert!(cloud.points.iter().zip(normals).all(|(&p, &n)| dot(radial(p), n) < -0.99));
    }

    #[test]
    fn a_line_has_a_normal_across_it() {
        let mut cloud = PointCloud::from_points((0..50).map(|i| [i as f64, 2.0 * i as f64, 0.0]).collect());
        cloud.estimate_normals(Support::Nearest(10), None).unwrap();
        for n in cloud.normals.unwrap() {
            assert!((n[0] + 2.0 * n[1]).abs() < 1e-6 && (dot(n, n) - 1.0).abs() < 1e-6);
        }
    }
}
