//! Generalized ICP, plane to plane (Segal, Haehnel & Thrun, RSS 2009).

use super::{Factor, Symmetric3};

/// `rᵀ (C_target + R C_source Rᵀ)⁻¹ r`, each covariance `I − (1 − ε) n nᵀ`: flat along the surface's normal.
pub(super) struct PlaneToPlane {
    /// ε: variance across the surface, in units of that along it.
    thickness: f64,
}

impl PlaneToPlane {
    /// Points are averages of many: where they lie along the surface says nothing.
    pub const DENSE: Self = Self { thickness: 1e-3 };
    /// Points are the samples themselves, few and with normals as rough: their places count too.
    pub const SPARSE: Self = Self { thickness: 1e-1 };
}

impl Factor for PlaneToPlane {
    fn information(&self, n: [f64; 3], m: [f64; 3]) -> Symmetric3 {
        let flat = 1.0 - self.thickness;
        let sum = |i: usize, j: usize| f64::from(u8::from(i == j)) * 2.0 - flat * (n[i] * n[j] + m[i] * m[j]);
        let (a, b, c, d, e, f) = (sum(0, 0), sum(0, 1), sum(0, 2), sum(1, 1), sum(1, 2), sum(2, 2));
        // Inverse by cofactors; the determinant is at least ε for unit normals.
        let (ca, cb, cc) = (d * f - e * e, c * e - b * f, b * e - c * d);
        let scale = 2.0 * self.thickness / (a * ca + b * cb + c * cc);
        [ca, cb, cc, a * f - c * c, b * c - a * e, a * d - b * b].map(|v| v * scale)
    }
}
