//! Rigid motions and the ways to write a rotation down.

mod rigid;
pub use rigid::Rigid;
pub(crate) use rigid::nearest_rotation;
