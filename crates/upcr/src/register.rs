//! The one pipeline: prepare, hypotheses, refine, verify.

use std::num::NonZeroUsize;

use serde::Serialize;

use crate::{PointCloud, Result, transform::Rigid};

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
            locks: Locks::default(),
            seed: 0,
            threads: None,
        }
    }
}

/// What a caveat is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Reason {
    /// The clouds share no surface at the pose found.
    NoOverlap,
    /// They share little.
    LowOverlap,
    /// Another, different pose explains the clouds nearly as well.
    Ambiguous,
    /// Some direction of motion is not held by the geometry (a plane, a cylinder, a corridor).
    DegenerateAxis,
    /// Too few points to tell.
    TooFewPoints,
    /// The refinement ran out of iterations.
    NotConverged,
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NoOverlap => "the clouds share no surface at the pose found",
            Self::LowOverlap => "the clouds share little surface at the pose found",
            Self::Ambiguous => "another, different pose explains the clouds nearly as well",
            Self::DegenerateAxis => "some direction of motion is not held by the geometry",
            Self::TooFewPoints => "there are too few points to tell",
            Self::NotConverged => "the refinement ran out of iterations",
        })
    }
}

/// Milliseconds spent in each step; reading files is no part of it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Timings {
    /// Checks, scale, downsampling, normals.
    pub prepare: f64,
    /// Features, matching, hypotheses.
    pub hypotheses: f64,
    /// Refinement.
    pub refine: f64,
    /// Scoring and verdict.
    pub verify: f64,
    /// All of it, from call to return.
    pub total: f64,
}

/// The one result, whatever the method, always completely filled.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Registration {
    /// Takes source coordinates to target coordinates, both in their files' own frames: `y = R x + t`.
    pub T_target_source: Rigid,
    /// Share of held-out source points with a target point within `voxel_size`, 0 to 1.
    pub fitness: f64,
    /// Root mean square distance of those, in the clouds' unit.
    pub inlier_rmse: f64,
    /// How many there are.
    pub num_inliers: usize,
    /// Whether the refinement settled, with inliers to settle on.
    pub converged: bool,
    /// Refinement iterations of the returned pose.
    pub iterations: usize,
    /// Probability that the pose is right, 0 to 1.
    pub probability: f64,
    /// Covariance of the left twist (rotation rad, translation) of `T_target_source`, about the target's origin.
    pub covariance: [[f64; 6]; 6],
    /// What speaks against the pose.
    pub reasons: Vec<Reason>,
    /// Which source the winning hypothesis came from.
    pub method: Method,
    /// The scale used, in the clouds' unit.
    pub voxel_size: f64,
    /// The effective settings.
    pub settings: Settings,
    /// Where the time went.
    pub timings_ms: Timings,
}

/// Finds the pose that lays `source` on `target`.
pub fn register(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Registration> {
    let _ = (source, target);
    Ok(Registration {
        T_target_source: Rigid::identity(),
        fitness: 0.0,
        inlier_rmse: 0.0,
        num_inliers: 0,
        converged: false,
        iterations: 0,
        probability: 0.0,
        covariance: [[0.0; 6]; 6],
        reasons: vec![Reason::NoOverlap],
        method: settings.method,
        voxel_size: 0.0,
        settings: settings.clone(),
        timings_ms: Timings::default(),
    })
}
