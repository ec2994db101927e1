//! A virtual scanner: depth cameras and lidars moved through procedural scenes or around any mesh, by ray casting.
//!
//! [`synth`] turns [`SynthSettings`] into scans with true poses. World frames have z up; the built-in scenes are in
//! metres, a mesh keeps its unit, which then is also the unit of every length in its settings.

mod bvh;
mod cast;
mod path;
pub mod scenes;
mod sensor;

use std::borrow::Cow;
use std::f64::consts::TAU;

use nalgebra::Vector3;
use rand::Rng;
use upcr::{PointCloud, Result, Rigid, TriangleMesh};

pub use bvh::{Bvh, Hit};
pub use sensor::{DepthCamera, Lidar, Optics, RangeNoise, Sensor};

use crate::random;
use path::{Course, Path, Ring, Walk};
use scenes::{LANE_M, ROOM_SIZE_M, STREET_LENGTH_M, TERRAIN_SIZE_M};
use sensor::invalid;

/// Distance of the viewpoints from the middle of an object, in radii of its bounding sphere.
const ORBIT_RADII: f64 = 2.5;
/// Height of a sensor carried through a room.
const HAND_HEIGHT_M: f64 = 1.55;
/// Scans for each room of a building.
const SCANS_A_ROOM: usize = 4;
/// Height of a sensor on a vehicle over the ground.
const ROOF_HEIGHT_M: f64 = 1.9;

/// What is scanned.
#[derive(Debug, Clone, PartialEq)]
pub enum Scene {
    /// A statue of 0.2 m, from all around.
    Object,
    /// A furnished room of 5 × 4 × 2.7 m, from inside.
    Room,
    /// A street of 100 m, driving along it.
    Street,
    /// Rocky ground of 50 × 50 m, driving over it.
    Terrain,
    /// One storey of furnished rooms, carrying a scanner through them; the more scans, the more rooms.
    Building,
    /// A mesh in its own unit, from all around; z is taken for up.
    Mesh(TriangleMesh),
}

/// Everything a sequence of scans depends on; [`SynthSettings::new`] has the defaults.
#[derive(Debug, Clone, PartialEq)]
pub struct SynthSettings {
    /// What is scanned.
    pub scene: Scene,
    /// What it is scanned with.
    pub sensor: Sensor,
    /// Number of scans.
    pub scans: usize,
    /// Share of what one scan sees that its neighbour is to see too, over 0 to below 1; the scans are spaced to
    /// come as near to it as the path allows.
    pub overlap: f64,
    /// Whether every scan is turned about its sensor by a rotation uniform over SO(3), so that poses have to be
    /// found from any starting position.
    pub turned: bool,
    /// Of the scene, the path and all noise.
    pub seed: u64,
}

/// One scan.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// What was measured, in the sensor's frame (turned, where that was asked for); the viewpoint is its origin.
    pub cloud: PointCloud,
    /// The true pose of `cloud`'s frame.
    pub T_world_sensor: Rigid,
    /// Share of what this scan sees that the one before sees too, and the one after: in range, in view and not occluded.
    pub overlap_before: Option<f64>,
    /// See `overlap_before`.
    pub overlap_after: Option<f64>,
}

/// The random streams of one seed, by purpose.
enum Stream {
    Path,
    Noise,
    Turn,
}

impl SynthSettings {
    /// The defaults for a scene: a close-range camera for objects and meshes, a hand-held one for rooms, a
    /// lidar out of doors; two scans sharing 60 %, not turned, seed 0.
    pub fn new(scene: Scene) -> Self {
        let sensor = match &scene {
            Scene::Object => Sensor::around(Sphere { center: Vector3::zeros(), radius: 0.1 }),
            Scene::Mesh(mesh) => Sensor::around(Sphere::bounding(&mesh.vertices)),
            Scene::Room => Sensor::HAND_HELD,
            Scene::Street => Sensor::ON_VEHICLE,
            Scene::Terrain => Sensor { range_m: [0.5, 40.0], ..Sensor::ON_VEHICLE },
            Scene::Building => Sensor::ON_TRIPOD,
        };
        Self { scene, sensor, scans: 2, overlap: 0.6, turned: false, seed: 0 }
    }

    fn check(&self) -> Result<()> {
        if self.scans == 0 {
            return Err(invalid("scans", "at least one scan is needed"));
        }
        if !(self.overlap > 0.0 && self.overlap < 1.0) {
            return Err(invalid("overlap", "must lie between 0 and 1, both excluded"));
        }
        self.sensor.check()
    }
}

impl Sensor {
    /// A structured-light camera of 640 × 480 px for rooms.
    pub const HAND_HELD: Self = Self {
        optics: Optics::DepthCamera(DepthCamera {
            width: 640,
            height: 480,
            focal_px: [525.0; 2],
            center_px: [319.5, 239.5],
        }),
        range_m: [0.3, 8.0],
        noise: RangeNoise {
            constant_m: 0.0005,
            linear: 0.0,
            quadratic_per_m: 0.0015,
            dropout: 0.005,
            grazing_deg: 75.0,
            quantum_m: 0.0,
        },
    };

    /// A lidar of 64 beams for vehicles.
    pub const ON_VEHICLE: Self = Self {
        optics: Optics::Lidar(Lidar { beams: 64, azimuth_steps: 1024, elevation_deg: [-25.0, 15.0] }),
        range_m: [0.5, 100.0],
        noise: RangeNoise {
            constant_m: 0.015,
            linear: 0.0002,
            quadratic_per_m: 0.0,
            dropout: 0.01,
            grazing_deg: 85.0,
            quantum_m: 0.002,
        },
    };

    /// A scanner on a tripod, for buildings.
    pub const ON_TRIPOD: Self = Self {
        optics: Optics::Lidar(Lidar { beams: 96, azimuth_steps: 360, elevation_deg: [-60.0, 60.0] }),
        range_m: [0.4, 25.0],
        noise: RangeNoise {
            constant_m: 0.002,
            linear: 0.0002,
            quadratic_per_m: 0.0,
            dropout: 0.005,
            grazing_deg: 85.0,
            quantum_m: 0.0,
        },
    };

    /// A close-range camera for something of the given bounding sphere, its noise a 500th of the radius.
    fn around(sphere: Sphere) -> Self {
        let noise = RangeNoise {
            constant_m: sphere.radius / 500.0,
            dropout: 0.005,
            grazing_deg: 75.0,
            ..RangeNoise::NONE
        };
        let optics = Optics::DepthCamera(DepthCamera::centered(640, 480, 525.0));
        Self { optics, range_m: [0.0, sphere.radius * 2.0 * ORBIT_RADII], noise }
    }
}

/// A sphere around a mesh.
#[derive(Debug, Clone, Copy)]
struct Sphere {
    center: Vector3<f64>,
    radius: f64,
}

impl Sphere {
    /// About the middle of the bounding box.
    fn bounding(vertices: &[[f64; 3]]) -> Self {
        let empty = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        let (low, high) =
            vertices.iter().fold(empty, |(low, high), &v| (low.inf(&v.into()), high.sup(&v.into())));
        let center = (low + high) / 2.0;
        let radius = vertices.iter().map(|&v| (Vector3::from(v) - center).norm()).fold(0.0, f64::max);
        Self { center, radius }
    }
}

/// Scans a scene: the same settings give the same scans, for any number of threads.
///
/// # Errors
/// Where a setting is out of range, the mesh is not usable, or a scan meets nothing.
pub fn synth(settings: &SynthSettings) -> Result<Vec<Scan>> {
    settings.check()?;
    let (mesh, path) = place(settings);
    let bvh = Bvh::new(&mesh)?;
    let sensor = &settings.sensor;
    let poses = path.poses(settings.scans, settings.overlap, sensor, &bvh);
    let mut turns = stream(settings.seed, Stream::Turn);
    let mut noise_seeds = stream(settings.seed, Stream::Noise);
    let scan = |(k, pose): (usize, &Rigid)| {
        let shared = |other: Option<usize>| Some(cast::overlap(&bvh, sensor, pose, poses.get(other?)?));
        let (overlap_before, overlap_after) = (shared(k.checked_sub(1)), shared(Some(k + 1)));
        let points = cast::scan(&bvh, sensor, pose, noise_seeds.random());
        if points.is_empty() {
            return Err(invalid("range_m", &format!("scan {k} meets nothing within the sensor's range")));
        }
        let turn = if settings.turned {
            Rigid { rotation: random::rotation(&mut turns), translation: Vector3::zeros() }
        } else {
            Rigid::identity()
        };
        let cloud = PointCloud {
            points: points.into_iter().map(|p| turn.apply(p)).collect(),
            viewpoint: Some([0.0; 3]),
            ..PointCloud::default()
        };
        Ok(Scan { cloud, T_world_sensor: *pose * turn.inverse(), overlap_before, overlap_after })
    };
    poses.iter().enumerate().map(scan).collect()
}

fn stream(seed: u64, purpose: Stream) -> impl Rng {
    // Stream 0 is the scenes' own.
    random::stream(seed, 1 + purpose as u64)
}

/// A scene, and the way the sensor takes through it.
fn place(settings: &SynthSettings) -> (Cow<'_, TriangleMesh>, Path) {
    let seed = settings.seed;
    let phase = stream(seed, Stream::Path).random_range(0.0..TAU);
    let orbit = |mesh: &TriangleMesh| {
        let Sphere { center, radius } = Sphere::bounding(&mesh.vertices);
        Path::Ring(Ring { center, half_axes: [ORBIT_RADII * radius; 2], phase, course: Course::Orbit })
    };
    let level = |half_axes, height, course| {
        Path::Ring(Ring { center: Vector3::z() * height, half_axes, phase, course })
    };
    match &settings.scene {
        Scene::Mesh(mesh) => (Cow::Borrowed(mesh), orbit(mesh)),
        Scene::Object => {
            let object = scenes::object(seed);
            let path = orbit(&object);
            (Cow::Owned(object), path)
        }
        Scene::Room => {
            let [length, width, _] = ROOM_SIZE_M;
            let path = level([0.27 * length, 0.25 * width], HAND_HEIGHT_M, Course::Across);
            (Cow::Owned(scenes::room(seed)), path)
        }
        Scene::Street => {
            let path = level([0.4 * STREET_LENGTH_M, LANE_M], ROOF_HEIGHT_M, Course::Along);
            (Cow::Owned(scenes::street(seed)), path)
        }
        Scene::Terrain => {
            let half_axes = [0.32 * TERRAIN_SIZE_M, 0.22 * TERRAIN_SIZE_M];
            (Cow::Owned(scenes::terrain(seed)), level(half_axes, 0.0, Course::OverGround(ROOF_HEIGHT_M)))
        }
        Scene::Building => {
            let building = scenes::building(seed, settings.scans.div_ceil(SCANS_A_ROOM));
            (Cow::Owned(building.mesh), Path::Walk(Walk::new(building.tour, HAND_HEIGHT_M)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Settings small enough for tests.
    fn small(scene: Scene) -> SynthSettings {
        let mut settings = SynthSettings::new(scene);
        settings.sensor.optics = match settings.sensor.optics {
            Optics::DepthCamera(camera) => Optics::DepthCamera(camera.resized(96, 72)),
            Optics::Lidar(lidar) => Optics::Lidar(Lidar { beams: 32, azimuth_steps: 256, ..lidar }),
        };
        SynthSettings { seed: 3, turned: true, ..settings }
    }

    #[test]
    fn scans_laid_into_the_world_lie_on_the_scene_and_on_each_other() {
        type Build = fn(u64) -> TriangleMesh;
        let scenes: [(Scene, Build); 5] = [
            (Scene::Object, scenes::object),
            (Scene::Room, scenes::room),
            (Scene::Street, scenes::street),
            (Scene::Terrain, scenes::terrain),
            (Scene::Building, |seed| scenes::building(seed, 1).mesh),
        ];
        for (scene, build) in scenes {
            let mut settings = small(scene);
            settings.sensor.noise = RangeNoise::NONE;
            let scans = synth(&settings).unwrap();
            let overlap = scans[0].overlap_after.unwrap();
            // All of a room is seen from anywhere in it.
            let near = if settings.scene == Scene::Building { 0.4 } else { 0.12 };
            assert!(
                (overlap.min(scans[1].overlap_before.unwrap()) - settings.overlap).abs() < near,
                "{overlap}"
            );

            let world = |scan: &Scan| -> Vec<Vector3<f64>> {
                scan.cloud.points.iter().map(|&p| scan.T_world_sensor.apply(p).into()).collect()
            };
            let (first, second) = (world(&scans[0]), world(&scans[1]));
            let sample: Vec<_> = first.iter().step_by(5).collect();
            let share = |test: &dyn Fn(&Vector3<f64>) -> bool| {
                sample.iter().filter(|p| test(p)).count() as f64 / sample.len() as f64
            };

            // A ray from the second viewpoint toward a shared point of the first scan ends exactly there.
            let bvh = Bvh::new(&build(settings.seed)).unwrap();
            let eye = scans[1].T_world_sensor.translation;
            let ends_there = |p: &Vector3<f64>| {
                let range = (p - eye).norm();
                bvh.cast(&eye, &((p - eye) / range), range * 1.01)
                    .is_some_and(|hit| (hit.range / range - 1.0).abs() < 1e-6)
            };
            let exact = share(&ends_there);
            assert!(exact > overlap - 0.1, "{:?}: {exact} {overlap}", settings.scene);

            // Lidars leave gaps between their rings, but images are dense.
            if matches!(settings.sensor.optics, Optics::DepthCamera(_)) {
                let reach = |p: &Vector3<f64>| 0.05 * (p - scans[0].T_world_sensor.translation).norm();
                let close = share(&|p| second.iter().any(|q| (p - q).norm() < reach(p)));
                assert!(close > overlap - 0.1, "{:?}: {close} {overlap}", settings.scene);
            }
        }
    }

    #[test]
    fn threads_do_not_matter_and_seeds_do() {
        let on = |threads: usize, seed: u64| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let settings = SynthSettings { seed, scans: 3, ..small(Scene::Object) };
            pool.install(|| synth(&settings).unwrap())
        };
        assert_eq!(on(1, 9), on(2, 9));
        assert_ne!(on(1, 9), on(1, 10));
    }

    #[test]
    fn turning_moves_frames_and_not_the_world() {
        let turned = small(Scene::Room);
        let straight = SynthSettings { turned: false, ..turned.clone() };
        for (a, b) in synth(&turned).unwrap().iter().zip(&synth(&straight).unwrap()) {
            assert!((a.T_world_sensor.rotation - b.T_world_sensor.rotation).norm() > 1e-3);
            for (p, q) in a.cloud.points.iter().zip(&b.cloud.points) {
                let apart =
                    Vector3::from(a.T_world_sensor.apply(*p)) - Vector3::from(b.T_world_sensor.apply(*q));
                assert!(apart.norm() < 1e-9);
            }
        }
    }

    #[test]
    fn a_mesh_keeps_its_unit_and_place() {
        let mut mesh = scenes::object(1);
        for vertex in &mut mesh.vertices {
            *vertex = [vertex[0] * 1000.0 + 5e5, vertex[1] * 1000.0, vertex[2] * 1000.0 - 70.0];
        }
        let scans = synth(&small(Scene::Mesh(mesh))).unwrap();
        for scan in &scans {
            for &point in &scan.cloud.points {
                let world = Vector3::from(scan.T_world_sensor.apply(point)) - Vector3::new(5e5, 0.0, -70.0);
                assert!(world.norm() < 102.0);
            }
        }
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        let good = small(Scene::Object);
        let mut blind = good.clone();
        blind.sensor.range_m = [0.0, 1e-3];
        let mut lossy = good.clone();
        lossy.sensor.noise.dropout = 1.5;
        let mut rayless = good.clone();
        rayless.sensor.optics = Optics::DepthCamera(DepthCamera::centered(0, 10, 1.0));
        let bad = [
            SynthSettings { scans: 0, ..good.clone() },
            SynthSettings { overlap: 1.0, ..good.clone() },
            SynthSettings { scene: Scene::Mesh(TriangleMesh::default()), ..good },
            blind,
            lossy,
            rayless,
        ];
        for settings in bad {
            assert!(synth(&settings).is_err(), "{settings:?}");
        }
    }
}
