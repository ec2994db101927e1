//! A hand-sized statue.

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use upcr::{Rigid, TriangleMesh};

use super::assembly::{Assembly, Bumps};
use crate::random;

/// Radius of the statue's bounding sphere about the middle of its bounding box.
const RADIUS_M: f64 = 0.1;

/// A statue of 0.2 m on a plinth, bumpy and without symmetry; z is up.
pub fn object(seed: u64) -> TriangleMesh {
    let mut rng = random::stream(seed, 0);
    let mut statue = Assembly::default();
    statue.cuboid(Vector3::new(0.05, 0.0, 0.0), Vector3::new(1.0, 0.75, 0.22), rng.random_range(0.1..0.5));

    // Middle, radii, tilt (rotation vector), relative depth of the bumps and steps around, in plinth lengths.
    let parts = [
        ([0.0, 0.0, 0.72], [0.36, 0.27, 0.55], [0.0, 0.12, 0.0], 0.06, 160),
        ([0.08, -0.02, 1.45], [0.21, 0.24, 0.28], [0.1, 0.2, 0.3], 0.05, 128),
        ([0.29, -0.05, 1.42], [0.08, 0.05, 0.07], [0.0, 0.4, -0.2], 0.05, 32),
        ([-0.02, 0.24, 1.52], [0.05, 0.07, 0.10], [0.4, 0.0, 0.0], 0.10, 32),
        ([0.22, 0.42, 1.22], [0.09, 0.10, 0.36], [-0.6, 0.5, 0.0], 0.07, 64),
        ([0.42, 0.60, 1.52], [0.10, 0.10, 0.11], [0.0, 0.0, 0.0], 0.08, 48),
        ([0.10, -0.42, 0.86], [0.10, 0.09, 0.30], [0.5, -0.3, 0.0], 0.07, 64),
        ([0.28, -0.30, 0.58], [0.27, 0.08, 0.08], [0.0, 0.3, 0.9], 0.07, 64),
        ([-0.36, 0.08, 0.80], [0.09, 0.34, 0.50], [0.1, -0.25, 0.2], 0.09, 96),
        ([-0.28, -0.26, 0.34], [0.20, 0.18, 0.24], [0.2, 0.0, 0.5], 0.10, 64),
        ([0.34, 0.20, 0.32], [0.22, 0.12, 0.13], [0.0, -0.2, 0.4], 0.06, 64),
    ];
    for (center, radii, tilt, depth, steps) in parts {
        let mut vary =
            |v: [f64; 3], by: f64| Vector3::from(v.map(|c| c * rng.random_range(1.0 - by..1.0 + by)));
        let (center, radii) = (vary(center, 0.04), vary(radii, 0.15));
        let tilt = vary(tilt, 0.4);
        let bumps = Bumps::new(&mut rng, 4, 1.6, depth, 0.5);
        let mut part = Assembly::default();
        part.blob(Vector3::zeros(), radii, Some(&bumps), steps);
        statue.append(&part, &Rigid { rotation: Rotation3::new(tilt).into_inner(), translation: center });
    }

    let mesh = &mut statue.mesh;
    let (low, high) = mesh
        .vertices
        .iter()
        .fold((Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)), |(low, high), &v| {
            (low.inf(&v.into()), high.sup(&v.into()))
        });
    let middle = (low + high) / 2.0;
    let radius = mesh.vertices.iter().map(|&v| (Vector3::from(v) - middle).norm()).fold(0.0, f64::max);
    for vertex in &mut mesh.vertices {
        *vertex = ((Vector3::from(*vertex) - middle) * (RADIUS_M / radius)).into();
    }
    statue.mesh
}
