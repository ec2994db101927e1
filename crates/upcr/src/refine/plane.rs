//! Point to plane (Chen & Medioni, IVC 1992).

use super::{Factor, Symmetric3};

/// (n·r)², `n` the target's normal.
pub(super) struct PointToPlane;

impl Factor for PointToPlane {
    fn information(&self, [x, y, z]: [f64; 3], _: [f64; 3]) -> Symmetric3 {
        [x * x, x * y, x * z, y * y, y * z, z * z]
    }
}
