//! What makes clouds of any size and origin into shapes.

use nalgebra::Vector3;
use rand::Rng;
use rand::seq::SliceRandom;
use upcr::CloudRole::Cloud;
use upcr::{Error, PointCloud, Result};

/// Points of a shape that is sampled here: as many as the published ModelNet40 has.
pub(super) const SHAPE_POINTS: usize = 2048;

/// [`SHAPE_POINTS`] of the cloud's points, or all where there are fewer, in random order.
pub(super) fn sample(mut cloud: PointCloud, rng: &mut impl Rng) -> PointCloud {
    let (chosen, _) = cloud.points.partial_shuffle(rng, SHAPE_POINTS);
    PointCloud::from_points(chosen.to_vec())
}

/// The points with their mean in the origin and the farthest at distance 1.
pub(super) fn unit_sphere(cloud: &PointCloud) -> Result<Vec<[f32; 3]>> {
    let mean = cloud.points.iter().map(|&p| Vector3::from(p)).sum::<Vector3<f64>>() / cloud.len() as f64;
    let radius = cloud.points.iter().map(|&p| (Vector3::from(p) - mean).norm()).fold(0.0, f64::max);
    scaled(cloud, mean.into(), radius)
}

/// The points in the cube of edge length 1 about the origin, which their bounding box touches with its longest edge.
pub(super) fn unit_cube(cloud: &PointCloud) -> Result<Vec<[f32; 3]>> {
    let Some(bounds) = cloud.checked_bounds(Cloud)? else {
        return Err(Error::TooFewPoints { role: Cloud, found: 0, needed: 2 });
    };
    scaled(cloud, bounds.center(), bounds.extent().into_iter().fold(0.0, f64::max))
}

/// Without `origin`, in units of `length`.
fn scaled(cloud: &PointCloud, origin: [f64; 3], length: f64) -> Result<Vec<[f32; 3]>> {
    cloud.checked_bounds(Cloud)?;
    if !(length > 0.0 && length.is_finite()) {
        return Err(Error::Degenerate { role: Cloud, reason: "all its points are the same" });
    }
    let point = |p: &[f64; 3]| [0, 1, 2].map(|k| ((p[k] - origin[k]) / length) as f32);
    Ok(cloud.points.iter().map(point).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    fn box_of_points() -> PointCloud {
        let mut rng = random::stream(8, 0);
        let point = |_| [1e6, -7.0, 0.0].map(|c| c + 30.0 * rng.random::<f64>());
        PointCloud::from_points((0..5000).map(point).collect())
    }

    #[test]
    fn samples_are_points_in_another_order() {
        let cloud = box_of_points();
        let shape = sample(cloud.clone(), &mut random::stream(1, 0));
        assert_eq!(shape.len(), SHAPE_POINTS);
        let places: Vec<usize> =
            shape.points.iter().map(|p| cloud.points.iter().position(|q| p == q).unwrap()).collect();
        assert!(!places.is_sorted());
        let mut once = places.clone();
        once.sort_unstable();
        once.dedup();
        assert_eq!(once.len(), SHAPE_POINTS);
        // Leading points are a sample of the whole.
        let mean = places[..500].iter().sum::<usize>() / 500;
        assert!(mean.abs_diff(2500) < 250, "{mean}");
    }

    #[test]
    fn shapes_fill_their_sphere_or_cube() {
        let cloud = box_of_points();
        let sphere = unit_sphere(&cloud).unwrap();
        let norms = sphere.iter().map(|&p| Vector3::from(p).norm());
        assert!((norms.fold(0.0, f32::max) - 1.0).abs() < 1e-6);
        let mean = sphere.iter().map(|&p| Vector3::from(p)).sum::<Vector3<f32>>() / 5000.0;
        assert!(mean.norm() < 1e-5);

        let cube = unit_cube(&cloud).unwrap();
        let largest = cube.iter().flatten().fold(0.0_f32, |m, v| m.max(v.abs()));
        assert!((largest - 0.5).abs() < 1e-6);
        // Nothing is stretched.
        let distance =
            |points: &[[f32; 3]], i: usize| (Vector3::from(points[0]) - Vector3::from(points[i])).norm();
        assert!(
            (distance(&sphere, 1) / distance(&sphere, 2) - distance(&cube, 1) / distance(&cube, 2)).abs()
                < 1e-5
        );
    }

    #[test]
    fn what_has_no_size_is_refused() {
        for points in [vec![], vec![[1.0; 3]; 5], vec![[0.0; 3], [f64::NAN; 3]]] {
            let cloud = PointCloud::from_points(points);
            assert!(unit_sphere(&cloud).is_err() && unit_cube(&cloud).is_err());
        }
    }
}
