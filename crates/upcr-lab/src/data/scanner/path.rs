//! Where the sensor stands: closed paths around, through and along the scenes.
//!
//! `s` is where on a path: an angle in rad of a [`Ring`], a length of a [`Walk`].

use std::f64::consts::PI;

use nalgebra::Vector3;
use upcr::Rigid;

use super::{bvh::Bvh, cast::overlap, sensor::Sensor};

/// Positions tried along the way to the next scan, before the best one is refined.
const STRIDES: usize = 24;
/// Halvings of the interval the wanted overlap lies in.
const BISECTIONS: usize = 6;

/// A way that the sensor takes, again and again.
#[derive(Debug, Clone)]
pub(super) enum Path {
    Ring(Ring),
    Walk(Walk),
}

/// An ellipse the sensor goes around, counter-clockwise seen from above.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ring {
    /// Middle of the ellipse.
    pub(super) center: Vector3<f64>,
    /// Half axes along x and y.
    pub(super) half_axes: [f64; 2],
    /// Phase of the path's ups and downs, and where it starts, in rad.
    pub(super) phase: f64,
    /// Where the sensor goes and looks on its way.
    pub(super) course: Course,
}

/// What the sensor does on its way round.
#[derive(Debug, Clone, Copy)]
pub(super) enum Course {
    /// On a sphere around the middle, rising and sinking, looking at the middle.
    Orbit,
    /// At its height, looking across the middle.
    Across,
    /// At its height, looking ahead.
    Along,
    /// At this height over the ground, looking ahead.
    OverGround(f64),
}

/// From corner to corner, at a height, looking ahead.
#[derive(Debug, Clone)]
pub(super) struct Walk {
    corners: Vec<Vector3<f64>>,
    /// Length of the way to each corner, and back to the first at the end.
    lengths: Vec<f64>,
    height: f64,
}

/// Longest step of a walk, in metres.
const STRIDE_M: f64 = 6.0;

impl Walk {
    pub(super) fn new(corners: Vec<Vector3<f64>>, height: f64) -> Self {
        let mut length = 0.0;
        let mut lengths = vec![0.0];
        for (i, corner) in corners.iter().enumerate() {
            length += (corners[(i + 1) % corners.len()] - corner).norm();
            lengths.push(length);
        }
        Self { corners, lengths, height }
    }

    fn pose(&self, s: f64, sensor: &Sensor) -> Rigid {
        let whole = self.lengths[self.corners.len()].max(f64::MIN_POSITIVE);
        let s = s.rem_euclid(whole);
        let leg = self.lengths.partition_point(|&length| length <= s).clamp(1, self.corners.len()) - 1;
        let [from, to] = [leg, leg + 1].map(|i| self.corners[i % self.corners.len()]);
        let ahead = (to - from).try_normalize(0.0).unwrap_or_else(Vector3::x);
        sensor.pose(from + ahead * (s - self.lengths[leg]) + Vector3::z() * self.height, ahead)
    }
}

impl Ring {
    fn pose(&self, s: f64, sensor: &Sensor, scene: &Bvh) -> Rigid {
        let (sin, cos) = (s + self.phase).sin_cos();
        let [a, b] = self.half_axes;
        let aside = Vector3::new(a * cos, b * sin, 0.0);
        let ahead = Vector3::new(-a * sin, b * cos, 0.0);
        let swing = (2.0 * s + 3.0 * self.phase).sin();
        let eye = self.center + aside;
        match self.course {
            Course::Orbit => {
                let (sin, cos) = (0.35 + 0.25 * swing).sin_cos();
                let radial = aside * cos + Vector3::z() * (aside.norm() * sin);
                sensor.pose(self.center + radial, -radial)
            }
            Course::Across => {
                sensor.pose(eye, (ahead * 0.3 - aside).normalize() - Vector3::z() * (0.45 + 0.1 * swing))
            }
            Course::Along => sensor.pose(eye, ahead),
            Course::OverGround(height) => {
                let top = Vector3::new(eye.x, eye.y, scene.bounds().high.z + height);
                let depth = scene.bounds().high.z - scene.bounds().low.z + 2.0 * height;
                let fall = scene.cast(&top, &-Vector3::z(), depth).map_or(0.0, |hit| hit.range);
                sensor.pose(top + Vector3::z() * (height - fall), ahead)
            }
        }
    }
}

impl Path {
    /// Pose `T_world_sensor` at `s`.
    fn pose(&self, s: f64, sensor: &Sensor, scene: &Bvh) -> Rigid {
        match self {
            Self::Ring(ring) => ring.pose(s, sensor, scene),
            Self::Walk(walk) => walk.pose(s, sensor),
        }
    }

    /// Poses `T_world_sensor` of `count` scans, neighbours overlapping by `wanted` as nearly as the path allows.
    pub(super) fn poses(&self, count: usize, wanted: f64, sensor: &Sensor, scene: &Bvh) -> Vec<Rigid> {
        let mut s = 0.0;
        let mut poses = vec![self.pose(s, sensor, scene)];
        while let Some(last) = poses.last().filter(|_| poses.len() < count) {
            s += self.step(s, last, wanted, sensor, scene);
            poses.push(self.pose(s, sensor, scene));
        }
        poses
    }

    /// The first step from `s`, at most half the way round a ring, at which the overlap falls to `wanted`; where it
    /// never does, the one at which it is least.
    fn step(&self, s: f64, from: &Rigid, wanted: f64, sensor: &Sensor, scene: &Bvh) -> f64 {
        let shared = |step: f64| mutual_overlap(scene, sensor, from, &self.pose(s + step, sensor, scene));
        let longest = match self {
            Self::Ring(_) => PI,
            Self::Walk(_) => STRIDE_M,
        };
        let at = |stride: usize| longest * stride as f64 / STRIDES as f64;
        let mut least = (1.0, at(2));
        for stride in 1..=STRIDES {
            let (mut low, mut high) = (at(stride - 1), at(stride));
            let share = shared(high);
            if share < wanted {
                for _ in 0..BISECTIONS {
                    let middle = f64::midpoint(low, high);
                    *if shared(middle) < wanted { &mut high } else { &mut low } = middle;
                }
                return f64::midpoint(low, high);
            }
            if share < least.0 {
                least = (share, high);
            }
        }
        least.1
    }
}

/// The smaller of the two scans' shares of what both see.
fn mutual_overlap(scene: &Bvh, sensor: &Sensor, a: &Rigid, b: &Rigid) -> f64 {
    overlap(scene, sensor, a, b).min(overlap(scene, sensor, b, a))
}
