//! All that a registration can be told.

use std::num::NonZeroUsize;

use serde::Serialize;

use crate::{refine::RobustKernel, transform::Rigid};

/// Where the first pose comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum Method {
    /// Cheap sources first, dearer ones until the verifier is sure.
    #[default]
    Auto,
    /// The given initial pose alone (identity where none is given).
    Prior,
    /// Fast Global Registration.
    Fgr,
    /// Feature RANSAC.
    Ransac,
    /// Feature matches that agree with each other (second-order spatial compatibility).
    Consensus,
}

/// What the refinement minimises.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum Refinement {
    /// Generalized ICP (plane to plane).
    #[default]
    Gicp,
    /// Point to plane.
    Plane,
    /// Point to point.
    Point,
    /// Nothing: the hypothesis is the answer.
    None,
}

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

/// All that a registration can be told. `Settings::default()` is meant to be enough.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Settings {
    /// Where the first pose comes from.
    pub method: Method,
    /// What the refinement minimises.
    pub refine: Refinement,
    /// The one scale that drives every radius, in the clouds' unit; `None`: derived from the clouds.
    pub voxel_size: Option<f64>,
    /// A first guess of `T_target_source`, in the files' frames.
    pub init: Option<Rigid>,
    /// How residuals of the refinement are weighed.
    pub kernel: RobustKernel,
    /// Share of the closest pairs that the refinement keeps, 0 to 1; `None`: all within reach.
    pub overlap: Option<f64>,
    /// Degrees of freedom held at the initial pose's values.
    pub locks: Locks,
    /// Seed of every random choice.
    pub seed: u64,
    /// Threads to use; `None`: all that the current rayon pool has. The result does not depend on it.
    pub threads: Option<NonZeroUsize>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            method: Method::Auto,
            refine: Refinement::Gicp,
            voxel_size: None,
            init: None,
            kernel: RobustKernel::default(),
            overlap: None,
            locks: Locks::default(),
            seed: 0,
            threads: None,
        }
    }
}
