//! Pose-invariant point features: one file each, one trait.

use crate::error::{Error, Result};
use crate::neighbors::Neighborhoods;

mod describe;
mod fpfh;
mod pair;
mod spfh;

pub use describe::{DEFAULT_K, DescribeTimings, describe};
pub use fpfh::Fpfh;
pub use spfh::Spfh;

/// A descriptor of the surface about a point that does not change with the cloud's pose.
pub trait Feature: Send + Sync {
    /// Short lower-case name, as a user types it.
    fn name(&self) -> &'static str;

    /// Values a point, given neighbourhoods of `k` points.
    fn dim(&self, k: usize) -> usize;

    /// Whether it looks at normals.
    fn needs_normals(&self) -> bool;

    /// The descriptors of all points, in parallel; the same whatever the number of threads.
    fn compute(&self, input: &FeatureInput) -> Result<Descriptors>;
}

/// Every feature there is.
pub const ALL: &[&dyn Feature] = &[&Spfh, &Fpfh];

/// The feature of that name.
pub fn by_name(name: &str) -> Option<&'static dyn Feature> {
    ALL.iter().copied().find(|feature| feature.name() == name)
}

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

impl FeatureInput<'_> {
    /// Whether the parts are there and fit together.
    fn check(&self, feature: &dyn Feature) -> Result<()> {
        let points = self.points.len();
        let fits = |name, found| {
            let reason = format!("{} needs one a point, {found} given for {points} points", feature.name());
            if found == points { Ok(()) } else { Err(Error::InvalidSetting { name, reason }) }
        };
        if feature.needs_normals() {
            fits("normals", self.normals.len())?;
        }
        fits("neighborhoods", self.neighborhoods.len())
    }
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
