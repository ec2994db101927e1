//! Pose-invariant point features: one file each, one trait.

use crate::neighbors::Neighborhoods;

/// What a feature is computed from. `normals` are unit length, one a point.
#[derive(Debug, Clone, Copy)]
pub struct FeatureInput<'a> {
    /// Positions, about a local origin.
    pub points: &'a [[f32; 3]],
    /// Unit normals; empty for the features that need none.
    pub normals: &'a [[f32; 3]],
    /// Neighbours of every point, itself first.
    pub neighborhoods: &'a Neighborhoods,
}

/// One row of `dim` values a point, row after row.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Descriptors {
    /// Values a row.
    pub dim: usize,
    /// `len() * dim` values.
    pub values: Vec<f32>,
}

impl Descriptors {
    /// Number of rows.
    pub fn len(&self) -> usize {
        if self.dim == 0 { 0 } else { self.values.len() / self.dim }
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Row `i`.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.values[i * self.dim..(i + 1) * self.dim]
    }
}
