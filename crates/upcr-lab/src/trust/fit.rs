//! Logistic regression of right and wrong over the evidence.

use nalgebra::{DMatrix, DVector, SVector};
use upcr::{Calibration, Error, FEATURES, Result, Weights};

use super::observe::Observed;

const COUNT: usize = FEATURES.len();
/// Which way each of [`FEATURES`] speaks: for the pose (1), against it (-1), or either way (0). Evidence that among the
/// training pairs seems to speak the other way does so by way of other evidence, and gets no weight of its own.
const SPEAKS: [f64; COUNT] = [
    1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 0.0, 1.0, -1.0, -1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, -1.0, -1.0,
];
/// Ridge on the weights of standardised features: keeps them finite where a feature tells right from wrong alone.
const RIDGE: f64 = 0.1;
/// Pairs without which nothing is fitted.
const FEWEST: usize = 100;
/// Newton steps at most, and the largest change of a weight that counts as settled.
const STEPS: usize = 50;
const SETTLED: f64 = 1e-9;

/// The calibration under which what was seen of the poses is most probable, given which of them were right. Of clouds
/// whose like was hardly seen the weights stay those of `default`.
///
/// # Errors
/// Where no finite weights are found.
pub fn fit(observed: &[Observed], default: &Calibration, about: String) -> Result<Calibration> {
    let of = |samples: bool, default: &Weights| -> Result<Weights> {
        let seen: Vec<&Observed> = observed.iter().filter(|o| o.evidence.samples == samples).collect();
        if seen.len() < FEWEST { Ok(default.clone()) } else { weights(&seen) }
    };
    let (samples, averages) = (of(true, &default.samples)?, of(false, &default.averages)?);
    Ok(Calibration { about, samples, averages })
}

fn weights(observed: &[&Observed]) -> Result<Weights> {
    let rows: Vec<SVector<f64, COUNT>> = observed.iter().map(|o| o.evidence.features().into()).collect();
    let n = rows.len().max(1) as f64;
    let mean = rows.iter().sum::<SVector<f64, COUNT>>() / n;
    let variance =
        rows.iter().map(|r| (r - mean).component_mul(&(r - mean))).sum::<SVector<f64, COUNT>>() / n;
    // A feature that never changes has nothing to say.
    let scale = variance.map(|v| if v > 1e-12 { 1.0 / v.sqrt() } else { 0.0 });
    let standard: Vec<SVector<f64, COUNT>> = rows.iter().map(|r| (r - mean).component_mul(&scale)).collect();

    let right: Vec<bool> = observed.iter().map(|o| o.right).collect();
    let mut kept: Vec<usize> = (0..COUNT).filter(|&k| scale[k] > 0.0).collect();
    let (intercept, standard_weights) = loop {
        let solved = newton(&standard, &right, &kept);
        let contrary = |(at, k): (usize, &usize)| (SPEAKS[*k] * solved[at + 1], at);
        let worst = kept.iter().enumerate().map(contrary).min_by(|a, b| a.0.total_cmp(&b.0));
        match worst {
            Some((spoken, at)) if spoken < 0.0 => drop(kept.remove(at)),
            _ => {
                let mut weights = [0.0; COUNT];
                for (k, weight) in kept.iter().zip(solved.iter().skip(1)) {
                    weights[*k] = *weight;
                }
                break (solved[0], weights);
            }
        }
    };
    let plain: [f64; COUNT] = std::array::from_fn(|k| standard_weights[k] * scale[k]);
    let shift: f64 = plain.iter().zip(mean.iter()).map(|(w, m)| w * m).sum();
    if !(intercept - shift).is_finite() || plain.iter().any(|weight| !weight.is_finite()) {
        return Err(Error::InvalidSetting {
            name: "data",
            reason: "no finite weights explain these pairs".into(),
        });
    }
    Ok(Weights::new(intercept - shift, plain))
}

/// Intercept and weights of the features `kept` that make `right` most probable.
fn newton(rows: &[SVector<f64, COUNT>], right: &[bool], kept: &[usize]) -> DVector<f64> {
    let count = kept.len() + 1;
    let mut weights = DVector::<f64>::zeros(count);
    for _ in 0..STEPS {
        let mut gradient = DVector::<f64>::zeros(count);
        let mut hessian = DMatrix::<f64>::zeros(count, count);
        for (row, right) in rows.iter().zip(right) {
            let x = DVector::from_iterator(count, std::iter::once(1.0).chain(kept.iter().map(|&k| row[k])));
            let p = 1.0 / (1.0 + (-weights.dot(&x)).exp());
            gradient.axpy(p - f64::from(*right), &x, 1.0);
            hessian.ger((p * (1.0 - p)).max(1e-9), &x, &x, 1.0);
        }
        for k in 1..count {
            gradient[k] += RIDGE * weights[k];
            hessian[(k, k)] += RIDGE;
        }
        let Some(step) = hessian.cholesky().map(|h| h.solve(&gradient)) else { break };
        weights -= &step;
        if step.amax() < SETTLED {
            break;
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use rand::Rng;
    use upcr::Evidence;

    use super::*;
    use crate::random;
    use crate::trust::cases::Kind;

    /// Pairs whose poses are right with a probability that overlap and closeness tell.
    fn drawn(count: u64) -> Vec<(Observed, f64)> {
        let one = |index| {
            let mut rng = random::stream(5, index);
            let overlap: f64 = rng.random_range(0.0..1.0);
            let closeness: f64 = rng.random_range(0.0..1.0);
            let p = 1.0 / (1.0 + (8.0 - 6.0 * overlap - 10.0 * closeness).exp());
            let evidence = Evidence { overlap: [overlap; 2], closeness, ..Evidence::none(500) };
            let right = rng.random_bool(p);
            (Observed { kind: Kind::Partial, right, probability: 0.0, evidence, reasons: Vec::new() }, p)
        };
        (0..count).map(one).collect()
    }

    #[test]
    fn the_law_that_draws_right_and_wrong_is_found() {
        let drawn = drawn(4000);
        let observed: Vec<Observed> = drawn.iter().map(|(o, _)| o.clone()).collect();
        let calibration = fit(&observed, &Calibration::embedded().unwrap(), "test".into()).unwrap();
        let off =
            drawn.iter().map(|(o, p)| (calibration.probability(&o.evidence) - p).abs()).fold(0.0, f64::max);
        assert!(off < 0.08, "{off}");
        // Features that were alike in all pairs weigh nothing.
        assert_eq!(calibration.samples.of["no_matches"], 0.0);
    }

    #[test]
    fn no_weight_in_the_library_speaks_against_its_meaning() {
        let calibration = Calibration::embedded().unwrap();
        for weights in [&calibration.samples, &calibration.averages] {
            let contrary =
                FEATURES.iter().zip(SPEAKS).find(|(name, speaks)| speaks * weights.of[**name] < 0.0);
            assert_eq!(contrary, None);
        }
    }

    #[test]
    fn where_all_poses_are_right_the_probability_is_high_and_finite() {
        let observed: Vec<Observed> =
            drawn(200).into_iter().map(|(o, _)| Observed { right: true, ..o }).collect();
        let calibration = fit(&observed, &Calibration::embedded().unwrap(), "test".into()).unwrap();
        let p = calibration.probability(&observed[0].evidence);
        assert!(p > 0.9 && p <= 1.0, "{p}");
    }
}
