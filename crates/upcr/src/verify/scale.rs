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
    let few = PointCloud::from_points(cloud.points.iter().step_by(step).copied().collect());
    PointCloud { viewpoint: cloud.viewpoint, ..few }.scaled(factor)
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::{Error, Rigid, TRUSTWORTHY, register, watch::Watch};

    /// A bent sheet of about this size.
    fn sheet(size: f64) -> PointCloud {
        let unit = (0..400).map(|i| [f64::from(i % 20) / 19.0, f64::from(i / 20) / 19.0]);
        PointCloud::from_points(unit.map(|[u, v]| [u, 0.6 * v, 0.3 * u * u * v].map(|x| x * size)).collect())
    }

    /// Of clouds whose proportions differ as those of parts do.
    fn of_parts(ratio: f64) -> Sizes {
        let target = Vector3::new(0.8, 0.6, 0.0) * ratio;
        Sizes { source: Vector3::new(1.0, 0.0, 0.0), target }
    }

    fn of_wholes(ratio: f64) -> Sizes {
        let source = Vector3::new(0.8, 0.5, 0.1);
        Sizes { source, target: source * ratio }
    }

    fn logarithm(ratio: f64, of: f64) -> f64 {
        (ratio / of).ln().abs()
    }

    #[test]
    fn the_ratio_is_that_of_lengths_and_no_motion_changes_it() {
        let motion = Rigid::exp(&nalgebra::Vector6::new(0.3, -1.0, 0.5, 40.0, -7.0, 3.0));
        let moved = |cloud: &PointCloud| {
            PointCloud::from_points(cloud.points.iter().map(|&p| motion.apply(p)).collect())
        };
        for ratio in [0.02, 1.0, 7.5] {
            let sizes = Sizes::of(&sheet(3.0), &moved(&sheet(3.0 * ratio)));
            assert!(logarithm(sizes.ratio(), ratio) < 1e-9, "{} for {ratio}", sizes.ratio());
        }
    }

    #[test]
    fn sizes_are_far_apart_in_either_direction() {
        for ratio in [29.0, 1.0 / 29.0, 1.0] {
            assert!(!of_parts(ratio).are_far_apart(), "{ratio}");
        }
        for ratio in [31.0, 1.0 / 31.0] {
            assert!(of_parts(ratio).are_far_apart(), "{ratio}");
        }
    }

    #[test]
    fn parts_in_two_units_are_offered_the_ratio_of_the_units() {
        for (from, to) in [(0.001, 1.0), (1.0, 0.001), (0.0254, 0.001), (1.0, 0.3048), (0.01, 1000.0)] {
            let unit = from / to;
            for part in [0.95, 1.0, 1.05] {
                let factors = of_parts(unit * part).factors();
                assert!(matches!(factors[..], [f] if logarithm(f, unit) < 1e-12), "{unit}: {factors:?}");
            }
        }
    }

    #[test]
    fn wholes_are_offered_their_own_ratio_first() {
        for ratio in [1.2, 1.0 / 1.7, 12.5, 4e-4, 1e7] {
            let first = of_wholes(ratio).factors().first().copied();
            assert!(first.is_some_and(|f| logarithm(f, ratio) < 1e-12), "{ratio}: {first:?}");
        }
        // Nearly alike is not alike, and then only units are left.
        let Sizes { source, target } = of_wholes(12.5);
        let stretched = Sizes { source, target: target + Vector3::new(0.0, 0.05 * target[0], 0.0) };
        assert!(matches!(stretched.factors()[..], [f] if logarithm(f, 12.0) < 1e-12));
    }

    #[test]
    fn nothing_is_offered_where_the_sizes_suggest_no_unit() {
        // No further from each other than from any other unit, or than two views of one whole are.
        for ratio in [1.0, 1.5, 1.0 / 1.5] {
            assert_eq!(of_parts(ratio).factors(), [0.0; 0], "parts at {ratio}");
        }
        for ratio in [1.0, 1.09, 1.0 / 1.09] {
            assert_eq!(of_wholes(ratio).factors(), [0.0; 0], "wholes at {ratio}");
        }
        // Further from all units than parts of a place are from each other: beyond the largest, and in a gap.
        for ratio in [3.1e6, 1.0 / 3.1e6, 1.15e4] {
            assert_eq!(of_parts(ratio).factors(), [0.0; 0], "parts at {ratio}");
        }
        assert_eq!(of_parts(2.9e6).factors().len(), 1);
    }

    #[test]
    fn clouds_without_a_size_are_offered_nothing() {
        let (none, point) = (PointCloud::default(), PointCloud::from_points(vec![[1.0, 2.0, 3.0]; 5]));
        for without in [&none, &point] {
            for sizes in [
                Sizes::of(without, &sheet(1.0)),
                Sizes::of(&sheet(1.0), without),
                Sizes::of(without, without),
            ] {
                assert_eq!(sizes.factors(), [0.0; 0]);
            }
        }
        assert!(!Sizes::of(&none, &none).are_far_apart());
    }

    #[test]
    fn scaled_clouds_are_thinned_evenly() {
        let line = |n: u32| PointCloud::from_points((0..n).map(|i| [f64::from(i), -1.0, 0.5]).collect());
        assert_eq!(scaled(&line(3), 2.0).points, [[0.0, -2.0, 1.0], [2.0, -2.0, 1.0], [4.0, -2.0, 1.0]]);
        assert_eq!(scaled(&line(50_000), 1.0).len(), 50_000);
        let thinned = scaled(&line(120_000), 1.0);
        assert_eq!((thinned.len(), thinned.points[39_999][0]), (40_000, 119_997.0));
        assert_eq!(scaled(&line(0), 2.0).len(), 0);
    }

    /// An answer that is right with this probability.
    fn answer(probability: f64) -> Result<Registration> {
        let prior = Settings { method: Method::Prior, ..Settings::default() };
        Ok(Registration { probability, ..register(&sheet(1.0), &sheet(1.0), &prior)? })
    }

    /// The factor found where sources of these sizes fit, and of what sizes sources were asked for.
    fn asked(sizes: &Sizes, call: &Call, fits: impl Fn(f64) -> Result<bool>) -> (Option<f64>, Vec<f64>) {
        let settings = Settings {
            method: Method::Prior,
            init: Some(Rigid::from_translation([1.0, 0.0, 0.0])),
            locks: Locks { z: true, ..Locks::default() },
            voxel_size: Some(0.1),
            seed: 7,
            ..Settings::default()
        };
        let (source, target) = (sheet(1.0), sheet(1.0));
        let sources = RefCell::new(Vec::new());
        let found = sizes.fitting_factor(&source, &target, &settings, call, |source, to, plain, aside| {
            assert_eq!(to.points, target.points);
            assert_eq!(*plain, Settings { seed: 7, ..Settings::default() });
            assert!(!aside.is_over());
            let factor = source.points[399][0];
            sources.borrow_mut().push(factor);
            answer(if fits(factor)? { TRUSTWORTHY } else { 0.99 * TRUSTWORTHY })
        });
        (found, sources.into_inner())
    }

    #[test]
    fn the_first_factor_that_fits_is_the_answer() {
        let call = Call::new(None, Watch::default());
        let sizes = of_wholes(1.7);
        let factors = sizes.factors();
        assert_eq!(factors.len(), 2);
        assert_eq!(asked(&sizes, &call, |_| Ok(true)), (Some(factors[0]), vec![factors[0]]));
        assert_eq!(asked(&sizes, &call, |f| Ok(f > 2.0)), (Some(factors[1]), factors.clone()));
        assert_eq!(asked(&sizes, &call, |_| Ok(false)), (None, factors.clone()));
        let failed = || Error::InvalidSetting { name: "seed", reason: String::new() };
        let first_fails = |f: f64| if f < 2.0 { Err(failed()) } else { Ok(true) };
        assert_eq!(asked(&sizes, &call, first_fails), (Some(factors[1]), factors));
        assert_eq!(asked(&of_wholes(1.0), &call, |_| Ok(true)), (None, vec![]));
    }

    #[test]
    fn what_ends_the_question_ends_the_call() {
        let ended = AtomicBool::new(false);
        let cancelled = || ended.load(Ordering::Relaxed);
        let call = Call::new(None, Watch { cancelled: Some(&cancelled), ..Watch::default() });
        let sheet = sheet(1.0);
        let found =
            of_wholes(1.7).fitting_factor(&sheet, &sheet, &Settings::default(), &call, |_, _, _, aside| {
                ended.store(true, Ordering::Relaxed);
                assert!(aside.is_over());
                answer(1.0)
            });
        assert_eq!(found, None);
        assert!(call.ended_by().is_some());
    }
}
