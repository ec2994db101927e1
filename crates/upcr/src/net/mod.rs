//! The UPCR network: what it is made of and what goes into it.

mod config;
mod graph;
mod invariant;

pub use config::{GraphKind, NetworkConfig, RotationKind};
pub use graph::Graph;
pub use invariant::{Invariant, InvariantInputs};
