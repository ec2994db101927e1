//! Point to point (Besl & McKay, PAMI 1992).

use super::{Factor, Symmetric3};

/// ‖r‖².
pub(super) struct PointToPoint;

impl Factor for PointToPoint {
    fn information(&self, _: [f64; 3], _: [f64; 3]) -> Symmetric3 {
        [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]
    }
}
