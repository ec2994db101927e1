//! Arbitrary bytes as two small clouds and all that a registration can be told.

use arbitrary::{Arbitrary, Result, Unstructured};
use nalgebra::Vector6;
use upcr::{Locks, PointCloud, Rigid, Settings};

use super::consistent::assert_consistent;
use super::consistent::choices::{FEATURES, KERNELS, METHODS, REFINEMENTS};

/// Most points of a cloud.
const POINTS: usize = 150;

/// A task for the registration.
#[derive(Debug)]
pub struct Task {
    /// The cloud that is moved.
    pub source: PointCloud,
    /// The cloud that stays.
    pub target: PointCloud,
    /// All else.
    pub settings: Settings,
}

/// Registers what `data` describe, and asserts what holds for every answer.
pub fn register(data: &[u8]) {
    let Ok(task) = Task::arbitrary(&mut Unstructured::new(data)) else { return };
    if let Ok(found) = upcr::register(&task.source, &task.target, &task.settings) {
        assert_consistent(&found);
    }
}

impl<'a> Arbitrary<'a> for Task {
    fn arbitrary(u: &mut Unstructured<'a>) -> Result<Self> {
        let settings = settings(u)?;
        let mut source = cloud(u)?;
        let mut target = match u.int_in_range(0..=3)? {
            0 => cloud(u)?,
            1 => source.clone(),
            2 => source.transformed(&pose(u)?),
            // The rest of the bytes disturb every coordinate by up to a tenth of the cloud's extent.
            _ => {
                let mut target = source.transformed(&pose(u)?);
                let most = target.points.iter().flatten().fold(0.0, |most: f64, v| most.max(v.abs()));
                for v in target.points.as_flattened_mut() {
                    *v += most * f64::from(u.arbitrary::<i8>()?) / 1280.0;
                }
                target
            }
        };
        for cloud in [&mut source, &mut target] {
            cloud.viewpoint = match u.int_in_range(0..=3)? {
                0 | 1 => None,
                2 => Some([f64::from(u.arbitrary::<i8>()?), 0.0, power(u)?]),
                _ => Some(u.arbitrary()?),
            };
        }
        Ok(Self { source, target, settings })
    }
}

fn settings(u: &mut Unstructured) -> Result<Settings> {
    let method = *u.choose(&METHODS)?;
    let refine = *u.choose(&REFINEMENTS)?;
    let kernel = *u.choose(&KERNELS)?;
    let feature = *u.choose(&FEATURES)?;
    let locks: u8 = u.arbitrary()?;
    // As often as not, nothing is locked.
    let lock = |k: u8| locks & 0x80 != 0 && locks >> k & 1 == 1;
    let locks = Locks { roll: lock(0), pitch: lock(1), yaw: lock(2), x: lock(3), y: lock(4), z: lock(5) };
    let voxel_size = match u.int_in_range(0..=2)? {
        0 => None,
        1 => Some(power(u)?),
        _ => Some(u.arbitrary()?),
    };
    let init = match u.int_in_range(0..=3)? {
        0 | 1 => None,
        2 => Some(pose(u)?),
        _ => {
            let mut sloppy = pose(u)?;
            sloppy.rotation[(0, 1)] += f64::from(u.arbitrary::<i8>()?) * 1e-6;
            Some(sloppy)
        }
    };
    let overlap = match u.int_in_range(0..=2)? {
        0 => None,
        1 => Some(f64::from(u.arbitrary::<u8>()?) / 255.0),
        _ => Some(u.arbitrary()?),
    };
    let seed = u.arbitrary::<u16>()?.into();
    let defaults = Settings::default();
    Ok(Settings { method, refine, kernel, feature, locks, voxel_size, init, overlap, seed, ..defaults })
}

/// A power of ten, from a millionth to a million.
fn power(u: &mut Unstructured) -> Result<f64> {
    Ok(10f64.powi(u.int_in_range(-6..=6)?))
}

/// A pose of moderate size.
fn pose(u: &mut Unstructured) -> Result<Rigid> {
    let mut twist = Vector6::zeros();
    for v in &mut twist {
        *v = f64::from(u.arbitrary::<i8>()?) / 32.0;
    }
    Ok(Rigid::exp(&twist))
}

/// Few points, on a lattice, of any numbers, or some of them over and over; of any size, anywhere.
fn cloud(u: &mut Unstructured) -> Result<PointCloud> {
    let count = u.int_in_range(0..=POINTS)?;
    let kind = u.int_in_range(0..=5)?;
    let (scale, offset) = (power(u)?, *u.choose(&[0.0, 0.0, 1.0, 1e7, -1e7])?);
    let mut points: Vec<[f64; 3]> = Vec::with_capacity(count);
    while points.len() < count && !u.is_empty() {
        let mut point = [0.0; 3];
        for v in &mut point {
            *v = match kind {
                0 => f64::from(u.arbitrary::<i8>()?) / 16.0,
                1 => f64::from(u.arbitrary::<i16>()?) / 256.0,
                2 => f64::from(u.int_in_range::<u8>(0..=3)?),
                3 => u.arbitrary::<f32>()?.into(),
                4 => u.arbitrary()?,
                // Height over a square.
                _ => f64::from(u.arbitrary::<u8>()?) / 64.0,
            } * scale
                + offset;
        }
        if kind == 5 {
            let side = (count as f64).sqrt().ceil() as usize;
            let (row, column) = (points.len() / side, points.len() % side);
            point = [row as f64 * scale + offset, column as f64 * scale + offset, point[2]];
        }
        points.push(point);
    }
    if u.ratio(1, 16)? {
        points = (0..count).filter_map(|i| points.get(i % 7).copied()).collect();
    }
    Ok(PointCloud::from_points(points))
}
