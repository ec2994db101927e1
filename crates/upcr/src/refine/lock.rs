//! Locked degrees of freedom, solved inside the optimisation.
//!
//! The pose in the files' frames is written as `R = Rz(yaw) Ry(pitch) Rx(roll)` and `t`; the solver steps in
//! the free ones of these six numbers, so the locked ones keep their value to the last bit.

use nalgebra::{Matrix3, Matrix6xX, Rotation3, Vector3};

use serde::Serialize;

use crate::transform::Rigid;

/// Degrees of freedom of `T_target_source` that keep the value they have in the initial pose.
///
/// Roll, pitch and yaw are the extrinsic x, y, z angles of `R = Rz(yaw) Ry(pitch) Rx(roll)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[allow(clippy::struct_excessive_bools)]
pub struct Locks {
    /// Rotation about x.
    pub roll: bool,
    /// Rotation about y.
    pub pitch: bool,
    /// Rotation about z.
    pub yaw: bool,
    /// Translation along x.
    pub x: bool,
    /// Translation along y.
    pub y: bool,
    /// Translation along z.
    pub z: bool,
}

impl Locks {
    /// Roll, pitch, yaw, x, y, z.
    pub fn flags(&self) -> [bool; 6] {
        [self.roll, self.pitch, self.yaw, self.x, self.y, self.z]
    }

    /// Whether anything is locked.
    pub fn any(&self) -> bool {
        self.flags().contains(&true)
    }
}

/// A local pose whose file-frame counterpart has locked parameters.
#[derive(Debug, Clone)]
pub(crate) struct LockedPose {
    locks: Locks,
    /// Roll, pitch, yaw, x, y, z of the initial pose, in the files' frames.
    held: [f64; 6],
    source_origin: Vector3<f64>,
    target_origin: Vector3<f64>,
}

impl LockedPose {
    /// Locks `locks` at the values that `init` (file frames) has; `None` where nothing is locked.
    pub fn new(locks: Locks, init: &Rigid, source_origin: [f64; 3], target_origin: [f64; 3]) -> Option<Self> {
        locks.any().then(|| Self {
            locks,
            held: parameters(init),
            source_origin: source_origin.into(),
            target_origin: target_origin.into(),
        })
    }

    fn to_file(&self, local: &Rigid) -> Rigid {
        let translation = local.translation + self.target_origin - local.rotation * self.source_origin;
        Rigid { rotation: local.rotation, translation }
    }

    fn to_local(&self, file: &Rigid) -> Rigid {
        let translation = file.translation - self.target_origin + file.rotation * self.source_origin;
        Rigid { rotation: file.rotation, translation }
    }

    /// The pose that the locked parameters allow and that is otherwise as `local`, its centre staying put.
    pub fn project(&self, local: &Rigid) -> Rigid {
        let mut p = parameters(&self.to_file(local));
        for k in 0..3 {
            if self.locks.flags()[k] {
                p[k] = self.held[k];
            }
        }
        // The source's centre goes where it went before, as far as the translation locks let it.
        let rotation = Rotation3::from_euler_angles(p[0], p[1], p[2]).into_inner();
        let translation = self.to_file(&Rigid { rotation, translation: local.translation }).translation;
        for k in 0..3 {
            p[3 + k] = if self.locks.flags()[3 + k] { self.held[3 + k] } else { translation[k] };
        }
        self.to_local(&pose(&p))
    }

    /// Columns: how each free parameter moves the local pose, as a left twist (rotation, translation).
    pub fn tangent(&self, local: &Rigid) -> Matrix6xX<f64> {
        let file = self.to_file(local);
        let [_, pitch, yaw, ..] = parameters(&file);
        let (sp, cp, sy, cy) = (pitch.sin(), pitch.cos(), yaw.sin(), yaw.cos());
        // Angular velocity of unit roll, pitch and yaw rates.
        let rates = Matrix3::new(cy * cp, -sy, 0.0, sy * cp, cy, 0.0, -sp, 0.0, 1.0);
        // A file-frame motion dy = ω × (y_file − t_file) + ṫ is, at y_local = y_file − o_target,
        // ω × y_local + (ṫ + ω × (o_target − t_file)).
        let arm = self.target_origin - file.translation;
        let free: Vec<usize> = (0..6).filter(|&k| !self.locks.flags()[k]).collect();
        let mut tangent = Matrix6xX::zeros(free.len());
        for (column, &k) in free.iter().enumerate() {
            if k < 3 {
                let omega: Vector3<f64> = rates.column(k).into();
                tangent.fixed_view_mut::<3, 1>(0, column).copy_from(&omega);
                tangent.fixed_view_mut::<3, 1>(3, column).copy_from(&omega.cross(&arm));
            } else {
                tangent[(k, column)] = 1.0;
            }
        }
        tangent
    }

    /// Moves the free parameters by `step`.
    pub fn step(&self, local: &Rigid, step: &[f64]) -> Rigid {
        let mut p = parameters(&self.to_file(local));
        let mut steps = step.iter();
        for k in 0..6 {
            if self.locks.flags()[k] {
                p[k] = self.held[k];
            } else {
                p[k] += steps.next().copied().unwrap_or(0.0);
            }
        }
        self.to_local(&pose(&p))
    }

    /// The pose in the files' frames, its locked parameters exactly as held.
    pub fn file_pose(&self, local: &Rigid) -> Rigid {
        let mut p = parameters(&self.to_file(local));
        for k in 0..6 {
            if self.locks.flags()[k] {
                p[k] = self.held[k];
            }
        }
        pose(&p)
    }
}

fn parameters(pose: &Rigid) -> [f64; 6] {
    let (roll, pitch, yaw) = Rotation3::from_matrix_unchecked(pose.rotation).euler_angles();
    [roll, pitch, yaw, pose.translation[0], pose.translation[1], pose.translation[2]]
}

fn pose(p: &[f64; 6]) -> Rigid {
    let rotation = Rotation3::from_euler_angles(p[0], p[1], p[2]).into_inner();
    Rigid { rotation, translation: Vector3::new(p[3], p[4], p[5]) }
}
