//! Pose-invariant point features: one file each, one trait.

use rayon::prelude::*;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::neighbors::Neighborhoods;
use crate::watch::IsOver;

mod describe;
mod distance;
mod edges;
mod fpfh;
mod pair;
mod pfh;
mod ppf;
mod spfh;

pub use describe::{DEFAULT_K, DescribeTimings, describe};
pub use distance::Distance;
pub use fpfh::Fpfh;
pub use pfh::Pfh;
pub use ppf::Ppf;
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
    fn compute(&self, input: &FeatureInput) -> Result<Descriptors> {
        self.compute_unless(input, &|| false)
    }

    /// As [`Self::compute`]; rows stay zero once `is_over`, asked now and then, said yes.
    fn compute_unless(&self, input: &FeatureInput, is_over: IsOver) -> Result<Descriptors>;
}

/// Every feature there is.
pub const ALL: &[&dyn Feature] = &[&Distance, &Ppf, &Spfh, &Pfh, &Fpfh];

/// The feature of that name.
pub fn by_name(name: &str) -> Option<&'static dyn Feature> {
    ALL.iter().copied().find(|feature| feature.name() == name)
}

/// The feature that a registration matches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum MatchedFeature {
    /// Fast point feature histograms.
    #[default]
    Fpfh,
    /// Simplified point feature histograms.
    Spfh,
    /// Point feature histograms, of all pairs in a neighbourhood.
    Pfh,
}

impl MatchedFeature {
    /// What computes it.
    pub fn feature(self) -> &'static dyn Feature {
        match self {
            Self::Fpfh => &Fpfh,
            Self::Spfh => &Spfh,
            Self::Pfh => &Pfh,
        }
    }
}

/// A row a point, in parallel; `room` makes what a task reuses from row to row.
fn rows<const DIM: usize, S>(
    points: usize,
    is_over: IsOver,
    room: impl Fn() -> S + Sync,
    row: impl Fn(&mut S, usize) -> [f32; DIM] + Sync,
) -> Vec<[f32; DIM]> {
    /// Points a parallel task takes.
    const CHUNK: usize = 64;
    let mut rows = vec![[0.0; DIM]; points];
    rows.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, rows)| {
        if is_over() {
            return;
        }
        let mut room = room();
        for (out, i) in rows.iter_mut().zip(chunk * CHUNK..) {
            *out = row(&mut room, i);
        }
    });
    rows
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
        self.values.len().checked_div(self.dim).unwrap_or(0)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neighbors::KdTree;

    const POINTS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]];
    const NORMALS: [[f32; 3]; 4] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]];

    #[test]
    fn dimensions_are_as_announced_and_names_unique() {
        let neighborhoods = KdTree::new(&POINTS).knn_graph(3);
        let input = FeatureInput { points: &POINTS, normals: &NORMALS, neighborhoods: &neighborhoods };
        for feature in ALL {
            let found = feature.compute(&input).unwrap();
            assert_eq!((found.dim, found.len()), (feature.dim(3), 4), "{}", feature.name());
            assert!(found.values.iter().all(|v| v.is_finite()), "{}", feature.name());
            assert_eq!(by_name(feature.name()).map(Feature::name), Some(feature.name()));
        }
    }

    #[test]
    fn missing_normals_are_an_error() {
        let neighborhoods = KdTree::new(&POINTS).knn_graph(3);
        let input = FeatureInput { points: &POINTS, normals: &[], neighborhoods: &neighborhoods };
        for feature in ALL {
            assert_eq!(feature.compute(&input).is_err(), feature.needs_normals(), "{}", feature.name());
        }
    }

    #[test]
    fn an_empty_cloud_has_no_descriptors() {
        let neighborhoods = Neighborhoods::default();
        let input = FeatureInput { points: &[], normals: &[], neighborhoods: &neighborhoods };
        assert!(ALL.iter().all(|feature| feature.compute(&input).unwrap().is_empty()));
    }

    #[test]
    fn edges_carry_the_defined_values_and_short_rows_repeat_the_last() {
        let neighborhoods = KdTree::new(&POINTS).radius_graph(1.5, 10);
        let input = FeatureInput { points: &POINTS, normals: &NORMALS, neighborhoods: &neighborhoods };
        let ppf = Ppf.compute(&input).unwrap();
        let right = std::f32::consts::FRAC_PI_2;
        // Point 0: itself, its duplicate, point 1.
        assert_eq!(ppf.row(0), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, right, 0.0, right]);
        assert_eq!(ppf.row(2), [0.0; 12]);

        let distance = Distance.compute(&input).unwrap();
        let (o0, o1) = (0.3125_f32.sqrt(), 0.8125_f32.sqrt());
        assert_eq!(distance.row(0), [o0, 0.0, o0, o0, 0.0, o0, o1, 1.0, o0]);
    }
}
