//! Rigid point-cloud registration: two clouds in, the pose that lays one on the other and an honest verdict out.

pub mod cloud;
pub mod error;
pub mod features;
pub mod io;
pub mod neighbors;
mod register;
pub mod transform;

pub use cloud::{PointCloud, TriangleMesh};
pub use error::{CloudRole, Error, Result};
pub use register::{Locks, Method, Reason, Refinement, Registration, Settings, Timings, register};
pub use transform::Rigid;

#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;
