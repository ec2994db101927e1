//! Are both clouds in one unit? Asked where no pose is to be trusted.

use nalgebra::Vector3;

use crate::{
    PointCloud, Registration, Result, Settings, cloud::deviations, hypothesis::ALIKE, refine::Locks,
    settings::Method, watch::Call,
};

/// Lengths of common units: millimetre, centimetre, inch, foot, metre, kilometre.
const UNITS_M: [f64; 6] = [0.001, 0.01, 0.0254, 0.3048, 1.0, 1000.0];
/// Parts of one place differ in size by less than this factor, whichever way they are cut.
const CUT: f64 = 3.0;
/// Clouds that differ by more than this hardly show the same in one unit.
const FAR: f64 = 30.0;
/// Views of one whole at one scale differ less in size, as a logarithm.
const SCALED: f64 = 0.1;

/// How the sizes of two clouds compare.
pub(crate) struct Sizes {
    /// Standard deviations along the principal axes, largest first.
    source: Vector3<f64>,
    target: Vector3<f64>,
}

impl Sizes {
    pub fn of(source: &PointCloud, target: &PointCloud) -> Self {
        Self { source: deviations(source), target: deviations(target) }
    }

    /// How many times as large the target is.
    fn ratio(&self) -> f64 {
        self.target.norm() / self.source.norm()
    }

    /// Whether the sizes are so different that the clouds hardly show the same in one unit.
    pub fn are_far_apart(&self) -> bool {
        self.ratio().ln().abs() > FAR.ln()
    }

    /// Factors that might make the source fit, likely ones first: that between two views of one whole, and that between
    /// two units.
    fn factors(&self) -> Vec<f64> {
        let ratio = self.ratio();
        let mut factors = Vec::new();
        if !(ratio.is_finite() && ratio > 0.0) {
            return factors;
        }
        let off = (self.source * ratio - self.target).amax();
        if ratio.ln().abs() > SCALED && off <= ALIKE * self.target.amax() {
            factors.push(ratio);
        }
        let between = UNITS_M.iter().flat_map(|a| UNITS_M.iter().map(move |b| a / b)).filter(|f| *f != 1.0);
        let closeness = |factor: &f64| (factor.ln() - ratio.ln()).abs();
        let nearest = between.min_by(|a, b| closeness(a).total_cmp(&closeness(b)));
        factors.extend(
            nearest.filter(|factor| closeness(factor) < CUT.ln() && closeness(factor) < ratio.ln().abs()),
        );
        factors
    }

    /// The factor that makes the source fit, as `register` finds, where its own size does not.
    pub fn fitting_factor(
        &self,
        source: &PointCloud,
        target: &PointCloud,
        settings: &Settings,
        call: &Call,
        register: impl Fn(&PointCloud, &PointCloud, &Settings, &Call) -> Result<Registration>,
    ) -> Option<f64> {
        let factors = self.factors();
        if factors.is_empty() {
            return None;
        }
        // A guess at the wrong scale is none at the right one.
        let method = if settings.method == Method::Prior { Method::Auto } else { settings.method };
        let plain =
            Settings { method, init: None, locks: Locks::default(), voxel_size: None, ..settings.clone() };
        let target = scaled(target, 1.0);
        for factor in factors {
            let aside = call.aside();
            let fits = register(&scaled(source, factor), &target, &plain, &aside);
            if aside.ended_by().is_some() {
                // What ends the question ends the call, which finds that out by asking.
                call.is_over();
                return None;
            }
            if fits.is_ok_and(|fits| fits.is_trustworthy()) {
                return Some(factor);
            }
        }
        None
    }
}

/// The cloud with all lengths times `factor`, in so many points as the question needs.
fn scaled(cloud: &PointCloud, factor: f64) -> PointCloud {
    const POINTS: usize = 50_000;
    let step = cloud.len().div_ceil(POINTS).max(1);
    PointCloud::from_points(cloud.points.iter().step_by(step).map(|p| p.map(|v| v * factor)).collect())
}
