//! What a layer with batch norm over edges takes, and what it gives.

use burn::tensor::Tensor;

/// Parameters of a map followed by batch norm over edges.
#[derive(Debug, Clone)]
pub struct NormalizedMap {
    /// `[inputs, outputs]`.
    pub weight: Tensor<2>,
    /// Scale of the norm, `[outputs]`.
    pub gamma: Tensor<1>,
    /// Shift of the norm, `[outputs]`.
    pub beta: Tensor<1>,
    /// Slope of the leaky rectifier for negative values.
    pub negative_slope: f32,
}

/// Values of a layer, and the statistics over edges that normalised them (no gradient flows through these).
#[derive(Debug, Clone)]
pub struct Normalized {
    /// `[rows, outputs]`.
    pub values: Tensor<2>,
    /// Mean and variance, `[outputs]` each.
    pub statistics: [Tensor<1>; 2],
}
