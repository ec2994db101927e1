//! Rocky ground.

use nalgebra::Vector3;
use rand::Rng;
use upcr::TriangleMesh;

use super::assembly::{Assembly, Bumps};
use crate::random;

/// Side of the square of ground, about the origin.
pub const TERRAIN_SIZE_M: f64 = 50.0;
/// Grid cells along a side.
const CELLS: usize = 240;
/// Number of rocks strewn over the ground.
const ROCKS: usize = 40;

/// Hilly ground of 50 × 50 m with rocks on it, without a plane or a symmetry.
pub fn terrain(seed: u64) -> TriangleMesh {
    let mut rng = random::stream(seed, 0);
    let hills = Bumps::new(&mut rng, 6, 30.0, 0.8, 0.45);
    let ridges = Bumps::new(&mut rng, 2, 18.0, 1.0, 0.5);
    // Where |noise| has its crease, the ground has a gully.
    let ground = |x: f64, y: f64| {
        let at = Vector3::new(x, y, 0.0);
        Vector3::new(x, y, hills.at(&at) + 0.5 * ridges.at(&at).abs())
    };
    let mut terrain = Assembly::default();
    terrain.surface([CELLS, CELLS], |u, v| ground((u - 0.5) * TERRAIN_SIZE_M, (v - 0.5) * TERRAIN_SIZE_M));
    for _ in 0..ROCKS {
        let mut coordinate = || rng.random_range(-0.47..0.47) * TERRAIN_SIZE_M;
        let base = ground(coordinate(), coordinate());
        // Many small rocks, few large ones.
        let size = 0.25 * rng.random_range(0.05..1.0_f64).powf(-0.6);
        let bumps = Bumps::new(&mut rng, 4, 1.4, 0.12, 0.55);
        let radii = Vector3::from([(); 3].map(|()| size * rng.random_range(0.6..1.3)));
        terrain.blob(base, radii, Some(&bumps), 48);
    }
    terrain.mesh
}
