//! Distances among a point, its neighbours and the cloud's centroid (UPCR).

use super::edges::per_edge;
use super::{Descriptors, Feature, FeatureInput, IsOver};
use crate::error::Result;

/// For every edge from point xᵢ to a neighbour xᵢⱼ: |xᵢⱼ - o|, |xᵢⱼ - xᵢ| and |o - xᵢ|, in the clouds' unit,
/// with the cloud's centroid o.
#[derive(Debug, Clone, Copy, Default)]
pub struct Distance;

impl Feature for Distance {
    fn name(&self) -> &'static str {
        "distance"
    }

    fn dim(&self, k: usize) -> usize {
        3 * k
    }

    fn needs_normals(&self) -> bool {
        false
    }

    fn compute_unless(&self, input: &FeatureInput, is_over: IsOver) -> Result<Descriptors> {
        input.check(self)?;
        let mut sum = [0.0_f64; 3];
        for p in input.points {
            for a in 0..3 {
                sum[a] += f64::from(p[a]);
            }
        }
        let o = sum.map(|s| (s / input.points.len() as f64) as f32);
        let to_centroid: Vec<f32> = input.points.iter().map(|p| distance(*p, o)).collect();
        Ok(per_edge(input, is_over, |i, neighbor| {
            [to_centroid[neighbor.index as usize], neighbor.distance_sq.sqrt(), to_centroid[i]]
        }))
    }
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    [0, 1, 2].map(|i| (a[i] - b[i]) * (a[i] - b[i])).iter().sum::<f32>().sqrt()
}
