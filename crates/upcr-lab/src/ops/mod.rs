//! The project's own differentiable operations.
//!
//! Each is a pair of plain functions (values; gradients from what the first kept) over a batch of clouds whose rows
//! stand one after the other, and enters the framework through its backend extension (`extension`). On other devices
//! the same operations are written with the framework's own tensors (`generic`).

mod attention;
pub mod batch;
mod buffer;
pub mod canonical_chamfer;
pub mod edge_embed;
mod extension;
mod generic;
pub mod graph_layer;
mod layers;
mod neighbors;
mod normalized;
pub mod pool;
mod product;
mod rows;

pub use batch::BatchGraph;
pub use extension::{canonical_chamfer, edge_embed, graph_layer, pool_max};
pub use layers::{attention, batch_norm, dense, group_max, layer_norm};
pub use neighbors::nearest_features;
pub use normalized::{Normalized, NormalizedMap};

#[cfg(test)]
mod tests;
