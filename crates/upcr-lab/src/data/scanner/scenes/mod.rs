//! Procedural scenes, all of them triangle meshes; every seed gives another specimen.

mod assembly;
mod building;
mod object;
mod room;
mod street;
mod terrain;

#[cfg(test)]
pub(super) use assembly::Assembly;
pub use building::{Building, building};
pub use object::object;
pub(super) use room::ROOM_SIZE_M;
pub use room::room;
pub use street::street;
pub(super) use street::{LANE_M, STREET_LENGTH_M};
pub(super) use terrain::TERRAIN_SIZE_M;
pub use terrain::terrain;

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    type Build = fn(u64) -> upcr::TriangleMesh;

    #[test]
    fn scenes_have_their_sizes_and_follow_their_seeds() {
        let scenes: [(Build, [f64; 3], [f64; 3]); 5] = [
            (object, [0.08; 3], [0.2; 3]),
            (room, [5.0, 4.0, 2.7], [5.6, 4.6, 2.9]),
            (street, [100.0, 15.0, 8.0], [110.0, 60.0, 25.0]),
            (terrain, [50.0, 50.0, 1.0], [56.0, 56.0, 20.0]),
            (|seed| building(seed, 12).mesh, [17.0, 12.2, 2.8], [30.2, 19.7, 2.8]),
        ];
        for (i, (scene, smallest, largest)) in scenes.into_iter().enumerate() {
            let mesh = scene(5);
            assert_eq!(mesh, scene(5));
            assert_ne!(mesh, scene(6));
            let n = mesh.vertices.len() as u32;
            assert!(mesh.triangles.iter().flatten().all(|&v| v < n));
            let low = mesh.vertices.iter().fold(Vector3::repeat(f64::MAX), |m, &v| m.inf(&v.into()));
            let high = mesh.vertices.iter().fold(Vector3::repeat(f64::MIN), |m, &v| m.sup(&v.into()));
            for axis in 0..3 {
                let extent = high[axis] - low[axis];
                assert!(
                    (smallest[axis] - 1e-9..=largest[axis] + 1e-9).contains(&extent),
                    "scene {i} axis {axis}: {extent}"
                );
            }
        }
    }
}
