//! The networks: one file each, Config → init → Module.

pub mod attention;
pub mod dcp;
pub mod dense;
pub mod dgcnn;
mod input;
mod layers;
pub mod learned;
pub mod named;
pub mod pointnetlk;
pub mod prnet;
mod procrustes;
pub mod pytorch;
mod rotation;
pub mod tensor_file;
pub mod truth;
pub mod upcr;
pub mod weights;

pub use input::{CloudInput, Clouds};
pub use layers::{Linear, NormalizedLayer, Statistics};
pub use learned::{Batch, Learned, LearnedConfig, PairInput};
pub use upcr::{Output, Upcr, init};

#[cfg(test)]
mod tests;
