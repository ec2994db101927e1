//! Whether motions that a shape leaves free are named, on noisy scans of such shapes.

use std::f64::consts::{PI, TAU};

use nalgebra::Vector3;
use rand::Rng;
use rayon::prelude::*;
use serde::Serialize;
use upcr::{FreeDirection, PointCloud, Result, Rigid, Settings, register};

use crate::random;

type V = Vector3<f64>;

/// How far a named axis may be off, in degrees, and a point off its axis, in sizes of the shape.
const TOLERANCE_DEG: f64 = 5.0;
const TOLERANCE: f64 = 0.1;

/// A shape with free motions; in its own frame about the origin, its axis z.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Shape {
    /// Slides along itself and turns about its normal.
    Plane,
    /// Slides along and turns about its axis.
    Cylinder,
    /// Floor, walls and ceiling; slides along itself.
    Corridor,
    /// Turns about its centre.
    Sphere,
}

/// How often exactly the free motions are named.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Named {
    /// Of what.
    pub shape: Shape,
    /// Pairs of scans.
    pub pairs: usize,
    /// Pairs of which each free motion is named and nothing else.
    pub named: usize,
}

/// Registers `pairs` pairs of noisy scans of each shape: of different sizes, noise, poses and cut-outs.
///
/// # Errors
/// As [`register`] says.
pub fn measure(pairs: usize, seed: u64, settings: &Settings) -> Result<Vec<Named>> {
    let shapes = [Shape::Plane, Shape::Cylinder, Shape::Corridor, Shape::Sphere];
    shapes.into_iter().map(|shape| named(shape, pairs, seed, settings)).collect()
}

fn named(shape: Shape, pairs: usize, seed: u64, settings: &Settings) -> Result<Named> {
    let is_named = |index: usize| -> Result<bool> {
        let rng = &mut random::stream(seed, 4 * index as u64 + shape as u64);
        let specimen = Specimen::new(shape, rng);
        let [(source, _), (target, T_target_shape)] = [specimen.scan(rng), specimen.scan(rng)];
        let found = register(&source, &target, settings)?;
        Ok(shape.is_named_by(&found.free_directions, &T_target_shape, specimen.size))
    };
    let named = (0..pairs).into_par_iter().map(is_named).collect::<Result<Vec<_>>>()?;
    Ok(Named { shape, pairs, named: named.iter().filter(|right| **right).count() })
}

impl Shape {
    /// Number of free slides, and of free turns.
    fn freedom(self) -> (usize, usize) {
        match self {
            Self::Plane => (2, 1),
            Self::Cylinder => (1, 1),
            Self::Corridor => (1, 0),
            Self::Sphere => (0, 3),
        }
    }

    fn is_named_by(self, found: &[FreeDirection], T_target_shape: &Rigid, size: f64) -> bool {
        let axis = T_target_shape.rotation.column(2).into_owned();
        let origin = T_target_shape.translation;
        let close = TOLERANCE_DEG.to_radians().sin();
        let right = |direction: &FreeDirection| match (self, direction) {
            (Self::Plane, FreeDirection::Translation { axis: slide }) => {
                V::from(*slide).dot(&axis).abs() < close
            }
            (Self::Cylinder | Self::Corridor, FreeDirection::Translation { axis: slide }) => {
                V::from(*slide).cross(&axis).norm() < close
            }
            (Self::Plane, FreeDirection::Rotation { axis: turn, .. }) => {
                V::from(*turn).cross(&axis).norm() < close
            }
            (Self::Cylinder, FreeDirection::Rotation { axis: turn, point }) => {
                let off = (V::from(*point) - origin).cross(&axis).norm();
                V::from(*turn).cross(&axis).norm() < close && off < TOLERANCE * size
            }
            (Self::Sphere, FreeDirection::Rotation { point, .. }) => {
                (V::from(*point) - origin).norm() < TOLERANCE * size
            }
            (Self::Corridor, FreeDirection::Rotation { .. })
            | (Self::Sphere, FreeDirection::Translation { .. }) => false,
        };
        let slides = found.iter().filter(|d| matches!(d, FreeDirection::Translation { .. })).count();
        (slides, found.len() - slides) == self.freedom() && found.iter().all(right)
    }
}

/// One of a shape's many sizes.
#[derive(Debug, Clone, Copy)]
struct Specimen {
    shape: Shape,
    /// Edge of the plane, radius of cylinder and sphere, width of the corridor.
    size: f64,
    /// Length over size.
    length: f64,
    /// Standard deviation of the noise along each axis, over size.
    noise: f64,
    points: usize,
}

impl Specimen {
    fn new(shape: Shape, rng: &mut impl Rng) -> Self {
        let length = match shape {
            Shape::Plane => 0.5..1.0,
            Shape::Cylinder => 2.0..5.0,
            Shape::Corridor => 3.0..8.0,
            Shape::Sphere => 0.0..1.0,
        };
        Self {
            shape,
            size: 10.0_f64.powf(rng.random_range(-1.0..1.0)),
            length: rng.random_range(length),
            noise: rng.random_range(0.001..0.01),
            points: rng.random_range(1500..20_000),
        }
    }

    /// What a sensor sees of it somewhere, and the pose of the shape in the sensor's frame.
    fn scan(&self, rng: &mut impl Rng) -> (PointCloud, Rigid) {
        let pose = Rigid {
            rotation: random::rotation(rng),
            translation: random::direction(rng) * (rng.random_range(0.0..5.0) * self.size),
        };
        // Where along the shape, and from which side, the scan looks.
        let (shift, side) = (rng.random_range(-0.15..0.15) * self.length, rng.random_range(0.0..TAU));
        let noise = |rng: &mut _| V::from_fn(|_, _| self.noise * random::normal(rng));
        let point =
            |rng: &mut _| pose.apply(((self.point(shift, side, rng) + noise(rng)) * self.size).into());
        (PointCloud::from_points((0..self.points).map(|_| point(rng)).collect()), pose)
    }

    /// A point of the surface, in sizes.
    fn point(&self, shift: f64, side: f64, rng: &mut impl Rng) -> V {
        let half = self.length / 2.0;
        match self.shape {
            Shape::Plane => {
                let (u, v) = (rng.random_range(-0.5..0.5) + shift, rng.random_range(-half..half));
                let (sin, cos) = side.sin_cos();
                V::new(cos * u - sin * v, sin * u + cos * v, 0.0)
            }
            Shape::Cylinder => {
                // Three quarters of it.
                let (sin, cos) = (side + rng.random_range(0.0..1.5 * PI)).sin_cos();
                V::new(cos, sin, rng.random_range(-half..half) + shift)
            }
            Shape::Corridor => {
                // A cross-section of 1 × 1.2.
                let along = rng.random_range(-half..half) + shift;
                let (across, up) = match rng.random_range(0.0..4.4) {
                    t @ 0.0..1.0 => (t - 0.5, -0.6),
                    t @ 1.0..2.0 => (t - 1.5, 0.6),
                    t @ 2.0..3.2 => (-0.5, t - 2.6),
                    t => (0.5, t - 3.8),
                };
                V::new(across, up, along)
            }
            Shape::Sphere => {
                // The cap seen from one side, and a little more than half of it.
                let view = V::new(side.cos(), side.sin(), shift);
                loop {
                    let direction = random::direction(rng);
                    if direction.dot(&view) > -0.2 {
                        return direction;
                    }
                }
            }
        }
    }
}
