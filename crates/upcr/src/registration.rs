//! What a registration returns.

use serde::{Deserialize, Serialize};

use crate::{
    free_direction::FreeDirection,
    settings::{Method, Settings},
    transform::Rigid,
    verify::Evidence,
};

/// What a caveat is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Reason {
    /// The clouds share no surface at the pose found.
    NoOverlap,
    /// They share little.
    LowOverlap,
    /// Another, different pose explains the clouds nearly as well.
    Ambiguous,
    /// Points of one cloud stand where the other's sensor saw through to something behind.
    SeenThrough,
    /// Some motion is not held by the geometry: those in [`Registration::free_directions`].
    DegenerateAxis,
    /// Too few points to tell.
    TooFewPoints,
    /// The clouds seem to be in different units: see [`Registration::source_scale`].
    ScaleMismatch,
    /// The refinement did not settle: no inliers to settle on, or no iterations left.
    NotConverged,
    /// The surfaces do not lie on each other as they do at right poses: the evidence alone makes the pose improbable.
    PoorFit,
    /// The time limit ended the call before it was done.
    TimeLimit,
    /// The caller ended the call before it was done.
    Cancelled,
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NoOverlap => "the clouds share no surface at the pose found",
            Self::LowOverlap => "the clouds share little surface at the pose found",
            Self::Ambiguous => "another, different pose explains the clouds nearly as well",
            Self::SeenThrough => {
                "points of one cloud stand where the other's sensor saw through to something behind"
            }
            Self::DegenerateAxis => "some direction of motion is not held by the geometry",
            Self::TooFewPoints => "too few points are left at this scale, or meet, to tell",
            Self::ScaleMismatch => {
                "the clouds differ so much in size that they seem to be in different units"
            }
            Self::NotConverged => "the refinement did not settle",
            Self::PoorFit => "the surfaces do not lie on each other as they do where a pose is right",
            Self::TimeLimit => "the time limit ended the search early",
            Self::Cancelled => "the search was cancelled",
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

/// Another pose that explains the clouds nearly as well.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Alternative {
    /// As [`Registration::T_target_source`].
    pub T_target_source: Rigid,
    /// Its score over that of the pose returned: 1 is as good.
    pub relative_score: f64,
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
    /// Whether the refinement settled, with inliers to settle on, and nothing ended the call early.
    pub converged: bool,
    /// Refinement iterations of the returned pose.
    pub iterations: usize,
    /// Probability that the pose is right, 0 to 1.
    pub probability: f64,
    /// How far the pose may be off near the optimum found: the covariance, in rad² and squared units of the clouds, of
    /// the left twist `(ωx, ωy, ωz, vx, vy, vz)` that takes the pose found to the right one.
    ///
    /// With c the centre of the target's bounding box, a point y of the registered source belongs at
    /// `y + ω × (y − c) + v`, axes being those of the target's file. Locked degrees of freedom have no variance; free
    /// ones that of an angle uniform over the circle, (π²/3) rad², or of a length of the source's radius.
    pub covariance: [[f64; 6]; 6],
    /// Motions that the geometry does not hold: along a plane, about a cylinder.
    pub free_directions: Vec<FreeDirection>,
    /// What speaks against the pose.
    pub reasons: Vec<Reason>,
    /// Other poses that explain the clouds nearly as well, best first: those of a square table turned by quarters.
    pub alternatives: Vec<Alternative>,
    /// The factor by which the source's lengths have to be multiplied for the clouds to fit, where they do not fit as they
    /// are and do with it.
    pub source_scale: Option<f64>,
    /// What the probability is made of.
    pub evidence: Evidence,
    /// Which source the winning hypothesis came from.
    pub method: Method,
    /// The scale used, in the clouds' unit; 0 where the call ended before it was known.
    pub voxel_size: f64,
    /// Points of source and target that were looked at: all, or every so-many-th where memory is bounded.
    pub points_used: [usize; 2],
    /// The effective settings.
    pub settings: Settings,
    /// Where the time went.
    pub timings_ms: Timings,
}

/// Probability from which a pose is called registered.
pub const TRUSTWORTHY: f64 = 0.5;

impl Registration {
    /// Whether the pose is more likely right than wrong.
    pub fn is_trustworthy(&self) -> bool {
        self.probability >= TRUSTWORTHY
    }
}
