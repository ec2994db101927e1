//! Rigid point-cloud registration: two clouds in, the pose that lays one on the other and an honest verdict out.

pub mod cloud;
pub mod error;
pub mod features;
mod free_direction;
mod hypothesis;
pub mod io;
pub mod neighbors;
pub mod net;
mod prepare;
mod refine;
mod register;
mod registration;
mod settings;
mod threads;
pub mod transform;
mod verify;

pub use cloud::{PointCloud, TriangleMesh};
pub use error::{CloudRole, Error, Result};
pub use free_direction::FreeDirection;
pub use refine::{Locks, Refinement, RobustKernel};
pub use register::register;
pub use registration::{Reason, Registration, TRUSTWORTHY, Timings};
pub use settings::{Method, Settings};
pub use transform::Rigid;

#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;
