//! Data sets, a virtual scanner, training and evaluation around the `upcr` library.

pub mod data;
pub mod eval;
pub mod random;
