//! A scan: every ray of a sensor cast into a scene.

use nalgebra::Vector3;
use rayon::prelude::*;
use upcr::Rigid;

use super::{bvh::Bvh, sensor::Sensor};
use crate::random;

/// Slack of the visibility test, relative to the range.
const VISIBILITY_SLACK: f64 = 1e-6;

/// What `sensor` at `T_world_sensor` measures of `scene`, in the sensor's frame, row by row.
///
/// Every row has a random stream of its own, so the result is the same for any number of threads.
pub(super) fn scan(scene: &Bvh, sensor: &Sensor, T_world_sensor: &Rigid, seed: u64) -> Vec<[f64; 3]> {
    let [rows, columns] = sensor.shape();
    let [nearest, farthest] = sensor.range_m;
    let scan_row = |row: usize| -> Vec<[f64; 3]> {
        let mut rng = random::stream(seed, row as u64);
        let measure = |column: usize| {
            let ray = sensor.ray(row, column);
            let ray_world = T_world_sensor.rotation * ray;
            let hit = scene.cast(&T_world_sensor.translation, &ray_world, farthest)?;
            let incidence = (-hit.normal.dot(&ray_world)).clamp(0.0, 1.0).acos();
            let range = sensor.noise.measure(hit.range, incidence, &mut rng)?;
            (hit.range >= nearest).then(|| (ray * range).into())
        };
        (0..columns).filter_map(measure).collect()
    };
    let rows: Vec<Vec<_>> = (0..rows).into_par_iter().map(scan_row).collect();
    rows.concat()
}

/// Share of what the sensor sees at the first pose that it sees at the second one too.
///
/// Seen means in range, in the field of view and not occluded; it is counted over a coarse grid of rays without
/// noise. 0 where nothing is seen.
pub(super) fn overlap(scene: &Bvh, sensor: &Sensor, T_world_first: &Rigid, T_world_second: &Rigid) -> f64 {
    let sensor = sensor.coarse();
    let seen = scan(scene, &sensor, T_world_first, 0);
    let T_second_first = T_world_second.inverse() * *T_world_first;
    let is_seen = |point: &&[f64; 3]| {
        let in_second = Vector3::from(T_second_first.apply(**point));
        let range = in_second.norm();
        let ray_world = T_world_second.rotation * (in_second / range);
        sensor.covers(&in_second)
            && scene.cast(&T_world_second.translation, &ray_world, range * (1.0 - VISIBILITY_SLACK)).is_none()
    };
    seen.par_iter().filter(is_seen).count() as f64 / seen.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::super::scenes::Assembly;
    use super::super::sensor::{DepthCamera, Lidar, Optics, RangeNoise};
    use super::*;

    fn wall_at(z: f64, half_size: f64) -> Assembly {
        let mut wall = Assembly::default();
        let corner = |x: f64, y: f64| Vector3::new(x * half_size, y * half_size, z);
        wall.quad([corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)]);
        wall
    }

    fn camera(noise: RangeNoise) -> Sensor {
        let optics = Optics::DepthCamera(DepthCamera::centered(160, 120, 130.0));
        Sensor { optics, range_m: [0.0, 100.0], noise }
    }

    fn scan_of(assembly: &Assembly, sensor: &Sensor) -> Vec<[f64; 3]> {
        scan(&Bvh::new(&assembly.mesh).unwrap(), sensor, &Rigid::identity(), 7)
    }

    #[test]
    fn a_wall_is_measured_within_the_noise() {
        let noise = RangeNoise { constant_m: 0.002, quadratic_per_m: 0.001, ..RangeNoise::NONE };
        let sensor = camera(noise);
        let points = scan_of(&wall_at(3.0, 50.0), &sensor);
        assert_eq!(points.len(), 160 * 120);
        let normalized: Vec<f64> = points
            .iter()
            .map(|p| {
                let range = Vector3::from(*p).norm();
                let true_range = 3.0 / (p[2] / range);
                (range - true_range) / noise.sigma_m(true_range)
            })
            .collect();
        let variance = normalized.iter().map(|x| x * x).sum::<f64>() / normalized.len() as f64;
        assert!((variance - 1.0).abs() < 0.05, "{variance}");
    }

    #[test]
    fn a_sphere_is_seen_from_inside_at_its_radius() {
        let mut sphere = Assembly::default();
        sphere.blob(Vector3::zeros(), Vector3::repeat(2.0), None, 256);
        let optics = Optics::Lidar(Lidar { beams: 32, azimuth_steps: 200, elevation_deg: [-60.0, 60.0] });
        let sensor = Sensor { optics, range_m: [0.1, 10.0], noise: RangeNoise::NONE };
        let points = scan_of(&sphere, &sensor);
        assert_eq!(points.len(), 32 * 200);
        assert!(points.iter().all(|p| (Vector3::from(*p).norm() - 2.0).abs() < 1e-3));
        assert!(points.iter().all(|p| sensor.covers(&(Vector3::from(*p) * (1.0 - 1e-9)))));
    }

    #[test]
    fn the_near_wall_hides_the_far_one() {
        let mut scene = wall_at(4.0, 50.0);
        scene.append(&wall_at(2.0, 0.5), &Rigid::identity());
        let points = scan_of(&scene, &camera(RangeNoise::NONE));
        let shadow = |p: &&[f64; 3]| (p[2] - 4.0).abs() < 1e-9 && p[0].abs() < 0.99 && p[1].abs() < 0.99;
        assert_eq!(points.iter().filter(shadow).count(), 0);
        assert!(points.iter().any(|p| (p[2] - 2.0).abs() < 1e-9));
        assert_eq!(points.len(), 160 * 120);
    }

    #[test]
    fn dropouts_come_at_their_rate() {
        let noise = RangeNoise { dropout: 0.2, ..RangeNoise::NONE };
        let kept = scan_of(&wall_at(3.0, 50.0), &camera(noise)).len() as f64 / (160.0 * 120.0);
        assert!((kept - 0.8).abs() < 0.01, "{kept}");

        let noise = RangeNoise { grazing_deg: 30.0, ..RangeNoise::NONE };
        let points = scan_of(&wall_at(3.0, 50.0), &camera(noise));
        let incidence_deg = |p: &[f64; 3]| (p[2] / Vector3::from(*p).norm()).acos().to_degrees();
        let sensor = camera(noise);
        let rays = || (0..120).flat_map(|r| (0..160).map(move |c| sensor.ray(r, c).into()));
        let expected: f64 =
            rays().map(|ray: [f64; 3]| 1.0 - (incidence_deg(&ray) - 30.0).max(0.0) / 60.0).sum();
        assert!((points.len() as f64 / expected - 1.0).abs() < 0.01);
    }

    #[test]
    fn ranges_are_quantised_and_cut() {
        let noise = RangeNoise { quantum_m: 0.01, ..RangeNoise::NONE };
        let sensor = Sensor { range_m: [3.2, 3.5], ..camera(noise) };
        for point in scan_of(&wall_at(3.0, 50.0), &sensor) {
            let range = Vector3::from(point).norm();
            assert!((range / 0.01 - (range / 0.01).round()).abs() < 1e-6);
            assert!((3.19..3.51).contains(&range));
        }
    }

    #[test]
    fn overlap_of_a_wall_is_that_of_the_images() {
        let bvh = Bvh::new(&wall_at(3.0, 50.0).mesh).unwrap();
        let sensor = camera(RangeNoise::NONE);
        // The image is 160 / 130 · 3 m wide.
        let aside = |share: f64| Rigid::from_translation([share * 160.0 / 130.0 * 3.0, 0.0, 0.0]);
        for (share, expected) in [(0.0, 1.0), (0.25, 0.75), (1.1, 0.0)] {
            let found = overlap(&bvh, &sensor, &Rigid::identity(), &aside(share));
            assert!((found - expected).abs() < 0.02, "{share}: {found}");
        }
    }
}
