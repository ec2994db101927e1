//! Robust kernels: how much a residual still counts.

use serde::Serialize;

/// Weight of a residual in iteratively re-weighted least squares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum RobustKernel {
    /// All residuals count alike.
    None,
    /// Linear beyond the scale.
    Huber,
    /// Heavy-tailed, never quite zero.
    Cauchy,
    /// Falls with the fourth power.
    #[default]
    GemanMcclure,
    /// Zero beyond the scale.
    Tukey,
}

impl RobustKernel {
    /// Weight and cost ρ of a squared residual, both squared lengths in the unit of `scale_sq`.
    ///
    /// The weight is ρ′, so that descending in Σ w r² descends in Σ ρ.
    pub fn weight_and_cost(self, residual_sq: f64, scale_sq: f64) -> (f64, f64) {
        let x = residual_sq / scale_sq;
        match self {
            Self::None => (1.0, residual_sq),
            Self::Huber if x <= 1.0 => (1.0, residual_sq),
            Self::Huber => (1.0 / x.sqrt(), scale_sq * (2.0 * x.sqrt() - 1.0)),
            Self::Cauchy => (1.0 / (1.0 + x), scale_sq * x.ln_1p()),
            Self::GemanMcclure => {
                let w = 1.0 / (1.0 + x);
                (w * w, residual_sq * w)
            }
            Self::Tukey if x < 1.0 => {
                let u = 1.0 - x;
                (u * u, scale_sq * (1.0 - u * u * u) / 3.0)
            }
            Self::Tukey => (0.0, scale_sq / 3.0),
        }
    }

    /// Derivative of the weight by `residual_sq / scale_sq`.
    pub(super) fn weight_slope(self, residual_sq: f64, scale_sq: f64) -> f64 {
        let x = residual_sq / scale_sq;
        match self {
            Self::Huber if x > 1.0 => -0.5 * x.powf(-1.5),
            Self::Cauchy => -1.0 / (1.0 + x).powi(2),
            Self::GemanMcclure => -2.0 / (1.0 + x).powi(3),
            Self::Tukey if x < 1.0 => -2.0 * (1.0 - x),
            Self::None | Self::Huber | Self::Tukey => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [RobustKernel; 5] = [
        RobustKernel::None,
        RobustKernel::Huber,
        RobustKernel::Cauchy,
        RobustKernel::GemanMcclure,
        RobustKernel::Tukey,
    ];

    #[test]
    fn weight_is_the_derivative_of_the_cost() {
        for kernel in ALL {
            for residual_sq in [0.01, 0.5, 1.9, 2.1, 3.0, 40.0] {
                let (scale_sq, h) = (2.0, 1e-6);
                let cost = |r| kernel.weight_and_cost(r, scale_sq).1;
                let slope = (cost(residual_sq + h) - cost(residual_sq - h)) / (2.0 * h);
                let (weight, _) = kernel.weight_and_cost(residual_sq, scale_sq);
                assert!((slope - weight).abs() < 1e-6, "{kernel:?} at {residual_sq}: {slope} {weight}");
            }
        }
    }

    #[test]
    fn slope_is_the_derivative_of_the_weight() {
        for kernel in ALL {
            for residual_sq in [0.01, 0.5, 1.9, 2.1, 3.0, 40.0] {
                let (scale_sq, h) = (2.0, 1e-6);
                let weight = |r| kernel.weight_and_cost(r, scale_sq).0;
                let slope = scale_sq * (weight(residual_sq + h) - weight(residual_sq - h)) / (2.0 * h);
                let found = kernel.weight_slope(residual_sq, scale_sq);
                assert!((slope - found).abs() < 1e-6, "{kernel:?} at {residual_sq}: {slope} {found}");
            }
        }
    }

    #[test]
    fn a_residual_of_zero_counts_fully_and_costs_nothing() {
        for kernel in ALL {
            assert_eq!(kernel.weight_and_cost(0.0, 0.3), (1.0, 0.0), "{kernel:?}");
        }
    }
}
