//! Fast point feature histograms (Rusu et al. 2009).

use multiversion::multiversion;

use super::spfh::{self, BINS, DIM};
use super::{Descriptors, Feature, FeatureInput, IsOver, rows};
use crate::error::Result;

/// A point's own simplified histogram plus the mean of its neighbours', weighted by 1 / squared distance.
///
/// Both terms' three histograms add up to 100, as Open3D has it; PCL leaves the first term out.
#[derive(Debug, Clone, Copy, Default)]
pub struct Fpfh;

impl Feature for Fpfh {
    fn name(&self) -> &'static str {
        "fpfh"
    }

    fn dim(&self, _k: usize) -> usize {
        DIM
    }

    fn needs_normals(&self) -> bool {
        true
    }

    fn compute_unless(&self, input: &FeatureInput, is_over: IsOver) -> Result<Descriptors> {
        input.check(self)?;
        let simplified = spfh::histograms(input, is_over);
        let rows = rows(simplified.len(), is_over, || (), |(), i| weighted(input, &simplified, i));
        Ok(Descriptors { dim: DIM, values: rows.into_flattened() })
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn weighted(input: &FeatureInput, simplified: &[[f32; DIM]], i: usize) -> [f32; DIM] {
    let mut row = [0.0; DIM];
    for neighbor in input.neighborhoods.row(i) {
        if neighbor.distance_sq > 0.0 {
            let weight = 1.0 / neighbor.distance_sq;
            for (value, simplified) in row.iter_mut().zip(&simplified[neighbor.index as usize]) {
                *value += weight * simplified;
            }
        }
    }
    for (group, own) in row.chunks_exact_mut(BINS).zip(simplified[i].chunks_exact(BINS)) {
        let sum: f32 = group.iter().sum();
        let scale = if sum > 0.0 { 100.0 / sum } else { 0.0 };
        for (value, own) in group.iter_mut().zip(own) {
            *value = *value * scale + own;
        }
    }
    row
}
