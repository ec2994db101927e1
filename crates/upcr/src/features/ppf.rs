//! Point pair features (Drost et al. 2010).

use super::edges::per_edge;
use super::pair::{cross, dot};
use super::{Descriptors, Feature, FeatureInput, IsOver};
use crate::error::Result;

/// For every edge d from a point to a neighbour, with normals n₁ and n₂: |d|, ∠(n₁, d), ∠(n₂, d) and
/// ∠(n₁, n₂), the angles in rad, 0 to π; an angle to a vector of length zero is 0.
#[derive(Debug, Clone, Copy, Default)]
pub struct Ppf;

impl Feature for Ppf {
    fn name(&self) -> &'static str {
        "ppf"
    }

    fn dim(&self, k: usize) -> usize {
        4 * k
    }

    fn needs_normals(&self) -> bool {
        true
    }

    fn compute_unless(&self, input: &FeatureInput, is_over: IsOver) -> Result<Descriptors> {
        input.check(self)?;
        Ok(per_edge(input, is_over, |i, neighbor| {
            let j = neighbor.index as usize;
            let d = [0, 1, 2].map(|a| input.points[j][a] - input.points[i][a]);
            let (n1, n2) = (input.normals[i], input.normals[j]);
            [neighbor.distance_sq.sqrt(), angle(n1, d), angle(n2, d), angle(n1, n2)]
        }))
    }
}

/// The angle between two vectors; accurate at 0 and π as well, unlike the arc cosine.
fn angle(a: [f32; 3], b: [f32; 3]) -> f32 {
    let sine = cross(a, b);
    // Adding zero turns -0, whose angle to +0 is π, into +0.
    dot(sine, sine).sqrt().atan2(dot(a, b) + 0.0)
}

#[cfg(test)]
mod tests {
    use super::angle;

    #[test]
    fn the_angle_to_nothing_is_zero_for_every_normal() {
        for normal in [[1.0, 0.0, 0.0], [-1.0, -0.0, -0.0], [-0.6, -0.8, -0.0]] {
            assert_eq!(angle(normal, [0.0; 3]), 0.0, "{normal:?}");
        }
    }
}
