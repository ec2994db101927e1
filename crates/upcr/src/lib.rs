//! Rigid point-cloud registration: two clouds in, the pose that lays one on the other and an honest verdict out.

pub mod cloud;
pub mod error;
pub mod features;
mod free_direction;
mod hash;
mod hypothesis;
pub mod io;
mod memory;
pub mod multiway;
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
mod watch;

pub use cloud::{PointCloud, TriangleMesh};
pub use error::{CloudRole, Error, Result};
pub use free_direction::FreeDirection;
pub use refine::{Locks, Refinement, RobustKernel};
pub use register::{ReadyScan, register, register_ready, register_watched};
pub use registration::{Alternative, Reason, Registration, TRUSTWORTHY, Timings};
pub use settings::{Method, Settings};
pub use transform::Rigid;
pub use verify::{Calibration, Evidence, FEATURES, Weights};
pub use watch::{PoseStep, Progress, Stage, StepPairs, Watch};

#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;
