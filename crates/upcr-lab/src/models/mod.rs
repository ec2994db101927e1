//! The networks: one file each, Config → init → Module.

mod input;
mod layers;
mod rotation;
pub mod upcr;
pub mod weights;

pub use input::{CloudInput, Clouds};
pub use layers::{Linear, NormalizedLayer};
pub use upcr::{Output, Statistics, Upcr, init};
