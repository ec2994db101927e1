//! Rigid motions and the ways to write a rotation down.

mod rigid;
pub use rigid::Rigid;
