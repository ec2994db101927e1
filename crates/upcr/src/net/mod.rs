//! The UPCR network (sections II-A and II-B of the paper): what it is made of, and its inference.

mod aligned;
mod config;
mod graph;
mod head;
mod invariant;
mod kernel;
mod lanes;
mod layer;
mod network;
mod pool;
mod search;
#[cfg(target_arch = "x86_64")]
mod simd;
mod weights;

pub use config::{GraphKind, NetworkConfig, RotationKind};
pub use graph::Graph;
pub use invariant::{Invariant, InvariantInputs};
pub use network::{EMBEDDED_WEIGHTS, Network, Representations, centered};
