//! Rigid motions and the ways to write a rotation down.

pub mod euler;
pub mod quaternion;
mod rigid;
pub mod six_d;

pub use rigid::Rigid;
pub(crate) use rigid::nearest_rotation;
