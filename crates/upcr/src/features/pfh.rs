//! Point feature histograms (Rusu et al. 2008).

use multiversion::multiversion;

use super::pair::{AngleBins, LANES, PairAngles, Points, cosine_bins};
use super::{Descriptors, Feature, FeatureInput, IsOver, rows};
use crate::error::Result;

/// Bins of each of the three angles.
const BINS: usize = 5;
/// Values a point.
const DIM: usize = BINS * BINS * BINS;

/// The joint histogram of the angles θ, α and φ, 5 bins each, θ varying fastest, over all pairs of points in
/// the neighbourhood, the point itself among them.
///
/// The histogram adds up to 100 where no two points coincide.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pfh;

impl Feature for Pfh {
    fn name(&self) -> &'static str {
        "pfh"
    }

    fn dim(&self, _k: usize) -> usize {
        DIM
    }

    fn needs_normals(&self) -> bool {
        true
    }

    fn compute_unless(&self, input: &FeatureInput, is_over: IsOver) -> Result<Descriptors> {
        input.check(self)?;
        let bins = AngleBins::new();
        let rows =
            rows(input.points.len(), is_over, Vec::new, |batches, i| histogram(input, i, &bins, batches));
        Ok(Descriptors { dim: DIM, values: rows.into_flattened() })
    }
}

/// The histogram of point `i`; `batches` is room for its neighbourhood.
#[multiversion(targets("x86_64+avx2"))]
fn histogram(
    input: &FeatureInput,
    i: usize,
    bins: &AngleBins<BINS>,
    batches: &mut Vec<Points>,
) -> [f32; DIM] {
    let neighbors = input.neighborhoods.row(i);
    let oriented = |index: u32| (input.points[index as usize], input.normals[index as usize]);
    batches.clear();
    for chunk in neighbors.chunks(LANES) {
        let mut batch = Points::ZERO;
        for (l, neighbor) in chunk.iter().enumerate() {
            let (position, normal) = oriented(neighbor.index);
            batch.set(l, position, normal);
        }
        batches.push(batch);
    }

    let mut counts = [0_u32; DIM + 1];
    for (first, neighbor) in neighbors.iter().enumerate() {
        let (position, normal) = oriented(neighbor.index);
        let point = Points::splat(position, normal);
        for (b, batch) in batches[..first.div_ceil(LANES)].iter().enumerate() {
            let angles = PairAngles::new(&point, batch);
            let theta = bins.of(&angles.theta_y, &angles.theta_x);
            let alpha = cosine_bins(&angles.alpha, BINS as u32);
            let phi = cosine_bins(&angles.phi, BINS as u32);
            let mut joint = [0_u32; LANES];
            for l in 0..LANES {
                // Every pair once; what makes no pair is counted beside the histogram.
                let is_pair = angles.valid[l] && b * LANES + l < first;
                let bin = theta[l] + BINS as u32 * (alpha[l] + BINS as u32 * phi[l]);
                joint[l] = if is_pair { bin } else { DIM as u32 };
            }
            for bin in joint {
                counts[(bin as usize).min(DIM)] += 1;
            }
        }
    }

    let pairs = neighbors.len() * neighbors.len().saturating_sub(1) / 2;
    let share = if pairs > 0 { 100.0 / pairs as f32 } else { 0.0 };
    std::array::from_fn(|b| counts[b] as f32 * share)
}
