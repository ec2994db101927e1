//! Simplified point feature histograms (Rusu et al. 2009).

use multiversion::multiversion;

use super::pair::{AngleBins, LANES, PairAngles, Points, cosine_bins};
use super::{Descriptors, Feature, FeatureInput, IsOver, rows};
use crate::error::Result;
use crate::neighbors::Neighbor;

/// Bins of each of the three angles.
pub(super) const BINS: usize = 11;
/// Values a point.
pub(super) const DIM: usize = 3 * BINS;

/// Histograms, 11 bins each, of the angles θ, α and φ between a point and its neighbours.
///
/// Each histogram adds up to 100 where every neighbour makes a pair (duplicates of the point do not).
#[derive(Debug, Clone, Copy, Default)]
pub struct Spfh;

impl Feature for Spfh {
    fn name(&self) -> &'static str {
        "spfh"
    }

    fn dim(&self, _k: usize) -> usize {
        DIM
    }

    fn needs_normals(&self) -> bool {
        true
    }

    fn compute_unless(&self, input: &FeatureInput, is_over: IsOver) -> Result<Descriptors> {
        input.check(self)?;
        Ok(Descriptors { dim: DIM, values: histograms(input, is_over).into_flattened() })
    }
}

/// The histograms of every point.
pub(super) fn histograms(input: &FeatureInput, is_over: IsOver) -> Vec<[f32; DIM]> {
    let bins = AngleBins::new();
    rows(input.points.len(), is_over, || (), |(), i| histogram(input, i, &bins))
}

#[multiversion(targets("x86_64+avx2"))]
fn histogram(input: &FeatureInput, i: usize, bins: &AngleBins<BINS>) -> [f32; DIM] {
    let center = Points::splat(input.points[i], input.normals[i]);
    let mut counts = [[0_u32; BINS + 1]; 3];
    for batch in input.neighborhoods.row(i).chunks(LANES) {
        // The point makes no pair with itself: no need to leave it out, and it fills the last batch.
        let mut others = center;
        for (l, &Neighbor { index, .. }) in batch.iter().enumerate() {
            others.set(l, input.points[index as usize], input.normals[index as usize]);
        }
        let angles = PairAngles::new(&center, &others);
        let theta = bins.of(&angles.theta_y, &angles.theta_x);
        let alpha = cosine_bins(&angles.alpha, BINS as u32);
        let phi = cosine_bins(&angles.phi, BINS as u32);
        for l in 0..LANES {
            // What makes no pair is counted beside the histogram.
            for (counts, bin) in counts.iter_mut().zip([theta[l], alpha[l], phi[l]]) {
                let bin = if angles.valid[l] { bin as usize } else { BINS };
                counts[bin.min(BINS)] += 1;
            }
        }
    }
    let pairs = input.neighborhoods.row(i).iter().filter(|n| n.index as usize != i).count();
    let share = if pairs > 0 { 100.0 / pairs as f32 } else { 0.0 };
    let mut row = [0.0; DIM];
    for (row, counts) in row.chunks_exact_mut(BINS).zip(&counts) {
        for (value, &count) in row.iter_mut().zip(counts) {
            *value = count as f32 * share;
        }
    }
    row
}
