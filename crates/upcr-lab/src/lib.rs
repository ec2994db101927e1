//! Data sets, a virtual scanner, training and evaluation around the `upcr` library.

pub mod data;
#[cfg(feature = "train")]
pub mod drawing;
pub mod eval;
#[cfg(feature = "train")]
pub mod experiments;
pub mod files;
#[cfg(feature = "train")]
pub mod models;
#[cfg(feature = "train")]
pub mod ops;
pub mod random;
#[cfg(feature = "train")]
pub mod train;
pub mod trust;

#[cfg(feature = "train")]
pub use burn::tensor::Device;
