//! Refinement of a pose: iterative closest points with three small factors over one solver.
//!
//! A factor is a 3×3 information matrix on the residual `r = T p − q` of a pair of points; everything else
//! (correspondences, robust weights, trimming, locked axes, the solver) is written once.

mod gicp;
mod icp;
mod information;
mod lock;
mod plane;
mod point;
mod robust;
mod solver;

pub(crate) use icp::{Hear, Icp, Refined, Schedule};
pub(crate) use information::{Information, Patch};
pub(crate) use lock::LockedPose;
pub use lock::Locks;
pub use robust::RobustKernel;
pub(crate) use solver::{Correspondence, Objective, align};

use serde::{Deserialize, Serialize};

/// What the refinement minimises.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
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

/// Symmetric 3×3 matrix: xx, xy, xz, yy, yz, zz.
pub(crate) type Symmetric3 = [f64; 6];

/// What a pair of points says about the pose.
pub(crate) trait Factor: Sync {
    /// Information matrix of the residual, given the unit normals of both points in the target's frame.
    ///
    /// Scaled so that a unit distance along the normals has weight one.
    fn information(&self, target_normal: [f64; 3], source_normal: [f64; 3]) -> Symmetric3;
}

/// The factor of a refinement; [`Refinement::None`] scores like a point.
///
/// `sparse`: the points are samples as they were taken, not averages of many.
pub(crate) fn factor(refinement: Refinement, sparse: bool) -> &'static dyn Factor {
    match refinement {
        Refinement::Gicp if sparse => &gicp::PlaneToPlane::SPARSE,
        Refinement::Gicp => &gicp::PlaneToPlane::DENSE,
        Refinement::Plane => &plane::PointToPlane,
        Refinement::Point | Refinement::None => &point::PointToPoint,
    }
}
