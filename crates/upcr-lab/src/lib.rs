//! Data sets, a virtual scanner, training and evaluation around the `upcr` library.

pub mod data;
pub mod eval;
pub mod files;
#[cfg(feature = "train")]
pub mod models;
#[cfg(feature = "train")]
pub mod ops;
pub mod random;
#[cfg(feature = "train")]
pub mod train;

#[cfg(feature = "train")]
pub use burn::tensor::Device;
